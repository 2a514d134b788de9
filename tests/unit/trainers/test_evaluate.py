"""Each scenario is played once, and its outcome is what happened."""

from __future__ import annotations

import dataclasses
import json

import pytest
import torch

from cura_torchrl.envs.config import PushEnvConfig, TaskConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.trainers import evaluate as module
from cura_torchrl.trainers.config import EvaluateConfig
from cura_torchrl.trainers.evaluate import Episode, evaluate, play_episodes, summarise

REQUIRED = {
    "method", "scenario", "object_size", "episodes", "successes", "success_rate", "wilson_low", "wilson_high",
    "collisions", "timeouts", "success_rate_025", "success_rate_010_10deg", "mean_steps",
}  # fmt: skip


def episode(index: int, *, success: tuple[bool, ...] = (False, False, False), collision: bool = False) -> Episode:
    """An episode of 10 steps."""
    contact = (False, False, collision)
    return Episode(index=index, success=success, collision=collision, contact=contact, tipped=False, steps=10)


def test_outcomes_add_up_to_the_episodes() -> None:
    """Catches an episode that is both a success and a collision, or neither nor a time-out."""
    result = summarise(
        [
            episode(0, success=(True, True, False)),
            episode(1, success=(True, False, False)),
            episode(2, collision=True),
            episode(3),
        ]
    )
    assert (result["successes"], result["collisions"], result["timeouts"], result["episodes"]) == (2, 1, 1, 4)
    assert (result["success_rate"], result["success_rate_025"], result["success_rate_010_10deg"]) == (0.5, 0.25, 0.0)
    assert result["collisions_by"] == {"base": 0, "arm": 0, "object": 1}
    # Wilson for 2 of 4, z^2 = 3.841459: centre 0.5, half width 1.959964 sqrt(0.0625 + 0.060023) / 1.960365 = 0.34996
    assert (result["wilson_low"], result["wilson_high"]) == pytest.approx((0.150039, 0.849961), abs=1e-5)


def test_a_world_that_is_over_waits_for_the_others_and_is_counted_once() -> None:
    """Catches an auto-reset in evaluation, which would count more scenes of those that end early."""
    task = TaskConfig(stream="eval", episode_time=1.0)
    env = PushEnv(2, PushEnvConfig(task=task))
    seen = []
    try:
        played = play_episodes(
            env, env.rand_action, torch.tensor([7, 3]), watch=lambda state, rows: seen.append((state["episode"], rows))
        )
    finally:
        env.close()
    assert [entry.index for entry in played] == [7, 3]
    assert [entry.steps for entry in played] == [5, 5]  # 1 s at 5 Hz
    assert all(state.flatten().tolist() == [7, 3] for state, _ in seen)
    assert len(seen) == 6


@pytest.fixture
def short_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """Episodes of 1 s, so that an evaluation is over at once."""
    build = module._task
    monkeypatch.setattr(
        module, "_task", lambda task, config: dataclasses.replace(build(task, config), episode_time=1.0)
    )


@pytest.mark.usefixtures("short_task")
def test_the_result_has_what_scripts_rely_on_and_is_json() -> None:
    """Catches a renamed key, and a number that JSON does not know."""
    result = evaluate(EvaluateConfig(policy="random", episodes=3, chunk=2, max_obstacles=0))
    assert set(result) >= REQUIRED
    assert result["episodes"] == 3  # the second chunk's surplus is not counted
    assert (result["method"], result["timeouts"], result["mean_steps"]) == ("random", 3, 5.0)
    json.dumps(result, allow_nan=False)


@pytest.mark.usefixtures("short_task")
def test_the_same_evaluation_gives_the_same_result() -> None:
    """Catches an evaluation that depends on what was played before."""
    config = EvaluateConfig(policy="random", episodes=2, chunk=2, object_size=1.0)
    assert evaluate(config) == evaluate(config)


@pytest.mark.slow
def test_the_result_does_not_depend_on_the_number_of_processes() -> None:
    """Catches processes that play the same scenes, or a scene that depends on who plays it."""
    config = EvaluateConfig(policy="scripted", episodes=3, chunk=2)
    assert evaluate(config) == evaluate(dataclasses.replace(config, num_workers=2))
