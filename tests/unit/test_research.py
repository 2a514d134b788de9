"""What the experiments in benchmarks/research rely on."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING

import pytest
import torch
from tensordict import TensorDict

from cura_torchrl.trainers.loaded_policy import load_policy

if TYPE_CHECKING:
    from pathlib import Path

Load = Callable[[str], ModuleType]


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Load:
    """Return what imports an experiment's module, which is in no package."""
    monkeypatch.syspath_prepend(request.config.rootpath / "benchmarks" / "research")
    return importlib.import_module


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


def test_an_estimator_with_more_atoms_predicts_the_same(load: Load, tmp_path: Path) -> None:
    """Catches atoms that are dealt out in another order, and a part of the networks that is lost."""
    before = load_policy("cura-ppo")
    after = load_policy(load("more_atoms").widen("cura-ppo", 3, tmp_path / "wide"))
    state = TensorDict(observation=torch.randn(5, 33), latent=torch.randn(5, 32), batch_size=[5])
    old, new = (loaded.collision_estimator(state.clone())["collision_atoms"] for loaded in (before, after))
    assert (after.config.cura.num_atoms, new.shape) == (150, (5, 150))
    assert (new - old.repeat_interleave(3, dim=-1)).abs().max() < 0.1
    assert new.unique().numel() > old.unique().numel()
    assert torch.equal(*(loaded.critic(state.clone())["state_value"] for loaded in (before, after)))
