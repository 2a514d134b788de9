"""Each scenario is played once, and its outcome is what happened."""

from __future__ import annotations

import dataclasses
import json
from contextlib import closing
from typing import TYPE_CHECKING

import pytest
import torch

from cura_torchrl.envs.config import (
    MapConfig,
    PhysicsConfig,
    PushEnvConfig,
    RobotConfig,
    ScenarioConfig,
    TaskConfig,
)
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.trainers import evaluate as module
from cura_torchrl.trainers.build import Networks, make_env
from cura_torchrl.trainers.checkpoint import CHECKPOINT_FOLDER, find_checkpoint, read_config, save_checkpoint
from cura_torchrl.trainers.config import EvaluateConfig, TrainConfig
from cura_torchrl.trainers.evaluate import evaluate
from cura_torchrl.trainers.evaluation import parts
from cura_torchrl.trainers.evaluation.episodes import Episode, play_episodes, summarise
from cura_torchrl.trainers.evaluation.parts import Part, Player
from cura_torchrl.trainers.evaluation.task import evaluation_physics, evaluation_task
from cura_torchrl.trainers.info import shipped_methods
from cura_torchrl.trainers.loaded_policy import SHIPPED_FOLDER
from cura_torchrl.trainers.methods import method
from tests.runs import short_evaluation, tiny_run

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

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
    # The start and five steps of two scenes, then those of the third while the other world stands still.
    assert seen == [([7, 3], [True, True])] * 6 + [([11, 3], [True, False])] * 6


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
    # 16 windows a scene, that of the start included.
    second, third = windows_of([4, 9, 2])[16:32], windows_of([2, 4, 9])[32:48]
    assert torch.equal(second, third)
    assert not torch.equal(second[0], second[-1])


@pytest.mark.parametrize("name", shipped_methods())
def test_shipped_weights_are_evaluated_on_what_they_were_trained_on(name: str) -> None:
    """Catches defaults that move away from what the published numbers were played with."""
    trained = read_config(SHIPPED_FOLDER / name)[0].env
    scenario = dataclasses.replace(trained.task.scenario, kind="adversarial", object_edges=(0.75,), max_obstacles=3)
    played = {"stream": "eval", "random_first_age": False, "curriculum": (), "privileged": True}
    choice = EvaluateConfig(method=name, scenario="adversarial", object_size=0.75, max_obstacles=3)
    expected = dataclasses.replace(trained.task, scenario=scenario, **played)
    assert evaluation_task(trained.task, choice) == expected
    assert evaluation_physics(trained) == trained.physics


def test_all_are_evaluated_on_the_same_task_whatever_they_were_trained_on(tmp_path: Path) -> None:
    """Catches a light object, a wide goal or a soft floor that a policy takes with it from its training."""
    task = TaskConfig(
        scenario=ScenarioConfig(object_mass=(1.0, 1.0), floor_friction=(0.1, 0.1), obstacle_edges=(0.3,)),
        tolerances=(2.0, 1.0, 0.5),
        episode_time=200.0,
    )
    robot, physics = RobotConfig(max_base_speed=0.6), PhysicsConfig(gravity=1.0, planar_graph=True)
    preset = method("push").replace(perception="none", simulator="planar", run_dir=tmp_path)
    env = dataclasses.replace(preset.env, task=task, robot=robot, physics=physics)
    config = preset.replace(env=env)
    save_checkpoint({"networks": Networks(config)}, config, tmp_path, frames=1)
    with closing(Player(EvaluateConfig(checkpoint=tmp_path, simulator="planar", chunk=1))) as player:
        played = player._env.config
    with closing(Player(EvaluateConfig(policy="scripted", simulator="planar", chunk=1))) as player:
        paired = player._env.config
    assert played.task == paired.task
    assert played.physics == dataclasses.replace(paired.physics, planar_graph=True)
    assert (played.robot, played.lidar) == (robot, preset.env.lidar)


def test_a_policy_that_acts_at_another_rate_keeps_it() -> None:
    """Catches actions that are held for longer or shorter than in training, and a clock that does not divide it."""
    physics = PhysicsConfig(control_period=0.01, planar_period=0.025, gravity=1.0)
    trained = PushEnvConfig(task=TaskConfig(policy_period=0.25), physics=physics)
    task = evaluation_task(trained.task, EvaluateConfig(policy="random"))
    assert task.policy_period == 0.25
    clock = PhysicsConfig(control_period=0.01, planar_period=0.025)
    assert PushEnvConfig(task=task, physics=evaluation_physics(trained)).physics == clock


@pytest.fixture
def short_task() -> Iterator[None]:
    """Episodes of 1 s, so that an evaluation is over at once."""
    with short_evaluation():
        yield


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


def test_what_is_played_is_the_checkpoint_that_the_result_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches workers that load what a run that is being trained has written since."""
    run = tiny_run("push", tmp_path)
    first, seen = find_checkpoint(run), []
    config, _ = read_config(first)

    def train_on(played: list[Part], *_: object, **options: Callable[..., object]) -> None:
        save_checkpoint({"networks": Networks(config)}, config, run / CHECKPOINT_FOLDER, frames=9000)
        seen.extend(played)
        options["keep"](played[0], [episode(0)])

    monkeypatch.setattr(module, "play_parts", train_on)
    result = evaluate(EvaluateConfig(checkpoint=run, episodes=1))
    assert result["checkpoint"] == first.as_posix()
    assert [part.config.checkpoint for part in seen] == [first]


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

    monkeypatch.setattr(parts, "Player", Watched)
    for size, worlds in ((0.5, 1), (0.5, 1), (1.0, 2)):
        config = EvaluateConfig(policy="scripted", object_size=size, simulator="planar", chunk=1, episodes=1)
        player = parts._player(config)
        assert player is made[-1]
        assert len(made) == worlds
    assert closed == made[:1]
    made[-1].close()
    parts._players.clear()
