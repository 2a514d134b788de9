"""The demo from end to end, with untrained networks and episodes of a second."""

from __future__ import annotations

import io
import logging
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image

from cura_torchrl.trainers import demo as module
from cura_torchrl.trainers.checkpoint import find_checkpoint, read_config
from cura_torchrl.trainers.demo import PAGE_NAME, TRAINING_FOLDER, DemoConfig, demo, most_telling
from cura_torchrl.trainers.errors import RunError
from cura_torchrl.trainers.loaded_policy import load_policy
from cura_torchrl.trainers.methods import METHODS
from cura_torchrl.trainers.training.progress import read_progress
from cura_torchrl.trainers.worker_pool import WorkerPool
from tests.recordings import make_recording
from tests.runs import short_evaluation, tiny_run

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture(scope="module", autouse=True)
def short() -> Iterator[None]:
    """Scenes are over after five steps."""
    with short_evaluation():
        yield


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """Two tiny runs."""
    folder = tmp_path_factory.mktemp("runs")
    return str(tiny_run("cura-ppo", folder)), str(tiny_run("push", folder))


def tiny_demo(runs: tuple[str, str], folder: Path, **changes: object) -> DemoConfig:
    """Return the smallest demo: one scene of each kind, one update, all in this process."""
    options = {"scenes": 1, "telling_scenes": 1, "train_iterations": 1, "train_envs": 2, "num_workers": 1}
    return DemoConfig(run_dir=folder, policies=runs, **{**options, **changes})


def test_demo_plays_writes_its_page_and_trains_on(
    runs: tuple[str, str], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Catches a step that is left out, training from nothing, and a second demo that trips over the first."""
    with caplog.at_level(logging.INFO, logger="cura_torchrl"):
        page = demo(tiny_demo(runs, tmp_path / "demo", docs_dir=tmp_path / "docs"))
    assert page == tmp_path / "demo" / PAGE_NAME
    text = page.read_text(encoding="utf-8")
    assert text.count("<article id=") == 2
    assert "Learning goes on" in text
    assert len(text) < 15e6
    assert "adversarial CURA-PPO            0 of 1 reached the goal (0%, 95 % interval 0% to 79%)" in caplog.text
    assert "uniform     Push w/ Occlusion   0 of 1 reached the goal" in caplog.text
    trained = find_checkpoint(tmp_path / "demo" / TRAINING_FOLDER)
    config, record = read_config(trained)
    assert record["frames"] == 8  # one rollout of 2 worlds by 4 steps
    # What the run was in the end: K = 1 of its curriculum, its last learning rate, and costs that are on at once.
    assert config.env.task.scenario.max_obstacles == 1
    assert config.env.task.curriculum == ()
    assert (config.ppo.lr, config.cura.costs_start_frames) == (0.003, 0)
    assert config.method == "cura-ppo"
    assert [row["frames"] for row in read_progress(tmp_path / "demo" / TRAINING_FOLDER / "progress.csv")] == [8]
    names = {"collision_distribution.png", "demo.webp", "layout.png", "paths.png", "snapshots.png"}
    assert {entry.name for entry in (tmp_path / "docs").iterdir()} == names
    for name in names:
        with Image.open(io.BytesIO((tmp_path / "docs" / name).read_bytes())) as image:
            image.load()
    again = demo(tiny_demo(runs, tmp_path / "demo", scenes=1, telling_scenes=0))
    assert "The most telling scenes" not in again.read_text(encoding="utf-8")


def test_both_play_in_the_same_worlds_wherever_they_were_trained(tmp_path: Path) -> None:
    """Catches two policies that are compared on two simulators."""
    runs = str(tiny_run("cura-ppo", tmp_path / "one")), str(tiny_run("cura-ppo", tmp_path / "two", "planar"))
    config = tiny_demo(runs, tmp_path)
    loaded = [load_policy(run) for run in runs]
    tasks = [module._task(config, policy) for policy in loaded]
    ((one, other), *_) = module._play(config, loaded, tasks, module._scenes(config, tasks[0]), WorkerPool(1))
    np.testing.assert_array_equal(one.base_pose, other.base_pose)
    assert np.ptp(one.base_pose[:, 0]) > 0


@pytest.mark.slow
def test_several_processes_play_the_same(runs: tuple[str, str], tmp_path: Path) -> None:
    """Catches scenes, labels or drawings that get mixed up between processes."""
    options = {"train_iterations": 0, "scenes": 2}
    alone = demo(tiny_demo(runs, tmp_path / "one", **options)).read_text(encoding="utf-8")
    together = demo(tiny_demo(runs, tmp_path / "two", **options, num_workers=2)).read_text(encoding="utf-8")
    assert alone == together


@pytest.mark.parametrize("name", METHODS)
def test_missing_weights_name_the_command_that_makes_them(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a traceback, or an error after minutes, on a copy without weights."""
    monkeypatch.setattr("cura_torchrl.trainers.demo.shipped_methods", list)  # a copy without any
    with pytest.raises(RunError) as caught:
        demo(DemoConfig(run_dir=tmp_path, policies=(name, "runs/other")))
    message = str(caught.value)
    assert f"cura-torchrl train --method {name} --run-dir runs/{name}" in message
    assert f"cura-torchrl demo --policies runs/{name} runs/other" in message
    assert "\n" not in message


def test_a_run_that_is_not_there_is_told_in_one_line(tmp_path: Path) -> None:
    """Catches an error that does not say which path was wrong."""
    with pytest.raises(RunError, match=r"no checkpoint at .*nowhere") as caught:
        demo(DemoConfig(run_dir=tmp_path, policies=(str(tmp_path / "nowhere"), "push")))
    assert "\n" not in str(caught.value)


def test_too_many_scenes_are_refused_before_anything_is_played(runs: tuple[str, str], tmp_path: Path) -> None:
    """Catches a traceback for a number that is only too large."""
    with pytest.raises(RunError, match="number of scenes is 300; accepted"):
        demo(tiny_demo(runs, tmp_path, scenes=300))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"scenes": 0}, "scenes is 0; accepted: 1 or more"),
        ({"train_iterations": -1}, "train_iterations is -1; accepted: 0 or more"),
        ({"max_obstacles": 0}, "max_obstacles is 0; accepted: 1 to 6"),
        ({"object_sizes": (0.5, float("nan"))}, "accepted: finite numbers"),
        ({"object_sizes": ()}, "one or more of 0.3 to 1.2 m"),
    ],
)
def test_configuration_refuses_what_makes_no_demo(changes: dict[str, object], words: str) -> None:
    """Catches a demo that fails minutes later."""
    with pytest.raises(ValueError, match=words):
        DemoConfig(**changes)


def test_telling_scenes_differ_in_outcome_then_are_close_calls() -> None:
    """Catches a rule that prefers one policy: scene 3 is won by the second one, and counts as much as scene 2."""
    near = make_recording().obstacles.copy()
    near[..., 0] -= 2.0

    def pair(index: int, first: str, second: str, **changes: object) -> tuple:
        return make_recording(index=index, outcome=first, **changes), make_recording(index=index, outcome=second)

    pairs = [
        pair(1, "success", "success"),
        pair(2, "success", "collision"),
        pair(3, "time-out", "success"),
        pair(4, "collision", "time-out", obstacles=near),
        pair(5, "success", "success", obstacles=near),
    ]
    assert [found[0].scene.index for found in most_telling(pairs, 5)] == [2, 3, 4, 5, 1]
    assert [found[0].scene.index for found in most_telling(pairs[::-1], 2)] == [2, 3]
