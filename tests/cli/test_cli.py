"""The command line as a user meets it: in a process of its own."""

from __future__ import annotations

import dataclasses
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from cura_torchrl.trainers.benches.config import BenchConfig
from cura_torchrl.trainers.calibration.config import CalibrateConfig
from cura_torchrl.trainers.checkpoint import CHECKPOINT_FOLDER, save_checkpoint
from cura_torchrl.trainers.config import EvaluateConfig, TrainConfig
from cura_torchrl.trainers.deployment.config import ExportConfig
from cura_torchrl.trainers.evaluation.table_config import TableConfig
from cura_torchrl.trainers.loaded_policy import SHIPPED_FOLDER
from cura_torchrl.trainers.methods import PRESETS, method
from cura_torchrl.trainers.pages.demo_config import DemoConfig
from cura_torchrl.trainers.pages.report_config import ReportConfig
from cura_torchrl.trainers.pictures.render_config import RenderConfig
from cura_torchrl.trainers.pictures.view_config import ViewConfig
from cura_torchrl.trainers.training.imitate_config import ImitateConfig
from cura_torchrl.trainers.training.pretrain_map_config import PretrainMapConfig
from cura_torchrl.trainers.training.progress import PROGRESS_NAME, read_progress
from cura_torchrl.trainers.training.run_folder import is_locked
from cura_torchrl.trainers.training.run_status import read_record
from cura_torchrl.trainers.training.train_all_config import TrainAllConfig

if TYPE_CHECKING:
    from pathlib import Path

COMMAND = [sys.executable, "-m", "cura_torchrl.trainers.cli"]
SMALL = [
    "--method", "push", "--perception", "none", "--num-envs", "2", "--ppo.rollout-steps", "4",
    "--checkpoint-minutes", "0", "--learner-threads", "1", "--network.actor-hidden-sizes", "8",
    "--network.critic-hidden-sizes", "8", "--network.collision-hidden-sizes", "8",
]  # fmt: skip
FRAMES = 8


