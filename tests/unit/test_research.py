"""What the experiments in benchmarks/research rely on."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from types import ModuleType

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv

from cura_torchrl.envs.config import MapConfig, PushEnvConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.transforms import ConfidenceMap

Load = Callable[[str], ModuleType]


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Load:
    """Return what imports an experiment's module, which is in no package."""
    monkeypatch.syspath_prepend(request.config.rootpath / "benchmarks" / "research")
    return importlib.import_module


def _env(rows: int) -> TransformedEnv:
    env = PushEnv(rows, PushEnvConfig(simulator="planar"), seed=5)
    coarse = MapConfig(resolution=0.5, window=20)
    return TransformedEnv(env, Compose(ConfidenceMap(coarse, num_rays=360, max_range=10.0)))


def test_clones_of_a_world_go_on_exactly_as_it_does(load: Load) -> None:
    """Catches a part of the state that is not copied: clones would drift from their world."""
    clone = load("clone")
    source, target = _env(3), _env(4)
    state = source.rollout(6)[:, -1]["next"]
    target.rand_step(target.reset())
    clone.copy_world(source, 2, target)
    action = torch.full((1, 6), 0.5)
    for _ in range(3):
        state = source.step(state.set("action", action.expand(3, 6)))["next"]
        copies = target.step(TensorDict({"action": action.expand(4, 6)}, [4]))["next"]
        for key in ("observation", "scan", "object_pose", "confidence_map"):
            # Batches of another size round differently in the last bits.
            torch.testing.assert_close(copies[key], state[key][2:].expand_as(copies[key]), atol=1e-5, rtol=0.0)


def test_varied_clones_differ_in_noise_and_in_obstacles_to_come(load: Load) -> None:
    """Catches seeds that change nothing, or that move the robot or the obstacles that are there."""
    clone = load("clone")
    source, target = _env(3), _env(4)
    source.rollout(3)
    target.rand_step(target.reset())
    clone.copy_world(source, 0, target)
    present, where, _ = target.base_env.obstacles
    clone.vary(target, torch.arange(4))
    copies = target.step(TensorDict({"action": torch.zeros(4, 6)}, [4]))["next"]
    assert (copies["scan"][0] - copies["scan"][1]).abs().max() > 1e-3
    assert torch.equal(copies["object_pose"], copies["object_pose"][:1].expand(4, 3))
    assert torch.equal(target.base_env.obstacles[1][present], where[present])
    times = target.base_env.scenario["obstacle_time"][~present]
    assert ((times >= 0.6) & (times <= 15.0) | (times == 1e9)).all()  # three steps have been played
    assert len(times.unique()) > 2


def test_a_seeing_pusher_knows_an_obstacle_once_a_ray_has_hit_it(load: Load) -> None:
    """Catches knowledge of obstacles that the object hides, or that is lost when they are hidden again."""
    policy = load("lookers").SeeingPusher()
    obstacles = torch.zeros(1, 6, 4)
    obstacles[0, 0] = torch.tensor([3.0, 0.0, 0.0, 0.6])  # its face is 2.7 m ahead
    state = TensorDict(
        observation=torch.ones(1, 33), sensor_pose=torch.zeros(1, 3), obstacles=obstacles,
        elapsed_steps=torch.zeros(1, 1, dtype=torch.int64), scan=torch.full((1, 360), 10.0), batch_size=[1],
    )  # fmt: skip
    known = []
    for step, ahead in enumerate((1.0, 2.7, 1.0)):
        state["scan"][0, 180] = ahead
        state["elapsed_steps"][:] = step
        policy(state)
        known.append(policy.known[0].tolist())
    assert known == [[False] * 6, [True] + [False] * 5, [True] + [False] * 5]


def test_costs_are_summed_over_the_steps_before_a_collision(load: Load) -> None:
    """Catches a window that holds the collision's own step, or steps of another episode."""
    crash = load("crash_reward")
    terminated = torch.zeros(1, 30, dtype=torch.bool)
    terminated[0, [4, 24]] = True  # the first has too short a past
    episode = torch.zeros(1, 30, dtype=torch.int64)
    episode[0, 5:] = 1
    ends = crash.collisions({"terminated": terminated.numpy(), "episode": episode.numpy()}, 10)
    assert ends.tolist() == [[0, 24]]
    values = torch.arange(30.0)[None].numpy()
    assert crash.window_sums(values, ends - [0, 10]).tolist() == [sum(range(14, 24))]
