"""What is reported about a rollout, on rollouts whose story is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from cura_torchrl.envs.mdp.observations import OBSERVATION_SIZE, OBSERVATION_SLICES
from cura_torchrl.trainers.training.diagnostics import (
    Outcome,
    RecentEpisodes,
    collision_within,
    explained_variance,
    find_non_finite,
    finished_episodes,
    rollout_statistics,
)


def rollout(rows: int, steps: int) -> TensorDict:
    """A rollout in which nothing happens."""
    flag = torch.zeros(rows, steps, 1, dtype=torch.bool)
    after = {
        "done": flag.clone(),
        "terminated": flag.clone(),
        "success": torch.zeros(rows, steps, 3, dtype=torch.bool),
        "elapsed_steps": torch.arange(1, steps + 1).expand(rows, steps).unsqueeze(-1).clone(),
        "object_size": torch.full((rows, steps, 2), 0.75),
        "reward_terms": torch.zeros(rows, steps, 6),
        "reward": torch.zeros(rows, steps, 1),
        "observation": torch.zeros(rows, steps, OBSERVATION_SIZE),
    }
    return TensorDict({"next": TensorDict(after, [rows, steps])}, [rows, steps])


def test_an_episode_is_counted_once_and_in_the_order_of_its_end() -> None:
    """Catches collisions after the goal that count as collisions, and time-outs that count as either."""
    batch = rollout(2, 5)
    batch["next", "done"][1, 1] = batch["next", "terminated"][1, 1] = True  # hit, goal not reached
    batch["next", "done"][0, 2] = True  # time-out
    batch["next", "done"][0, 4] = batch["next", "terminated"][0, 4] = True  # hit after the goal was reached
    batch["next", "success"][0, 4, 0] = True
    expected = [
        Outcome(success=False, collision=True, steps=2, object_size=0.75),
        Outcome(success=False, collision=False, steps=3, object_size=0.75),
        Outcome(success=True, collision=False, steps=5, object_size=0.75),
    ]
    assert finished_episodes(batch) == expected


def test_rates_cover_only_the_most_recent_episodes() -> None:
    """Catches rates over the whole run, which hide what the policy does now."""
    recent = RecentEpisodes(2)
    recent.extend([Outcome(success=False, collision=True, steps=10, object_size=0.5)] * 5)
    recent.extend(
        [
            Outcome(success=True, collision=False, steps=100, object_size=0.5),
            Outcome(success=False, collision=False, steps=250, object_size=1.0),
        ]
    )
    rates = recent.rates()
    assert (rates["success"], rates["collision"], rates["timeout"], rates["episodes"]) == (0.5, 0.0, 0.5, 2.0)
    assert (rates["success_0.50m"], rates["success_1.00m"], rates["episode_steps"]) == (1.0, 0.0, 175.0)
    assert math.isnan(RecentEpisodes(2).rates()["success"])


def test_speed_and_reward_terms_are_means_over_the_rollout() -> None:
    """Catches a term reported under another's name."""
    batch = rollout(1, 2)
    batch["next", "reward_terms"][0] = torch.tensor([[1.0, 2, 3, 4, 5, 6], [3.0, 2, 3, 4, 5, 6]])
    batch["next", "observation"][0, 0, OBSERVATION_SLICES["object_velocity"]] = torch.tensor([0.3, 0.4])
    statistics = rollout_statistics(batch)
    assert statistics["reward/keypoint"] == 2.0
    assert statistics["reward/acceleration"] == 6.0
    assert statistics["object_speed"] == pytest.approx(0.25)  # (0.5 + 0) / 2


def test_a_collision_within_the_horizon_is_found_as_a_loop_finds_it() -> None:
    """Catches labels that leak over the end of an episode, or that are certain where the rollout was cut off."""
    generator = np.random.default_rng(1)
    done = generator.random((20, 40)) < 0.08
    terminated = done & (generator.random(done.shape) < 0.5)
    horizon = 6
    label, is_known = collision_within(terminated, done, horizon)
    for row in range(20):
        for step in range(40):
            ahead = [at for at in range(step, 40) if done[row, at]]
            expected = bool(ahead) and terminated[row, ahead[0]] and ahead[0] - step < horizon
            assert label[row, step] == expected
            assert is_known[row, step] == (bool(ahead) or 40 - step >= horizon)


def test_explained_variance_is_1_for_the_target_and_0_for_its_mean() -> None:
    """Catches a ratio that is turned round."""
    target = torch.tensor([1.0, 2.0, 3.0]).unsqueeze(-1)
    batch = TensorDict({"value_target": target, "state_value": target.clone()}, [3])
    assert explained_variance(batch) == 1.0
    batch["state_value"] = torch.full_like(target, 2.0)
    assert explained_variance(batch) == 0.0


def test_the_key_that_is_not_finite_is_named() -> None:
    """Catches a NaN in a nested key that goes unseen into the networks."""
    batch = rollout(1, 2)
    assert find_non_finite(batch) is None
    batch["next", "reward"][0, 1] = float("inf")
    assert find_non_finite(batch) == "next.reward"
