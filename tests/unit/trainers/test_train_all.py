"""Many runs, each a process that only pretends to train: who is started, when, and how often."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING

import pytest

from cura_torchrl.trainers.config import TrainConfig
from cura_torchrl.trainers.errors import CheckpointError, Interrupted
from cura_torchrl.trainers.methods import method
from cura_torchrl.trainers.train_all import LOG_NAME, train_all, train_command
from cura_torchrl.trainers.training.run_folder import CHECKPOINT_FOLDER, is_locked, locked
from cura_torchrl.trainers.training.run_status import read_status
from cura_torchrl.trainers.training.train_all_config import PlannedRun, TrainAllConfig, default_jobs

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

TOTAL = 100
FAKE = """
import fcntl, hashlib, json, pathlib, signal, sys, time
config, behaviour, resume, journal = json.loads(sys.argv[1]), sys.argv[2], sys.argv[3] == "True", sys.argv[4]
folder = pathlib.Path(config["run_dir"])
lock = (folder / ".lock").open("w")
fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)

def save(frames):
    path = folder / "checkpoints" / f"checkpoint-{frames:012d}"
    path.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"config": config, "frames": frames}).encode()
    (path / "config.json").write_bytes(text)
    (path / "SHA256SUMS").write_text(f"{hashlib.sha256(text).hexdigest()}  config.json\\n")

def note(word):
    with open(journal, "a") as file:
        file.write(f"{time.monotonic()} {word} {folder.name} {resume}\\n")

def stop(*_):
    save(30)
    sys.exit(143)

signal.signal(signal.SIGTERM, stop)
note("start")
if behaviour == "fails" or (behaviour == "fails once" and not resume):
    save(50)
    print("a bar  50%\\rboom")
    sys.exit(3)
time.sleep(60.0 if behaviour == "waits" else 0.1)
deadline = time.monotonic() + 20.0
while behaviour == "meets" and pathlib.Path(journal).read_text().count("start") < 2 and time.monotonic() < deadline:
    time.sleep(0.02)
