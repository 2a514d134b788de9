"""What is measured of an episode can be worked out by hand, and ends with its outcome."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from cura_torchrl.envs.mdp.observations import OBSERVATION_SIZE, OBSERVATION_SLICES
from cura_torchrl.envs.robots import ridgeback_franka as model
from cura_torchrl.trainers.evaluation.measures import EpisodeMeter

PERIOD, FAR = 0.2, 10.0
OPEN = torch.ones(1, dtype=torch.bool)
FRONT = model.CHASSIS_SIZE[0] / 2


def state(
    step: int, x: float = 0.0, *, edge: float = 0.0, at: tuple[float, float] = (4.0, 0.0), ray: float = FAR,
    episode: int = 0,
) -> TensorDict:  # fmt: skip
    """One world: base at (x, 0), TCP 0.9 m and an object of 1 m 1.5 m ahead, goal 3 m ahead, turned by 100 degrees."""
    observation = torch.zeros(1, OBSERVATION_SIZE)
    turned = 4 * math.radians(100.0)
    for name, value in (
        ("tcp_position", (0.9, 0.0, 0.5)),
        ("object_position", (1.5, 0.0, 0.5)),
        ("object_heading", (1.0, 0.0)),
        ("goal_position", (3.0, 0.0)),
        ("goal_heading", (math.cos(turned), math.sin(turned))),
    ):
        observation[:, OBSERVATION_SLICES[name]] = torch.tensor(value)
    obstacles = torch.zeros(1, 6, 4)
    obstacles[0, 1] = torch.tensor([*at, 0.0, edge])
    content = {
        "observation": observation,
        "scan": torch.tensor([[*4 * [FAR], ray, *3 * [FAR]]]),  # the fifth of eight rays points ahead
        "sensor_pose": torch.tensor([[x, 0.0, 0.0]]),
        "object_pose": torch.tensor([[x + 1.5, 0.0, 0.0]]),
        "object_size": torch.ones(1, 2),
        "obstacles": obstacles,
        "elapsed_steps": torch.tensor([[step]]),
        "episode": torch.tensor([[episode]]),
    }
    return TensorDict(content, [1])


def test_an_episode_is_measured_until_its_outcome_and_its_errors_at_its_end() -> None:
    """Catches a path or a clearance that goes on after the goal, and a delay that starts with the episode.

    The object's face is 2 m ahead of the base, the obstacle's 3.75 m from the origin: with the base at 0.5 m 1.25 m
    are between them. It appears in step 2 and is hit in step 3, 0.2 s later, at 0.6 s.
    """
    meter = EpisodeMeter(period=PERIOD, max_range=FAR)
    meter.watch(state(0), OPEN)
    meter.watch(state(1, 0.2), OPEN)
    meter.watch(state(2, 0.1, edge=0.5), OPEN)
    meter.watch(state(3, 0.5, edge=0.5, ray=3.25), OPEN)
    last = state(4, 1.5, edge=0.5)
    meter.watch(last, ~OPEN)
    found = meter.measures(last, 0)
    assert found.min_clearance == pytest.approx(1.25, abs=1e-5)
    assert (found.base_path, found.object_path) == pytest.approx((0.7, 0.7), abs=1e-5)  # 0.2 + 0.1 + 0.4 m
    assert found.goal_distance == pytest.approx(1.5, abs=1e-5)
    assert found.yaw_error == pytest.approx(math.radians(10.0), abs=1e-5)  # 100 degrees, less a quarter turn
    assert (found.obstacles, found.obstacles_unseen) == (1, 0)
    assert (found.first_sighting, found.mean_delay, found.longest_delay) == pytest.approx((0.6, 0.2, 0.2))


def test_the_next_episode_of_a_world_starts_afresh() -> None:
    """Catches a clearance, a path or a sighting that is carried over, also where the same scene is played again."""
    for episode in (0, 1):
        meter = EpisodeMeter(period=PERIOD, max_range=FAR)
        meter.watch(state(0, edge=0.5, ray=3.75), OPEN)
        meter.watch(state(1, 1.0, edge=0.5), OPEN)
        meter.watch(state(0, episode=episode), OPEN)
        last = state(1, 0.25, edge=0.5, at=(-4.0, 0.0), episode=episode)
        meter.watch(last, OPEN)
        found = meter.measures(last, 0)
        assert found.base_path == pytest.approx(0.25)
        assert (found.obstacles, found.obstacles_unseen, found.first_sighting, found.mean_delay) == (1, 1, None, None)
        assert found.min_clearance == pytest.approx(0.25 - FRONT + 4.0 - 0.25, abs=1e-5)  # behind the chassis


def test_where_no_obstacle_appears_there_is_no_clearance() -> None:
    """Catches an infinite number, which neither SQLite nor JSON takes."""
    meter = EpisodeMeter(period=PERIOD, max_range=FAR)
    meter.watch(state(0), OPEN)
    assert meter.measures(state(0), 0).min_clearance is None
