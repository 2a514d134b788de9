"""The pushing task as Gymnasium sees it."""

from __future__ import annotations

import dataclasses
import importlib
from types import SimpleNamespace
from typing import TYPE_CHECKING

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from tensordict import TensorDict

from cura_torchrl import PushEnv, register_gym
from cura_torchrl.envs.config import PushEnvConfig
from cura_torchrl.trainers.build import make_env
from cura_torchrl.trainers.errors import UnavailableError
from cura_torchrl.trainers.gym_env import PushGym
from cura_torchrl.trainers.methods import method

if TYPE_CHECKING:
    from collections.abc import Iterator

ACTION = np.array([0.8, -0.2, 0.3, 0.1, -0.4, 0.5], dtype=np.float32)


@pytest.fixture(scope="module")
def env() -> Iterator[PushGym]:
    """One world for all tests: each resets it."""
    env = PushGym(simulator="planar")
    yield env
    env.close()
    env.close()


@pytest.mark.filterwarnings("ignore:.*A Box observation space m..imum value is -?infinity")  # positions have no bound
def test_gymnasium_finds_nothing_wrong(env: PushGym) -> None:
    """Catches shapes and types that differ from the spaces, and a seed that does not begin the same episode again."""
    check_env(env, skip_render_check=True)


def test_gymnasium_makes_it_by_name() -> None:
    """Catches a registration that fails the second time, or loses the keyword arguments."""
    assert register_gym() == register_gym() == "cura_torchrl/Push-v0"
    made = gymnasium.make("cura_torchrl/Push-v0", simulator="planar", max_obstacles=0)
    _, info = made.reset(seed=1)
    assert isinstance(made.unwrapped, PushGym)
    assert info["scenario"] == 0
    made.close()


def test_plays_the_scenarios_of_the_seed(env: PushGym) -> None:
    """Catches another world than PushEnv's, and a policy that would see something else than a method's does."""
    config = PushEnvConfig(simulator="planar")
    plain = PushEnv(1, config, seed=7)
    state = plain.reset(episodes=torch.tensor([2]))
    observation, info = env.reset(seed=7, options={"scenario": 2})
    assert info["scenario"] == 2
    np.testing.assert_array_equal(observation[:33], state["observation"][0].numpy())
    for _ in range(2):
        state = plain.step(state.set("action", torch.from_numpy(ACTION)[None]))["next"]
        observation, reward, terminated, truncated, info = env.step(ACTION)
        assert (reward, info["cost"]) == (state["reward"].item(), state["cost"].item())
        assert (terminated, truncated) == (state["terminated"].item(), state["truncated"].item())
        np.testing.assert_array_equal(observation[:33], state["observation"][0].numpy())
    plain.close()
    _, info = env.reset()
    assert info["scenario"] == 3


@pytest.mark.parametrize("name", ["cura-ppo", "push-no-occlusion"])
def test_sees_what_the_method_sees(name: str) -> None:
    """Catches a code of another map: the methods differ in decay and occlusion."""
    preset = method(name)
    task = dataclasses.replace(preset.env.task, curriculum=(), random_first_age=False)
    played = dataclasses.replace(preset.env, task=task, simulator="planar")
    inner = make_env(preset.replace(env=played, simulator="planar"), 1, seed=5)
    expected = inner.reset(episodes=torch.tensor([4]))["latent"][0].numpy()
    env = PushGym(method=name, simulator="planar")
    observation, _ = env.reset(seed=5, options={"scenario": 4})
    np.testing.assert_allclose(observation[33:], expected, atol=1e-5)
    env.close()
    inner.close()


def test_tells_how_an_episode_went(env: PushGym, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a collision that truncates, a cost that is lost, and contacts and tolerances in each other's place."""
    state = TensorDict(
        observation=torch.zeros(1, 33),
        latent=torch.zeros(1, 32),
        reward=torch.tensor([[-2.5]]),
        cost=torch.ones(1, 1),
        terminated=torch.tensor([[True]]),
        truncated=torch.tensor([[False]]),
        contact=torch.tensor([[False, True, False]]),
        success=torch.tensor([[True, False, False]]),
        episode=torch.tensor([[9]]),
        batch_size=[1],
    )
    env.reset(seed=0)
    monkeypatch.setattr(env, "_env", SimpleNamespace(step=lambda _: {"next": state}, close=lambda **_: None))
    _, reward, terminated, truncated, info = env.step(ACTION)
    assert (reward, terminated, truncated) == (-2.5, True, False)
    assert (info["cost"], info["is_success"], info["scenario"]) == (1.0, True, 9)
    assert info["contact"].tolist() == [False, True, False]
    assert info["success"].tolist() == [True, False, False]


def test_mistakes_are_told(env: PushGym) -> None:
    """Catches options that are not heard, and a step into nowhere."""
    with pytest.raises(ValueError, match=r"options is \['goal'\]; accepted: scenario"):
        env.reset(options={"goal": 1})
    with pytest.raises(ValueError, match="scenario is -1; accepted"):
        env.reset(options={"scenario": -1})
    with pytest.raises(ValueError, match="method is 'cura'"):
        PushGym(method="cura")
    fresh = PushGym(simulator="planar")
    with pytest.raises(RuntimeError, match="not been reset"):
        fresh.step(ACTION)
    fresh.close()


def test_gymnasium_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a traceback that does not say what to install."""

    def refuse(name: str) -> None:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(importlib, "import_module", refuse)
    with pytest.raises(UnavailableError, match=r"cura-torchrl\[gym\]"):
        register_gym()
