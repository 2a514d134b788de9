"""Properties of the task's geometry, rewards and scenes for any input."""

from __future__ import annotations

import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cura_torchrl.envs import geometry
from cura_torchrl.envs.config import RewardConfig, ScenarioConfig
from cura_torchrl.envs.mdp import rewards
from cura_torchrl.envs.mdp.scenarios import sample_scenarios

_lengths = st.floats(-20, 20)
_angles = st.floats(-50, 50)
_halves = st.floats(0, 3)
_poses = st.tuples(_lengths, _lengths, _angles)


def _f64(values: object) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


@settings(deadline=None)
@given(_poses, st.tuples(_lengths, _lengths))
def test_frames_round_trip(pose: tuple, point: tuple):
    """Catches to_frame and from_frame that are not inverse to each other."""
    there = geometry.from_frame(_f64(pose), geometry.to_frame(_f64(pose), _f64(point)))
    torch.testing.assert_close(there, _f64(point), atol=1e-12, rtol=0)


@settings(deadline=None)
@given(_angles)
def test_wrapping_keeps_the_direction_and_stays_in_the_interval(angle: float):
    """Catches a wrap that changes the direction or leaves the interval at its ends."""
    turn, quarter = geometry.wrap_angle(_f64(angle)).item(), geometry.quarter_turn(_f64(angle)).item()
    assert -math.pi <= turn < math.pi
    assert -math.pi / 4 <= quarter < math.pi / 4
    assert math.isclose(math.cos(turn), math.cos(angle), abs_tol=1e-12)
    assert math.isclose(math.sin(4 * quarter), math.sin(4 * angle), abs_tol=1e-12)


@settings(deadline=None)
@given(_lengths, _lengths)
def test_angle_of_agrees_with_the_standard_library(x: float, y: float):
    """Catches a wrong octant of the arctangent."""
    expected = math.atan2(y, x) if x or y else 0.0  # the zero vector's angle is zero, whatever the zeros' signs
    angle = geometry.angle_of(_f64((x, y))).item()
    assert math.isclose(math.remainder(angle - expected, 2 * math.pi), 0.0, abs_tol=1e-14)


@settings(deadline=None)
@given(_poses, st.tuples(_halves, _halves), _poses, st.tuples(_halves, _halves), _poses)
def test_rectangle_distance_is_symmetric_and_bounded_and_blind_to_the_frame(a, half_a, b, half_b, motion):
    """Catches a distance that depends on the order or on where the world's origin is."""
    pose_a, pose_b, half_a, half_b = (_f64(x) for x in (a, b, half_a, half_b))
    distance = geometry.rectangle_distance(pose_a, half_a, pose_b, half_b)
    torch.testing.assert_close(
        distance, geometry.rectangle_distance(pose_b, half_b, pose_a, half_a), atol=1e-12, rtol=0
    )
    centres = geometry.norm(pose_a[:2] - pose_b[:2])
    assert distance <= centres + 1e-12
    assert distance >= centres - geometry.norm(half_a) - geometry.norm(half_b) - 1e-12
    moved = [
        torch.cat((geometry.from_frame(_f64(motion), pose[:2]), pose[2:] + motion[2])) for pose in (pose_a, pose_b)
    ]
    again = geometry.rectangle_distance(moved[0], half_a, moved[1], half_b)
    torch.testing.assert_close(again, distance, atol=1e-10, rtol=0)


@settings(deadline=None)
@given(_poses, _poses, st.sampled_from((0.5, 0.75, 1.0)), st.integers(0, 3))
def test_keypoint_reward_is_largest_at_the_goal_and_blind_to_quarter_turns(pose, goal, edge, turns):
    """Catches a relabelling that changes the reward of the same cube."""

    def corners(x: float, y: float, yaw: float) -> torch.Tensor:
        return geometry.cube_corners(_f64((x, y, edge / 2)), geometry.quaternion_from_yaw(_f64(yaw)), _f64(edge))

    config = RewardConfig()
    reward = rewards.keypoint_reward(config, corners(*pose), corners(*goal))
    turned = rewards.keypoint_reward(config, corners(pose[0], pose[1], pose[2] + turns * math.pi / 2), corners(*goal))
    assert 0 <= reward <= 4
    torch.testing.assert_close(reward, turned, atol=1e-10, rtol=0)


@settings(deadline=None)
@given(st.sampled_from(("train", "eval", "vae")), st.integers(0, 2**63), st.lists(st.integers(0, 2**62), min_size=1))
def test_any_scene_is_the_same_alone_and_in_a_batch(stream, seed, episodes):
    """Catches draws that depend on the batch for some seed or episode."""
    arguments = {"stream": stream, "seed": seed, "max_obstacles": None, "tcp_reach": 0.9}
    whole = sample_scenarios(ScenarioConfig(), episodes=torch.tensor(episodes), **arguments)
    last = sample_scenarios(ScenarioConfig(), episodes=torch.tensor(episodes[-1:]), **arguments)
    assert (whole[-1:] == last).all()
