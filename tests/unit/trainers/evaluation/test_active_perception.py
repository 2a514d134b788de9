"""Looking is measured where the object goes, from the first ray that hits, and anew in every episode."""

from __future__ import annotations

import math
from contextlib import closing

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from cura_torchrl.envs.config import LidarConfig, PushEnvConfig, TaskConfig
from cura_torchrl.envs.mdp.observations import OBSERVATION_SIZE, OBSERVATION_SLICES
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.robots.scripted import ScriptedPusher
from cura_torchrl.trainers.evaluation.active_perception import (
    AHEAD,
    MARGIN,
    SIGHT_MAP,
    LookingMeter,
    obstacles_hit,
    unseen_ahead,
)
from cura_torchrl.trainers.evaluation.episodes import play_episodes

PERIOD = 0.2
FAR = 10.0


def test_only_the_area_ahead_of_the_object_counts():
    """Catches an area behind, beside or under the object: all else is unseen here, and it must not matter."""
    maps = torch.zeros(2, 2, 100, 100)
    # Cell i covers (i - 50) * 0.1 m onwards: ahead of a face at x = 1.5 m, and of one at y = 1.5 m.
    low, high, side = 65, 65 + round(AHEAD / 0.1) + 1, round((0.5 + MARGIN) / 0.1)
    maps[0, 0, low:high, 50 - side : 50 + side + 1] = 1.0
    maps[1, 0, 50 - side : 50 + side + 1, low:high] = 1.0
    centre, ahead = torch.tensor([[1.0, 0.0], [0.0, 1.0]]), torch.eye(2)
    half = torch.full((2, 1), 0.5)
    assert unseen_ahead(maps, centre, half, ahead, 0.1).tolist() == [0.0, 0.0]
    assert unseen_ahead(maps, centre, half, ahead.flip(0), 0.1).min() > 0.5


def test_half_of_the_area_seen_at_half_confidence_leaves_three_quarters_unseen():
    """Catches a mean of something else than 1 - M."""
    maps = torch.zeros(1, 2, 100, 100)
    maps[0, 0, :, 50:] = 0.5  # the left half of what is ahead
    found = unseen_ahead(maps, torch.tensor([[1.0, 0.0]]), torch.tensor([[0.5]]), torch.tensor([[1.0, 0.0]]), 0.1)
    assert found.item() == pytest.approx(0.75, abs=0.05)


def test_a_ray_that_ends_on_an_obstacle_has_hit_it_and_not_the_one_behind():
    """Catches hits by bearing alone, and obstacles that are not there yet."""
    obstacles = torch.tensor([[[3.0, 0.0, 0.3, 0.0], [3.0, 0.0, 0.0, 1.0], [6.0, 0.0, 0.0, 1.0]]])
    scan = torch.full((1, 4), FAR)
    scan[0, 2] = 2.5  # ahead: rays point at -pi, -pi/2, 0, pi/2
    pose = torch.zeros(1, 3)
    assert obstacles_hit(scan, pose, obstacles, FAR).tolist() == [[False, True, False]]
    assert not obstacles_hit(torch.full((1, 4), FAR), pose, obstacles, FAR).any()


def test_a_miss_at_full_range_is_no_hit():
    """Catches an obstacle at the end of the range that is hit by every ray that hits nothing."""
    obstacles = torch.tensor([[[FAR + 0.5, 0.0, 0.0, 1.0]]])
    assert not obstacles_hit(torch.full((1, 4), FAR), torch.zeros(1, 3), obstacles, FAR).any()


class _Env:
    """Takes the transform that the meter appends."""

    def append_transform(self, transform):
        self.transform = transform


def _state(*, step, episode=0, edge=1.0, distance=FAR, velocity=(0.5, 0.0)):
    """Return one world: object 1 m ahead at a speed, an obstacle 4 m ahead, one of eight rays forward."""
    observation = torch.zeros(1, OBSERVATION_SIZE)
    observation[:, OBSERVATION_SLICES["object_position"]] = torch.tensor([1.0, 0.3, 0.25])
    observation[:, OBSERVATION_SLICES["object_velocity"]] = torch.tensor(velocity)
    obstacles = torch.zeros(1, 6, 4)
    obstacles[0, 2] = torch.tensor([4.0, 0.0, 0.0, edge])
    content = {
        "observation": observation,
        "scan": torch.tensor([[*4 * [FAR], distance, *3 * [FAR]]]),
        "sensor_pose": torch.zeros(1, 3),
        "object_pose": torch.tensor([[1.0, 0.0, 0.0]]),
        "obstacles": obstacles,
        "elapsed_steps": torch.tensor([[step]]),
        "episode": torch.tensor([[episode]]),
        SIGHT_MAP: torch.zeros(1, 2, 100, 100),
    }
    return TensorDict(content, [1])


PLAYING = torch.ones(1, dtype=torch.bool)


def test_the_wait_runs_from_appearance_to_the_first_hit_and_again_in_the_next_episode():
    """Catches a clock that starts with the episode, counts every hit, or carries over: waits of 2 and 1 steps."""
    meter = LookingMeter(_Env(), LidarConfig(num_rays=8), PERIOD)
    hit = 3.5
    for state in (
        _state(step=1, edge=0.0),
        _state(step=2),
        _state(step=4, distance=hit),
        _state(step=9, distance=hit),
        _state(step=0, episode=1, edge=0.0),
        _state(step=3, episode=1),
        _state(step=4, episode=1, distance=hit),
    ):
        meter.watch(state, PLAYING)
    found = meter.summary()
    assert found["first_seen_s"] == pytest.approx((2 + 1) / 2 * PERIOD)
    assert found["first_seen_m"] == pytest.approx(3.0)


def test_beside_is_across_the_objects_way_and_only_while_it_moves():
    """Catches the distance to the object in place of that to its way: 0.3 m along x, 1 m along y."""
    meter = LookingMeter(_Env(), LidarConfig(num_rays=8), PERIOD)
    meter.watch(_state(step=1, distance=3.5), PLAYING)
    meter.watch(_state(step=2, velocity=(0.0, 0.1)), PLAYING)
    assert meter.summary()["beside_median_m"] == pytest.approx(0.3)
    sideways = LookingMeter(_Env(), LidarConfig(num_rays=8), PERIOD)
    sideways.watch(_state(step=1, distance=3.5, velocity=(0.0, 0.5)), PLAYING)
    assert sideways.summary()["beside_median_m"] == pytest.approx(1.0)


def test_who_sees_through_the_object_sees_more_of_what_is_ahead():
    """Catches a map that is not that of the rays: the same pusher on the same scenes, with and without occlusion."""
    unseen = {}
    for occlusion in (True, False):
        lidar = LidarConfig(occlusion=occlusion)
        config = PushEnvConfig(simulator="planar", lidar=lidar, task=TaskConfig(stream="eval", privileged=True))
        with closing(TransformedEnv(PushEnv(6, config, seed=5))) as env:
            meter = LookingMeter(env, lidar, config.task.policy_period)
            play_episodes(env, ScriptedPusher(), torch.arange(6), watch=meter.watch)
        found = meter.summary()
        assert all(math.isfinite(value) for value in found.values())
        assert 0.3 < found["object_speed"] < 0.8
        unseen[occlusion] = found["unseen_ahead"]
    assert unseen[True] > unseen[False] + 0.2
