"""What a policy step captured as a CUDA graph needs of the planar worlds, and what it does."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from cura_torchrl import keys
from cura_torchrl.envs.config import PhysicsConfig, PushEnvConfig, RobotConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.simulation import planar

ROWS = 16
STEPS = 20
PLAIN = PushEnvConfig(simulator="planar")
BARE = PushEnvConfig(simulator="planar", robot=RobotConfig(model="ridgeback"))
CAPTURED = dataclasses.replace(PLAIN, physics=PhysicsConfig(planar_graph=True))
OBSERVED = (keys.OBSERVATION, keys.OBJECT_POSE, keys.SENSOR_POSE, keys.SCAN, keys.REWARD, keys.CONTACT)


class Rehearsal:
    """A graph of the CPU: it tries the work, puts the state back as a capture does, and replays by doing the work."""

    def __init__(self, work, state):
        before = [(tensor, tensor.clone()) for tensor in state]
        work()
        for tensor, value in before:
            tensor.copy_(value)
        self.replay = work


def play(config, device="cpu", prepare=None):
    """Push ahead, each world with its own errors, and return what is observed."""
    env = PushEnv(ROWS, config, seed=3, device=device)
    if prepare is not None:
        prepare(env)
    data, generator, seen = env.reset(), torch.Generator().manual_seed(0), []
    for _ in range(STEPS):
        action = 0.3 * (2.0 * torch.rand(env.action_spec.shape, generator=generator) - 1.0)
        action[:, 0] += 0.7
        data = env.step(data.set(keys.ACTION, action.to(device)))["next"]
        seen.append(data.select(*OBSERVED).cpu())
    env.close()
    return torch.stack(seen)


@pytest.mark.parametrize("config", [PLAIN, BARE], ids=["arm", "base"])
def test_a_policy_step_changes_nothing_but_the_state_that_is_put_back(monkeypatch, config):
    """Catches a state that a capture's trials leave changed: robots then start with two steps' impulses behind them."""
    monkeypatch.setattr(planar, "CudaGraph", Rehearsal)
    captured = play(config, prepare=lambda env: setattr(env._worlds, "_is_captured", True))
    assert (captured == play(config)).all()


@pytest.mark.parametrize("config", [PLAIN, BARE], ids=["arm", "base"])
def test_the_state_keeps_its_memory(config):
    """Catches a tensor that is replaced: a graph would go on with the one that it was captured with."""
    env = PushEnv(ROWS, config, seed=3, device="cpu")
    data = env.reset()
    worlds, law = env._worlds, env._controller
    fixed = [*worlds._state(), *law.state(), worlds._inertia, worlds._obstacle_pose, worlds._obstacle_edge]
    before, places = [tensor.clone() for tensor in fixed], [tensor.data_ptr() for tensor in fixed]
    for _ in range(60):
        data = env.step_and_maybe_reset(data.set(keys.ACTION, torch.full(env.action_spec.shape, 0.6)))[1]
    now = [*worlds._state(), *law.state(), worlds._inertia, worlds._obstacle_pose, worlds._obstacle_edge]
    assert [tensor.data_ptr() for tensor in now] == places
    # A bare base's inertia is the same everywhere.
    is_fixed = sum(torch.equal(old, new) for old, new in zip(before, now, strict=True))
    assert is_fixed <= (2 if config is BARE else 1)
    env.close()


def test_on_the_cpu_the_flag_changes_nothing():
    """Catches a policy trained on a GPU that cannot be played without one."""
    assert (play(CAPTURED) == play(PLAIN)).all()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("is_captured", [False, True], ids=["eager", "graph"])
@pytest.mark.parametrize("plain", [PLAIN, BARE], ids=["arm", "base"])
def test_a_gpu_plays_what_the_cpu_plays(plain, is_captured):
    """Catches operations that another device rounds otherwise, and a graph that replays something else."""
    config = dataclasses.replace(plain, physics=PhysicsConfig(planar_graph=is_captured))
    expected, seen = play(plain), play(config, "cuda")
    for key in OBSERVED:
        torch.testing.assert_close(seen[key].double(), expected[key].double(), rtol=0.0, atol=1e-5)
