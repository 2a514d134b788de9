"""The observation's layout, frames and symmetries."""

from __future__ import annotations

import math

import pytest
import torch

from cura_torchrl.envs.mdp import observations
from cura_torchrl.envs.mdp.observations import OBSERVATION_SIZE, OBSERVATION_SLICES


def _state(count: int = 1) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(2)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(count, *shape, generator=generator, dtype=torch.float64)

    return {
        "base_pose": draw(3), "base_velocity": draw(3), "tcp_position_b": draw(3), "hand_rotation_b": draw(3, 3),
        "tcp_velocity_b": draw(3), "previous_action": draw(6), "object_position": draw(3), "object_yaw": draw(),
        "object_velocity": draw(3), "object_yaw_rate": draw(), "goal_pose": draw(3),
    }  # fmt: skip


def test_slices_tile_the_observation():
    """Catches a slice that overlaps another or a size that does not add up."""
    # 3 + 6 + 3 + 3 for the robot, 3 + 2 + 2 + 1 for the object, 2 + 2 for the goal, 6 for the action: 33.
    assert OBSERVATION_SIZE == 33
    covered = [index for part in OBSERVATION_SLICES.values() for index in range(part.start, part.stop)]
    assert covered == list(range(33))
    assert observations.observe(**_state(4)).shape == (4, 33)


def test_every_part_is_where_its_slice_says():
    """Catches two parts swapped, a frame forgotten, or columns of the hand's rotation taken as rows."""
    # The base stands at (1, 2) and looks along world y, so world (dx, dy) is base (dy, -dx).
    quarter = math.pi / 2
    state = {
        "base_pose": [1.0, 2.0, quarter],
        "base_velocity": [0.1, 0.2, 0.3],  # base (0.2, -0.1)
        "tcp_position_b": [0.9, 0.1, 0.35],
        "hand_rotation_b": [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]],  # columns (1, 4, 7), (2, 5, 8)
        "tcp_velocity_b": [0.4, 0.5, 0.6],
        "previous_action": [-0.1, -0.2, -0.3, -0.4, -0.5, -0.6],
        "object_position": [1.5, 4.0, 0.375],  # world offset (0.5, 2): base (2, -0.5)
        "object_yaw": quarter + math.pi / 16,  # four times pi/16: cos, sin of pi/4
        "object_velocity": [0.7, 0.8, 0.9],  # base (0.8, -0.7)
        "object_yaw_rate": 1.1,
        "goal_pose": [1.0, 12.0, quarter + math.pi / 8],  # 10 m ahead; four times pi/8: cos, sin of pi/2
    }
    observation = observations.observe(**{k: torch.tensor([v], dtype=torch.float64) for k, v in state.items()})
    root = math.sqrt(0.5)
    expected = {
        "tcp_position": [0.9, 0.1, 0.35],
        "hand_axes": [1.0, 4.0, 7.0, 2.0, 5.0, 8.0],
        "tcp_velocity": [0.4, 0.5, 0.6],
        "base_velocity": [0.2, -0.1, 0.3],
        "object_position": [2.0, -0.5, 0.375],
        "object_heading": [root, root],
        "object_velocity": [0.8, -0.7],
        "object_yaw_rate": [1.1],
        "goal_position": [10.0, 0.0],
        "goal_heading": [0.0, 1.0],
        "previous_action": [-0.1, -0.2, -0.3, -0.4, -0.5, -0.6],
    }
    assert list(expected) == list(OBSERVATION_SLICES)
    for name, values in expected.items():
        part = observation[0, OBSERVATION_SLICES[name]]
        torch.testing.assert_close(part, torch.tensor(values), atol=1e-6, rtol=0)  # float32 output


@pytest.mark.parametrize("turns", [1, 2, 3, -1])
def test_quarter_turns_of_object_and_goal_are_not_seen(turns: int):
    """Catches a heading that tells a cube from the same cube turned by 90 degrees."""
    state = _state(5)
    before = observations.observe(**state)
    state["object_yaw"] = state["object_yaw"] + turns * math.pi / 2
    state["goal_pose"] = state["goal_pose"] + torch.tensor([0.0, 0.0, turns * math.pi / 2], dtype=torch.float64)
    torch.testing.assert_close(observations.observe(**state), before, atol=1e-6, rtol=0)


def test_moving_and_turning_the_world_is_not_seen():
    """Catches a world-frame quantity in the observation, which would tie the policy to one place."""
    state = _state(5)
    before = observations.observe(**state)
    angle = 0.83
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]], dtype=torch.float64)
    shift = torch.tensor([3.0, -7.0], dtype=torch.float64)
    for key in ("base_pose", "object_position", "goal_pose"):
        state[key] = torch.cat((state[key][:, :2] @ turn.T + shift, state[key][:, 2:]), -1)
    for key in ("base_velocity", "object_velocity"):
        state[key] = torch.cat((state[key][:, :2] @ turn.T, state[key][:, 2:]), -1)
    for key in ("base_pose", "goal_pose"):
        state[key] = state[key] + torch.tensor([0.0, 0.0, angle], dtype=torch.float64)
    state["object_yaw"] = state["object_yaw"] + angle
    torch.testing.assert_close(observations.observe(**state), before, atol=1e-5, rtol=0)


def test_a_shorter_action_only_shortens_the_vector():
    """Catches a layout in which the base-only robot's three actions shift every later part."""
    state = _state(2)
    full = observations.observe(**state)
    state["previous_action"] = state["previous_action"][:, :3]
    torch.testing.assert_close(observations.observe(**state), full[:, :-3], atol=0, rtol=0)


def test_observation_is_bitwise_independent_of_the_batch():
    """Catches kernels whose result depends on a row's place in the batch."""
    state = _state(37)
    whole = observations.observe(**state)
    assert whole.dtype == torch.float32
    for i in range(37):
        one = observations.observe(**{key: value[i : i + 1] for key, value in state.items()})
        assert torch.equal(one[0], whole[i])