def run(*arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run the command line to its end."""
    environment = {**os.environ, "COLUMNS": "200", **variables}
    return subprocess.run(
        [*COMMAND, *arguments], capture_output=True, text=True, timeout=280, env=environment, check=False
    )


def flags(config: type[object], prefix: str = "") -> list[str]:
    """All flags that a configuration's fields make, nested ones with a dot."""
    found = []
    for field in dataclasses.fields(config):
        name = prefix + field.name.replace("_", "-")
        nested = field.default_factory if dataclasses.is_dataclass(field.default_factory) else None
        found += flags(nested, f"{name}.") if nested else [f"--{name}"]
    return found


def test_help_lists_every_command_and_method() -> None:
    """Catches a command that nobody finds."""
    done = run("--help")
    assert done.returncode == 0
    learning = ("pretrain-map", "imitate", "train", "train-all")
    others = (
        "evaluate",
        "table",
        "calibrate",
        "render",
        "report",
        "view",
        "release",
        "export",
        "demo",
        "bench",
        "info",
    )
    for name in (*learning, *others, *PRESETS):
        assert name in done.stdout


@pytest.mark.parametrize(
    ("command", "config"),
    [
        ("pretrain-map", PretrainMapConfig),
        ("imitate", ImitateConfig),
        ("train", TrainConfig),
        ("train-all", TrainAllConfig),
        ("evaluate", EvaluateConfig),
        ("table", TableConfig),
        ("report", ReportConfig),
        ("view", ViewConfig),
        ("render", RenderConfig),
        ("calibrate", CalibrateConfig),
        ("demo", DemoConfig),
        ("export", ExportConfig),
        ("bench", BenchConfig),
    ],
)
def test_help_lists_every_field(command: str, config: type[object]) -> None:
    """Catches a setting that can only be changed in the code, and help that has to import torch."""
    done = run(command, "--help", PYTHONPROFILEIMPORTTIME="1")
    assert done.returncode == 0
    imported = [line.rsplit("|", 1)[-1].strip() for line in done.stderr.splitlines() if line.startswith("import time:")]
    assert "tyro" in imported
    assert "torch" not in imported
    words = done.stdout.replace("│", " ").replace(",", " ").split()
    positional = {"--target", "--runs"}
    assert [flag for flag in flags(config) if flag not in words and flag not in positional] == []


@pytest.mark.parametrize(
    ("shell", "message"),
    [
        ("--help > /dev/full", "No space left on device"),
        ("--help >&-", "standard output is closed; accepted: one that can be written"),
    ],
)
def test_what_cannot_be_written_is_told_in_one_line(shell: str, message: str) -> None:
    """Catches a traceback, at once or when Python ends."""
    line = f"{shlex.join(COMMAND)} {shell}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, timeout=280, check=False)
    assert done.returncode == 2
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_reader_that_has_seen_enough_is_no_error() -> None:
    """Catches a complaint after ``cura-torchrl ... | head``; 141 is what a shell gives for SIGPIPE."""
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([*COMMAND, "--help"], stdout=writer, stderr=subprocess.PIPE, timeout=280, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, b"")


def test_help_of_a_method_shows_its_own_defaults() -> None:
    """Catches flags that show cura-ppo's coefficients whatever the method is."""
    shown = run("train", "--method", "push", "--help").stdout
    assert "lambda_u" in shown
    line = shown[shown.index("--cura.uncertainty-coeff") :]
    assert "(default: 0.0)" in " ".join(line.replace("│", " ").split())[:300]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["trainn"], "'trainn' is no command; accepted: pretrain-map, "),
        (["train", "--method", "cura"], "method is 'cura' (did you mean cura-ppo?); accepted: cura-ppo, push"),
        (["train", "--num-evns", "3"], "Unrecognized options: --num-evns"),
        (["train", "--num-envs", "many"], "--num-envs"),
        (["train", "--ppo.lr", "nan"], "lr is nan; accepted: finite numbers"),
        (["train", "--env.task.episode-time", "nan"], "episode_time is nan; accepted: finite numbers"),
        (["train", "--simulator", "isaac"], "--simulator"),
        (["train", "--backend", "slurm"], "--backend"),
        (["train", "--resume", "--run-dir", "{tmp}"], "no checkpoint at"),
        (["train", "--logger", "carrier-pigeon"], "--logger"),
        (["train", "--encoder", "{tmp}/none.pt", "--run-dir", "{tmp}/run"], "cura-torchrl pretrain-map"),
        (["evaluate"], "accepted: one of checkpoint, method, policy"),
        (["evaluate", "--checkpoint", "{tmp}"], "no checkpoint at"),
        (["evaluate", "--checkpoint", "{tmp}/none"], "no checkpoint at"),
        (
            ["evaluate", "--method", "cura"],
            "method is 'cura' (did you mean cura-ppo?)",
        ),
        (["export"], "policy to export is []; accepted: one of checkpoint, method"),
        (["export", "--method", "cura"], "method is 'cura'"),
        (["export", "--method", "push", "--out", "/"], "out is '/'; accepted: a folder that is empty or not there"),
        (["export", "--method", "push", "--out", "."], "out is '.'; accepted: a folder that is empty or not there"),
        (["export", "--method", "push", "--out", "/dev/null/a/b"], "folder of out is '/dev/null/a' (Not a directory)"),
        (
            ["release", "--checkpoint", str(SHIPPED_FOLDER / "push"), "--destination", "/dev/null/a/b"],
            "folder of destination is '/dev/null/a' (Not a directory)",
        ),
        (["imitate", "--method", "cura-pro"], "method is 'cura-pro' (did you mean cura-ppo?)"),
        (["imitate", "--seed", "-1"], "seed is -1; accepted: 0 to 2147483647"),
        (["evaluate", "--method", "push", "--robot", "ridgeback"], "robot is 'ridgeback'; accepted: nothing beside"),
        (["table", "--methods", "push,cura"], "method is 'cura' (did you mean cura-ppo?); accepted: cura-no-risk, "),
        (["table", "--cells", "uniform-0.5", "uniform-9"], "cell is 'uniform-9'; accepted: all, or SCENARIO-SIZE"),
        (["table", "--methods", "push", "--seeds", "7", "--runs", "{tmp}", "--out", "{tmp}"], "no checkpoint at"),
        (["train-all", "--methods", "push,cura"], "method is 'cura' (did you mean cura-ppo?)"),
        (["train-all", "--seeds", "0,one"], "--seeds"),
        (["train-all", "--init-from", "push={tmp}/none"], "no checkpoint at"),
        (["train-all", "--runs", "{tmp}", "--", "--seed", "3"], "flag after -- is '--seed'; accepted: the flags of"),
        (["train-all", "--runs", "{tmp}", "--", "--num-evns", "3"], "Unrecognized options: --num-evns"),
        (["view", "--port", "0"], "port is 0; accepted: 1 to 65535"),
        (["view", "--speed", "-1"], "speed is -1.0; accepted: a positive number"),
        (["report"], "runs is (); accepted: one or more methods or folders"),
        (["report", "{tmp}/none"], "no checkpoint at"),
        (["report", "push", "--table", "{tmp}"], "no table.md in"),
        (["report", "push", "--calibration", "{tmp}"], "no calibration.md in"),
        (["report", "push", "--curves", "{tmp}/none.csv"], "no rows of progress in"),
        (["report", "push", "--out", "{tmp}"], "a folder; accepted: a file to write"),
        (["report", "push", "--object-size", "3"], "object_size is 3.0; accepted: 0.3 to 1.2 m"),
        (["render", "--methods", "push,cura"], "method is 'cura' (did you mean cura-ppo?); accepted: cura-no-risk, "),
        (["render", "--methods", "{tmp}"], "no checkpoint at"),
        (["render", "--scene", "-1"], "scene is -1; accepted: 0 to 2147483647"),
        (["render", "--formats", "png,jpg"], "format is 'jpg'; accepted: png, svg, mp4, gif, webp"),
        (
            ["render", "--figures", "path"],
            "figure is 'path' (did you mean paths?); accepted: all, none, paths, snapshots, ",
        ),
        (["render", "--times", "3", "1"], "times is (3.0, 1.0); accepted: at most 6 growing times [s]"),
        (
            ["calibrate", "--methods", "cura-pp"],
            "method is 'cura-pp' (did you mean cura-ppo?); accepted: cura-no-risk, ",
        ),
        (["calibrate", "--conditions", "night"], "condition is 'night'; accepted: on-policy, big-object, "),
        (["calibrate", "--repeats", "3"], "repeats is 3; accepted: a divisor of 256 futures"),
        (["bench"], "env,learner,lidar,ik,peers"),
        (["bench", "speed"], "speed"),
        (["bench", "env", "--rounds", "0"], "rounds is 0; accepted: 1 or more"),
        (["bench", "env", "--output", "{tmp}"], "a folder; accepted: a file to write"),
        (
            ["demo", "--docs-dir", "/dev/null/docs"],
            "docs_dir is '/dev/null/docs' (Not a directory); accepted: a folder",
        ),
        (["calibrate", "--out", "/dev/null/out"], "out is '/dev/null/out' (Not a directory); accepted: "),
        (["evaluate", "--policy", "scripted", "--object-size", "nan"], "object_size is nan; accepted: finite numbers"),
    ],
)
def test_a_mistake_is_told_in_one_line(arguments: list[str], message: str, tmp_path: Path) -> None:
    """Catches a traceback, or an exit code of 0, for what the user can mend."""
    done = run(*(argument.format(tmp=tmp_path) for argument in arguments))
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    told = [line for line in done.stderr.splitlines() if line.startswith("cura-torchrl: ")]
    assert len(told) == 1
    assert done.stdout == ""


