"""Each scenario is played once, and its outcome is what happened."""

from __future__ import annotations

import dataclasses
import json
from contextlib import closing

import pytest
import torch

from cura_torchrl.envs.config import MapConfig, PushEnvConfig, TaskConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.trainers import evaluate as module
from cura_torchrl.trainers.build import Networks, make_env
from cura_torchrl.trainers.config import EvaluateConfig, TrainConfig
from cura_torchrl.trainers.evaluate import Episode, Player, evaluate, play_episodes, summarise

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
            episode(3),
            episode(1, success=(True, False, False)),
            episode(0, success=(True, True, False)),
            episode(2, collision=True),
        ]
    )
    assert (result["successes"], result["collisions"], result["timeouts"], result["episodes"]) == (2, 1, 1, 4)
    assert (result["success_rate"], result["success_rate_025"], result["success_rate_010_10deg"]) == (0.5, 0.25, 0.0)
    assert result["collisions_by"] == {"base": 0, "arm": 0, "object": 1}
    assert result["outcomes"] == "ssct"  # by the scenario's index, in whatever order they ended
    # Wilson for 2 of 4, z^2 = 3.841459: centre 0.5, half width 1.959964 sqrt(0.0625 + 0.060023) / 1.960365 = 0.34996
    assert (result["wilson_low"], result["wilson_high"]) == pytest.approx((0.150039, 0.849961), abs=1e-5)


def test_a_world_that_is_over_takes_the_next_scene_or_stands_still() -> None:
    """Catches scenes that are left out or counted twice: those that end early would weigh more or less than others."""
    env = PushEnv(2, PushEnvConfig(task=TaskConfig(stream="eval", episode_time=1.0)))
    seen, told = [], []
    try:
        played = play_episodes(
            env,
            env.rand_action,
            torch.tensor([7, 3, 11]),
            report=told.append,
            watch=lambda state, rows: seen.append((state["episode"].flatten().tolist(), rows.tolist())),
        )
    finally:
        env.close()
    assert [entry.index for entry in played] == [7, 3, 11]
    assert told == played
    assert [entry.steps for entry in played] == [5, 5, 5]  # 1 s at 5 Hz
    # The start and five steps of two scenes, then five steps of the third while the other world stands still.
    assert seen == [([7, 3], [True, True])] * 6 + [([11, 3], [True, False])] * 5


def test_a_single_scene_is_played_once_whatever_the_number_of_worlds() -> None:
    """Catches worlds without a scene whose episodes are counted."""
    env = PushEnv(2, PushEnvConfig(task=TaskConfig(stream="eval", episode_time=1.0)))
    seen = []
    try:
        played = play_episodes(
            env, env.rand_action, torch.tensor([5]), watch=lambda _, rows: seen.append(rows.tolist())
        )
    finally:
        env.close()
    assert [(entry.index, entry.steps) for entry in played] == [(5, 5)]
    assert seen == [[True, False]] * 6


def windows_of(scenes: list[int]) -> torch.Tensor:
    """What one world sees in scenes of 15 steps under an untrained policy, shape ``[steps, 2, 20, 20]``."""
    config = TrainConfig(
        perception="none",
        map=MapConfig(window=20),
        env=PushEnvConfig(task=TaskConfig(stream="eval", episode_time=3.0)),
    )
    env, windows = make_env(config, 1, keep_map=True), []
    torch.manual_seed(0)
    try:
        play_episodes(
            env,
            Networks(config).actor,
            torch.tensor(scenes),
            watch=lambda state, _: windows.append(state["confidence_map"][0]),
        )
    finally:
        env.close()
    return torch.stack(windows)


def test_what_is_seen_in_a_scene_does_not_depend_on_the_scenes_before_it() -> None:
    """Catches a map, a pose or a clock that is carried from one scene of a world to the next."""
    # The start is watched in the first scene only: scene 9 is windows 16 to 30 in one order, 31 to 45 in the other.
    second, third = windows_of([4, 9, 2])[16:31], windows_of([2, 4, 9])[31:46]
    assert torch.equal(second, third)
    assert not torch.equal(second[0], second[-1])


@pytest.fixture
def short_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """Episodes of 1 s, so that an evaluation is over at once."""
    build = module.evaluation_task
    monkeypatch.setattr(
        module, "evaluation_task", lambda task, config: dataclasses.replace(build(task, config), episode_time=1.0)
    )


@pytest.mark.usefixtures("short_task")
def test_the_result_has_what_scripts_rely_on_and_is_json() -> None:
    """Catches a renamed key, and a number that JSON does not know."""
    result = evaluate(EvaluateConfig(policy="random", episodes=3, chunk=2, max_obstacles=0))
    assert set(result) >= REQUIRED
    assert result["episodes"] == 3  # the second world stands still in the end
    assert (result["method"], result["timeouts"], result["mean_steps"]) == ("random", 3, 5.0)
    json.dumps(result, allow_nan=False)


@pytest.mark.usefixtures("short_task")
@pytest.mark.parametrize("policy", ["scripted", "avoider", "random"])
def test_the_base_alone_is_played_by_name(policy: str) -> None:
    """Catches a robot that is named in the result and another one that plays."""
    config = EvaluateConfig(policy=policy, robot="ridgeback", simulator="planar", episodes=2, chunk=2)
    with closing(Player(config)) as player:
        assert player._env.action_spec.shape == (2, 3)
    assert evaluate(config)["robot"] == "ridgeback"


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


def test_a_worker_closes_the_worlds_of_the_cell_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches worlds that pile up, cell by cell, until there is no memory left."""
    made, closed = [], []

    class Watched(Player):
        def __init__(self, config: EvaluateConfig) -> None:
            super().__init__(config)
            made.append(self)

        def close(self) -> None:
            super().close()
            closed.append(self)

    monkeypatch.setattr(module, "Player", Watched)
    for size, worlds in ((0.5, 1), (0.5, 1), (1.0, 2)):
        config = EvaluateConfig(policy="scripted", object_size=size, simulator="planar", chunk=1, episodes=1)
        player = module._worker_player(config)
        assert player is made[-1]
        assert len(made) == worlds
    assert closed == made[:1]
    made[-1].close()
    module._players.clear()
