"""Each term of the paper's Table I against numbers worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from cura_torchrl.envs import geometry
from cura_torchrl.envs.config import RewardConfig
from cura_torchrl.envs.mdp import rewards

CONFIG = RewardConfig()


def _f64(values: object) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _corners(x: float, y: float, yaw: float, edge: float = 1.0) -> torch.Tensor:
    position, quaternion = _f64([[x, y, edge / 2]]), geometry.quaternion_from_yaw(_f64([yaw]))
    return geometry.cube_corners(position, quaternion, _f64([edge]))


def test_keypoint_term_takes_the_norm_of_all_24_coordinates():
    """Catches a mean over corners in place of the norm of the 24-vector."""
    # All eight corners are off by (3, 4, 0): the norm is sqrt(8 * 25) = 14.142136, r1 = 4 exp(-0.25 * 14.142136).
    reward = rewards.keypoint_reward(CONFIG, _corners(0.0, 0.0, 0.0), _corners(3.0, 4.0, 0.0))
    assert reward.item() == pytest.approx(4 * math.exp(-0.25 * math.sqrt(200.0)), rel=1e-12)


@pytest.mark.parametrize("turns", [-1, 0, 1, 2, 3])
def test_keypoint_term_is_blind_to_quarter_turns(turns: int):
    """Catches corners that are matched by label: a cube turned by 90 degrees is at the goal."""
    reward = rewards.keypoint_reward(
        CONFIG, _corners(1.0, 2.0, 0.3 + turns * math.pi / 2, 0.75), _corners(1.0, 2.0, 0.3, 0.75)
    )
    assert reward.item() == pytest.approx(4.0, abs=1e-12)


def test_keypoint_term_sees_an_eighth_of_a_turn():
    """Catches a relabelling that forgives any yaw."""
    # Edge 1, yaw off by pi/4: each corner lies on a circle of radius sqrt(0.5) and moves by the chord
    # 2 sqrt(0.5) sin(pi/8); the norm over eight corners is sqrt(8) times that.
    norm = math.sqrt(8.0) * 2 * math.sqrt(0.5) * math.sin(math.pi / 8)
    reward = rewards.keypoint_reward(CONFIG, _corners(0.0, 0.0, math.pi / 4), _corners(0.0, 0.0, 0.0))
    assert reward.item() == pytest.approx(4 * math.exp(-0.25 * norm), rel=1e-12)


@pytest.mark.parametrize(
    ("velocity", "cosine"),
    [
        ((0.5, 0.0), 1.0),  # towards the goal
        ((-0.5, 0.0), -1.0),  # away from it
        ((0.0, 0.5), 0.0),  # across
        ((0.3, 0.4), 0.6),  # 0.3 / 0.5
        ((0.25, 0.0), 1.0),  # just fast enough
        ((0.2499, 0.0), 0.0),  # too slow: the velocity counts as zero
        ((0.0, 0.0), 0.0),
    ],
)
def test_progress_term_reads_the_direction_alone(velocity: tuple[float, float], cosine: float):
    """Catches a dot product of unnormalised vectors and a missing threshold for creeping."""
    reward = rewards.progress_reward(CONFIG, _f64([velocity]), _f64([[1.0, 2.0]]), _f64([[5.0, 2.0]]))
    assert reward.item() == pytest.approx(2 * math.exp(5 * (cosine - 1)), rel=1e-12)


def test_progress_term_has_no_direction_at_the_goal():
    """Catches a division by zero, or full reward, within 0.02 m of the goal."""
    position, goal = _f64([[5.0, 2.0], [5.0, 2.0], [5.0, 2.0]]), _f64([[5.0, 2.0], [5.019, 2.0], [5.021, 2.0]])
    reward = rewards.progress_reward(CONFIG, _f64([[0.5, 0.0]]).expand(3, 2), position, goal)
    # 2 exp(5 (0 - 1)) twice, then 2 exp(0).
    torch.testing.assert_close(reward, _f64([2 * math.exp(-5), 2 * math.exp(-5), 2.0]))


def test_slow_speed_zero_is_the_letter_of_the_paper():
    """Catches a threshold that cannot be turned off: any motion has a direction, rest has none."""
    config = RewardConfig(slow_speed=0.0)
    velocity = _f64([[1e-6, 0.0], [0.0, 0.0]])
    reward = rewards.progress_reward(config, velocity, _f64([[0.0, 0.0]]), _f64([[5.0, 0.0]]))
    torch.testing.assert_close(reward, _f64([2.0, 2 * math.exp(-5)]))


def test_velocity_term_divides_the_planar_speed_by_the_largest():
    """Catches a reward for falling, and a wrong v_max."""
    # ||(0.24, 0.32)|| / 0.8 = 0.4 / 0.8
    assert rewards.velocity_reward(CONFIG, _f64([[0.24, 0.32, -3.0]])).item() == pytest.approx(0.5, rel=1e-12)


def test_contact_term_decays_with_the_distance_in_space():
    """Catches a planar distance, or a wrong decay."""
    # ||(2, 3, 6)|| = 7: exp(-0.7)
    reward = rewards.contact_reward(CONFIG, _f64([[3.0, 4.0, 6.5]]), _f64([[1.0, 1.0, 0.5]]))
    assert reward.item() == pytest.approx(math.exp(-0.7), rel=1e-12)


def test_action_rate_term_is_a_norm_and_not_its_square():
    """Catches the squared penalty that other codebases use."""
    # ||(0.3, 0, -0.4)|| = 0.5: -0.05
    action, previous = _f64([[0.3, 0.5, 0.1]]), _f64([[0.0, 0.5, 0.5]])
    assert rewards.action_rate_reward(CONFIG, action, previous).item() == pytest.approx(-0.05, rel=1e-12)


def test_acceleration_term_is_a_norm_over_the_joints():
    """Catches a mean over joints."""
    # ||(1, 2, 2)|| = 3: -0.3
    assert rewards.acceleration_reward(CONFIG, _f64([[1.0, 2.0, 2.0]])).item() == pytest.approx(-0.3, rel=1e-12)


def _batch(count: int) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(count, *shape, generator=generator, dtype=torch.float64)

    return {
        "object_corners": draw(8, 3), "goal_corners": draw(8, 3), "object_velocity": draw(3),
        "object_position": draw(2), "goal_position": draw(2), "surface_point_w": draw(3), "tcp_position": draw(3),
        "action": draw(6), "previous_action": draw(6), "joint_acceleration": draw(10),
    }  # fmt: skip


def test_terms_are_stacked_in_the_order_of_their_names():
    """Catches a log that shows one term under another's name."""
    batch = _batch(3)
    terms = rewards.reward_terms(CONFIG, **batch)
    assert rewards.REWARD_TERM_NAMES == ("keypoint", "progress", "velocity", "contact", "action_rate", "acceleration")
    assert terms.shape == (3, 6)
    torch.testing.assert_close(terms[:, 2], batch["object_velocity"][:, :2].norm(dim=-1) / 0.8)
    torch.testing.assert_close(terms[:, 5], -0.1 * batch["joint_acceleration"].norm(dim=-1))
    assert (terms[:, :4] > 0).all()
    assert (terms[:, 4:] < 0).all()


def test_every_weight_scales_its_own_term():
    """Catches a weight that is ignored or applied to another term."""
    batch = _batch(2)
    terms = rewards.reward_terms(CONFIG, **batch)
    for index, name in enumerate(rewards.REWARD_TERM_NAMES):
        config = RewardConfig(**{f"{name}_weight": 3 * getattr(CONFIG, f"{name}_weight")})
        scale = torch.ones(6, dtype=torch.float64)
        scale[index] = 3.0
        torch.testing.assert_close(rewards.reward_terms(config, **batch), terms * scale)


def test_terms_are_bitwise_independent_of_the_batch():
    """Catches reductions whose order of summation depends on the batch."""
    batch = _batch(37)
    whole = rewards.reward_terms(CONFIG, **batch)
    for i in range(37):
        one = rewards.reward_terms(CONFIG, **{key: value[i : i + 1] for key, value in batch.items()})
        assert torch.equal(one[0], whole[i])