def test_a_damaged_checkpoint_is_refused_in_one_line(tmp_path: Path) -> None:
    """Catches an evaluation of weights that are not those that were trained."""
    path = save_checkpoint({}, method("push"), tmp_path / CHECKPOINT_FOLDER, frames=3)
    (path / "config.json").write_text("{}", encoding="utf-8")
    done = run("evaluate", "--checkpoint", str(tmp_path))
    assert done.returncode == 2
    assert "is damaged: config.json has changed" in done.stderr
    assert "Traceback" not in done.stderr


def test_info_is_json() -> None:
    """Catches a report of a bug that does not say what was run."""
    found = json.loads(run("info", "--json").stdout)
    assert {"versions", "commit", "hardware", "works", "shipped methods"} == set(found)


def test_evaluation_prints_nothing_but_json() -> None:
    """Catches the simulator's greeting on stdout, which no JSON reader accepts."""
    flags_ = ["--policy", "random", "--scenario", "adversarial", "--object-size", "1.0", "--max-obstacles", "0"]
    done = run("evaluate", *flags_, "--episodes", "2", "--chunk", "2", "--seed", "3", "--simulator", "bullet", "--json")
    result = json.loads(done.stdout)
    assert (result["episodes"], result["scenario"], result["object_size"], result["seed"]) == (2, "adversarial", 1.0, 3)