save(config["total_frames"])
note("end")
"""


class Fake:
    """Command lines of processes that pretend to train, and the journal that they write."""

    def __init__(self, folder: Path, **behaviours: str) -> None:
        self.journal, self.behaviours = folder / "journal", behaviours

    def __call__(self, run: PlannedRun, resume: bool) -> list[str]:
        """Command line of a process that pretends to train."""
        behaviour = self.behaviours.get(run.config.method, "trains")
        given = [json.dumps(run.config.to_json()), behaviour, str(resume), str(self.journal)]
        return [sys.executable, "-S", "-c", FAKE, *given]

    def entries(self, word: str) -> list[tuple[float, str, bool]]:
        """Time, run, and whether it was resumed, of every start or end."""
        lines = self.journal.read_text(encoding="utf-8").splitlines() if self.journal.exists() else []
        parts = [line.split() for line in lines]
        return [(float(at), name, resume == "True") for at, what, name, resume in parts if what == word]

    def starts(self) -> list[tuple[str, bool]]:
        """Run, and whether it was resumed, of every start."""
        return [(name, resume) for _, name, resume in self.entries("start")]


def planned(folder: Path, *methods: str, seeds: Sequence[int] = (0,), **changes: object) -> list[PlannedRun]:
    """Runs of some methods and seeds."""
    init_from = changes.pop("init_from", None)
    configs = [
        method(name).replace(seed=seed, total_frames=TOTAL, run_dir=folder / f"{name}-{seed}").replace(**changes)
        for name in methods
        for seed in seeds
    ]
    return [PlannedRun(config=config, arguments=(), init_from=init_from) for config in configs]


def settings(**changes: object) -> TrainAllConfig:
    """Two side by side, one retry."""
    return TrainAllConfig(**{"jobs": 2, "retries": 1, **changes})


def test_each_run_is_trained_once_and_so_many_side_by_side(tmp_path: Path) -> None:
    """Catches runs that all start at once, one after the other, or a second time when the command is given again."""
    fake = Fake(tmp_path, push="meets")  # the first goes on only when the second has begun
    runs = planned(tmp_path, "push", "cura-ppo", seeds=(0, 1))
    found = train_all(settings(), runs, command=fake)
    assert [(status.state, status.frames) for status in found] == [("done", TOTAL)] * 4
    assert sorted(fake.starts()) == [(f"{name}-{seed}", False) for name in ("cura-ppo", "push") for seed in (0, 1)]
    events = sorted([(at, 1) for at, *_ in fake.entries("start")] + [(at, -1) for at, *_ in fake.entries("end")])
    side_by_side = [sum(change for _, change in events[: index + 1]) for index in range(len(events))]
    assert max(side_by_side) == 2
    assert {status.state for status in train_all(settings(), runs, command=fake)} == {"done"}
    assert len(fake.starts()) == 4


def test_more_frames_go_on_from_what_is_there(tmp_path: Path) -> None:
    """Catches a run that starts over, and one that is over but is started."""
    fake = Fake(tmp_path)
    train_all(settings(), planned(tmp_path, "push"), command=fake)
    runs = planned(tmp_path, "push", "cura-ppo", total_frames=2 * TOTAL)
    assert {status.frames for status in train_all(settings(), runs, command=fake)} == {2 * TOTAL}
    assert sorted(fake.starts()) == [("cura-ppo-0", False), ("push-0", False), ("push-0", True)]
    train_all(settings(), planned(tmp_path, "push"), command=fake)
    assert len(fake.starts()) == 3


def test_a_run_that_fails_is_tried_again_and_does_not_stop_the_others(tmp_path: Path) -> None:
    """Catches a night of training that one crash ends, and a crash that is tried again for ever or kept silent."""
    fake = Fake(tmp_path, push="fails", **{"push-conf": "fails once"})
    runs = planned(tmp_path, "push", "push-conf", "cura-ppo")
    found = train_all(settings(jobs=1), runs, command=fake)
    assert [status.state for status in found] == ["failed", "done", "done"]
    expected = [("push-0", False), ("push-0", True), ("push-conf-0", False), ("push-conf-0", True)]
    assert fake.starts() == [*expected, ("cura-ppo-0", False)]
    assert found[0].error == "exit code 3: boom"
    assert found[0].as_line().endswith("exit code 3: boom")
    assert (runs[0].config.run_dir / LOG_NAME).read_bytes().count(b"50%\rboom\n") == 2


def test_another_configuration_is_refused_before_anything_starts(tmp_path: Path) -> None:
    """Catches a table of runs that were not trained alike; the machine may change."""
    fake = Fake(tmp_path)
    train_all(settings(), planned(tmp_path, "push"), command=fake)
    runs = planned(tmp_path, "cura-ppo", "push", num_envs=32, total_frames=2 * TOTAL)
    with pytest.raises(CheckpointError, match=r"push-0 was trained with num_envs 64, not 32; accepted: ") as told:
        train_all(settings(), runs, command=fake)
    assert "\n" not in str(told.value)
    assert fake.starts() == [("push-0", False)]
    moved = planned(tmp_path, "push", device="cuda", num_workers=2, checkpoint_minutes=9.0, total_frames=2 * TOTAL)
    assert train_all(settings(), moved, command=fake)[0].state == "done"


def test_a_file_in_place_of_a_run_is_refused_and_is_no_run(tmp_path: Path) -> None:
    """Catches a file that passes for a run of another process, which is then waited for without end."""
    (tmp_path / "push-0").touch()
    (run,) = planned(tmp_path, "push")
    assert run.config.run_dir.name == "push-0"
    assert not is_locked(run.config.run_dir)
    assert read_status(run).state == "waiting"
    with pytest.raises(CheckpointError, match=r"push-0 is a file; accepted: a run's folder"):
        train_all(settings(), [run], command=Fake(tmp_path))


def test_another_warm_start_is_refused(tmp_path: Path) -> None:
    """Catches a method that goes on from another start than the one that it is said to have."""
    fake = Fake(tmp_path)
    starts = planned(tmp_path, "push", seeds=(0, 1))
    train_all(settings(), starts, command=fake)
    starts = [run.config.run_dir for run in starts]
    train_all(settings(), planned(tmp_path, "push-conf", init_from=starts[0]), command=fake)
    for other in (starts[1], None):
        with pytest.raises(CheckpointError, match=r"push-conf-0 started from other networks than"):
            train_all(settings(), planned(tmp_path, "push-conf", init_from=other), command=fake)
    with pytest.raises(CheckpointError, match="no checkpoint at"):
        train_all(settings(), planned(tmp_path, "cura-ppo", init_from=tmp_path / "none"), command=fake)


def test_a_run_of_another_process_is_waited_for(tmp_path: Path) -> None:
    """Catches a second process in the folder of a run whose parent was killed, and a run that is then left undone."""
    fake, runs = Fake(tmp_path), planned(tmp_path, "push")
    folder = runs[0].config.run_dir
    folder.mkdir()
    with subprocess.Popen(fake(runs[0], False)) as orphan:
        wait_until(lambda: is_locked(folder))
        assert read_status(runs[0]).state == "running"
        assert train_all(settings(), runs, command=fake)[0].state == "done"
    assert (orphan.returncode, fake.starts()) == (0, [("push-0", False)])


def test_a_run_that_another_process_leaves_undone_is_gone_on_with(tmp_path: Path) -> None:
    """Catches a run that stays undone because the process that was waited for has died."""
    fake, runs = Fake(tmp_path), planned(tmp_path, "push")
    folder = runs[0].config.run_dir
    folder.mkdir()
    with subprocess.Popen(Fake(tmp_path, push="waits")(runs[0], False)) as orphan:
        wait_until(lambda: is_locked(folder))
        threading.Timer(0.5, orphan.kill).start()
        assert train_all(settings(), runs, command=fake)[0].state == "done"
    assert fake.starts() == [("push-0", False), ("push-0", False)]  # before its first checkpoint


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_runs_with_a_checkpoint(tmp_path: Path, number: signal.Signals) -> None:
    """Catches processes that train on, or die without a checkpoint, when the command is told to stop."""
    fake, runs = Fake(tmp_path, push="waits"), planned(tmp_path, "push", "cura-ppo")
    # Where the tests themselves run in the background, SIGINT is ignored, and so it is by the command, as it should be.
    before = signal.signal(number, signal.SIG_DFL)

    def interrupt() -> None:
        wait_until(lambda: bool(fake.starts()))
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(Interrupted, match="the same command goes on from there") as told:
        train_all(settings(jobs=1), runs, command=fake)
    thread.join()
    assert told.value.exit_code == 128 + number
    assert [(status.state, status.frames) for status in map(read_status, runs)] == [("interrupted", 30), ("waiting", 0)]
    assert fake.starts() == [("push-0", False)]
    assert not is_locked(runs[0].config.run_dir)
    assert signal.signal(number, before) == signal.SIG_DFL


def test_damage_is_told_and_half_a_first_checkpoint_is_none(tmp_path: Path) -> None:
    """Catches a run that was killed while it wrote its first checkpoint and then cannot be started."""
    fake, runs = Fake(tmp_path), planned(tmp_path, "push")
    (runs[0].config.run_dir / CHECKPOINT_FOLDER / ".stage-1").mkdir(parents=True)
    assert read_status(runs[0]).state == "interrupted"
    assert train_all(settings(), runs, command=fake)[0].state == "done"
    assert fake.starts() == [("push-0", False)]
    next(runs[0].config.run_dir.rglob("config.json")).write_text("{}", encoding="utf-8")
    with pytest.raises(CheckpointError, match=r"is damaged: config\.json has changed"):
        train_all(settings(), planned(tmp_path, "push", "cura-ppo"), command=fake)
    assert len(fake.starts()) == 1


def test_a_resumed_run_takes_its_machine_from_the_command(tmp_path: Path) -> None:
    """Catches a run that was begun on a GPU and seeks it on a machine without one."""
    run = PlannedRun(config=TrainConfig(), arguments=("--seed", "0"), init_from=tmp_path)
    words = train_command(run, True)
    assert words[words.index("--device") + 1] == "cpu"
    assert "--env.physics.no-planar-graph" in words
    assert "--init-from" not in words
    assert train_command(run, False)[3:] == ["train", "--seed", "0", "--init-from", str(tmp_path)]


def test_a_status_tells_what_the_last_update_was_like(tmp_path: Path) -> None:
    """Catches columns that are mixed up, and a NaN that no JSON reader accepts."""
    run = planned(tmp_path, "push", total_frames=1000)[0]
    assert read_status(run).state == "waiting"
    with locked(run.config.run_dir):
        (run.config.run_dir / "progress.csv").write_text(
            "frames,max_obstacles,success,collision,frames_per_second\n100,1,nan,0.5,10\n400,2,0.25,nan,20\n"
        )
        found = read_status(run)
    assert (found.state, found.frames, found.max_obstacles, found.success, found.collision) == (
        "running", 400, 2.0, 0.25, None,
    )  # fmt: skip
    assert (found.seconds_left, found.checkpoint_age) == (30.0, None)
    line = " ".join(found.as_line().split())
    assert line == ("push 0 running 400/1,000 40% 20 f/s success 25% collision - K 2 left 30 s checkpoint - ago")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"methods": ("push,cura",)}, r"method is 'cura' \(did you mean cura-ppo\?\)"),
        ({"methods": (",",)}, "methods is "),
        ({"seeds": ()}, "seeds is "),
        ({"seeds": (1, 1)}, "seeds is "),
        ({"jobs": 0}, "jobs is 0; accepted: 1 or more"),
        ({"retries": -1}, "retries is -1; accepted: 0 or more"),
        ({"init_from": ("a", "b")}, "init_from is "),
        ({"init_from": ("push=a", "push=b")}, "init_from is "),
        ({"init_from": ("pusj=a",)}, r"method is 'pusj' \(did you mean push\?\)"),
    ],
)
def test_a_setting_that_makes_no_sense_is_refused_in_one_line(changes: dict[str, object], message: str) -> None:
    """Catches a night of training that ends in an error, or in runs from the wrong start."""
    with pytest.raises(ValueError, match=message) as told:
        TrainAllConfig(**changes)
    assert "\n" not in str(told.value)


def test_jobs_follow_the_cores(tmp_path: Path) -> None:
    """Catches runs that fight for cores, and a machine of one core on which none starts."""
    run = TrainConfig(num_workers=1, learner_threads=1)
    assert [default_jobs(run, cores) for cores in (1, 2, 16)] == [1, 2, 16]
    assert [default_jobs(run.replace(num_workers=2), cores) for cores in (1, 5, 16)] == [1, 2, 8]
    assert [default_jobs(run.replace(device="cuda:0"), cores) for cores in (1, 4, 64)] == [1, 4, 8]


def wait_until(is_so: object) -> None:
    """Wait for a condition, at most ten seconds."""
    deadline = time.monotonic() + 10.0
    while not is_so() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert is_so()