def test_a_benchmark_prints_nothing_but_json(tmp_path: Path) -> None:
    """Catches the simulator's greeting or a progress bar on stdout, and a result that is not written."""
    path = tmp_path / "ik.json"
    done = run("bench", "ik", "--num-envs", "2", "--rounds", "1", "--output", str(path), "--json")
    assert json.loads(done.stdout) == json.loads(path.read_text(encoding="utf-8"))


def test_a_table_of_outcomes_that_are_there_plays_nothing(tmp_path: Path) -> None:
    """Catches a table that plays again what it has, or prints anything beside itself to stdout."""
    flags_ = ["--methods", "push", "--cells", "uniform-0.5", "--episodes", "1", "--chunk", "1", "--num-workers", "2"]
    arguments = ["table", *flags_, "--simulator", "planar", "--out", str(tmp_path)]
    first = run(*arguments)
    assert first.returncode == 0, first.stderr
    assert first.stdout == (tmp_path / "table.md").read_text(encoding="utf-8")
    second = run(*arguments)
    assert second.stdout == first.stdout
    assert "1/1 [00:00" in second.stderr


def test_a_killed_run_goes_on_from_its_last_checkpoint(tmp_path: Path) -> None:
    """Catches a checkpoint that SIGKILL leaves half written, and a resumed run that starts over."""
    folder = tmp_path / "run"
    arguments = ["train", *SMALL, "--run-dir", str(folder)]
    with subprocess.Popen(
        [*COMMAND, *arguments, "--total-frames", "1000000"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        deadline = time.monotonic() + 180
        while len(read_progress(folder / PROGRESS_NAME)) < 4 and time.monotonic() < deadline:
            time.sleep(0.05)
        process.send_signal(signal.SIGKILL)
    last = max(int(entry.name.split("-")[1]) for entry in (folder / CHECKPOINT_FOLDER).glob("checkpoint-*"))
    assert last >= 3 * FRAMES
    done = run(*arguments, "--total-frames", str(last + 2 * FRAMES), "--resume")
    assert done.returncode == 0, done.stderr
    frames = [row["frames"] for row in read_progress(folder / PROGRESS_NAME)]
    assert frames == [FRAMES * (index + 1) for index in range(len(frames))]
    assert frames[-1] == last + 2 * FRAMES
    assert not list((folder / CHECKPOINT_FOLDER).glob(".stage-*"))
    assert done.stdout.strip().endswith(f"checkpoint-{last + 2 * FRAMES:012d}")


def test_the_state_of_runs_is_told_without_starting_any(tmp_path: Path) -> None:
    """Catches a look that trains, and JSON that lacks a run."""
    flags_ = ["--methods", "push,cura-ppo", "--seeds", "0,1", "--runs", str(tmp_path)]
    done = run("train-all", *flags_, "--status", "--json")
    assert done.returncode == 0, done.stderr
    found = [(entry["method"], entry["seed"], entry["state"]) for entry in json.loads(done.stdout)]
    assert found == [(name, seed, "waiting") for name in ("push", "cura-ppo") for seed in (0, 1)]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_killed_with_its_parent_a_run_goes_on_and_no_frame_is_trained_twice(tmp_path: Path) -> None:
    """Catches a second process beside one that outlived its parent, and a run that starts over."""
    folder = tmp_path / "push-0"
    own = ["train-all", "--methods", "push", "--runs", str(tmp_path), "--simulator", "planar", "--total-frames"]
    with subprocess.Popen([*COMMAND, *own, "1000000", "--", *SMALL[2:]], stderr=subprocess.DEVNULL) as parent:
        deadline = time.monotonic() + 180
        while len(read_progress(folder / PROGRESS_NAME)) < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
        parent.kill()
    assert is_locked(folder)
    status = json.loads(run(*own, "1000000", "--status", "--json", "--", *SMALL[2:]).stdout)
    assert status[0]["state"] == "running"
    os.kill(read_record(folder)["pid"], signal.SIGKILL)
    last = max(int(entry.name.split("-")[1]) for entry in (folder / CHECKPOINT_FOLDER).glob("checkpoint-*"))
    total = str(last + 2 * FRAMES)
    done = run(*own, total, "--", *SMALL[2:])
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[:3] == ["push", "0", "done"]
    frames = [row["frames"] for row in read_progress(folder / PROGRESS_NAME)]
    assert frames == [FRAMES * (index + 1) for index in range(len(frames))]
    assert frames[-1] == last + 2 * FRAMES
    log = (folder / "train.log").read_text(encoding="utf-8")
    assert log.count("cura_torchrl.trainers.cli train ") == 2  # one process before, one after
