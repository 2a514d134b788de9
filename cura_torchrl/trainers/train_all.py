"""Train many runs unattended: each is an ordinary ``train`` in a process of its own, resumed and retried as need be."""

from __future__ import annotations

import contextlib
import operator
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections import Counter, deque
from typing import TYPE_CHECKING

from cura_torchrl.trainers.checkpoint import find_checkpoint, read_config, weights_sha256
from cura_torchrl.trainers.decoding import changed_fields
from cura_torchrl.trainers.errors import CheckpointError, Interrupted
from cura_torchrl.trainers.folders import make_folder
from cura_torchrl.trainers.info import hardware
from cura_torchrl.trainers.training.run_folder import CHECKPOINT_FOLDER, is_locked
from cura_torchrl.trainers.training.run_status import RunStatus, read_record, read_status, write_record
from cura_torchrl.trainers.training.signals import StopRequests
from cura_torchrl.trainers.training.train_all_config import PlannedRun, TrainAllConfig, default_jobs
from cura_torchrl.trainers.training.train_all_display import Display

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from cura_torchrl.trainers.config import TrainConfig

LOG_NAME = "train.log"
"""File of a run with the command lines of all attempts, each followed by what it printed."""
MACHINE_FIELDS = (
    "device",
    "num_workers",
    "backend",
    "learner_threads",
    "logger",
    "checkpoint_minutes",
    "keep_checkpoints",
    "recent_episodes",
    "env.physics.planar_graph",
)
"""Fields that say where and how a run is made, not what: they may change when it goes on."""
_POLL_SECONDS = 0.2
_PROMPT = "$ "
_ADVICE = "the same command goes on from there"


def train_all(
    config: TrainAllConfig,
    runs: Sequence[PlannedRun],
    *,
    command: Callable[[PlannedRun, bool], Sequence[str]] | None = None,
) -> list[RunStatus]:
    """Train runs that are not done, some side by side; one that another process trains is waited for.

    Args:
        config: How many side by side, and how often one that fails is tried again.
        runs: The runs.
        command: Command line of one run, resumed or not; None is ``train`` with this Python.

    Returns:
        How far each run is at the end: done, or failed.

    Raises:
        CheckpointError: If a run was begun with another configuration or is damaged; nothing has been started then.
        Interrupted: If SIGINT, SIGTERM or SIGHUP asked to stop; the runs have stopped with a checkpoint.
    """  # noqa: DOC502 - raised by what this calls
    paths = {run.init_from for run in runs if run.init_from is not None}
    starts = {path: weights_sha256(find_checkpoint(path)) for path in paths}
    for run in runs:
        _require_same(run, starts)
    jobs = config.jobs or default_jobs(runs[0].config, hardware()["cores"])
    with StopRequests(signal.SIGINT, signal.SIGTERM, signal.SIGHUP) as signals, Display(runs) as display:
        schedule = _Schedule(
            runs, jobs=jobs, retries=config.retries, command=command or train_command, starts=starts, tell=display.tell
        )
        try:
            while schedule.step(len(signals.received)):
                display.show(schedule.running)
                time.sleep(_POLL_SECONDS)
        finally:
            schedule.end()
    if signals.received:
        raise Interrupted(signals.received[0], _ADVICE)
    return [read_status(run) for run in runs]


def train_command(run: PlannedRun, resume: bool) -> list[str]:
    """Return the command line that trains a run.

    Args:
        run: The run.
        resume: Whether to go on from its last checkpoint.

    Returns:
        Program and arguments.

    Examples:
        >>> from cura_torchrl.trainers.config import TrainConfig
        >>> train_command(PlannedRun(config=TrainConfig(), arguments=("--seed", "0")), resume=True)[3:7]
        ['train', '--seed', '0', '--resume']
    """
    words = [sys.executable, "-m", "cura_torchrl.trainers.cli", "train", *run.arguments]
    if resume:
        # What is not given is as in the checkpoint, which may come from another machine.
        return [*words, "--resume", *_machine_flags(run.config)]
    return words if run.init_from is None else [*words, "--init-from", str(run.init_from)]


class _Schedule:
    """Which runs wait, run here, are trained by another process, or are over."""

    def __init__(
        self,
        runs: Sequence[PlannedRun],
        *,
        jobs: int,
        retries: int,
        command: Callable[[PlannedRun, bool], Sequence[str]],
        starts: Mapping[Path, str],
        tell: Callable[[str], None],
    ) -> None:
        self.jobs, self.retries, self.command, self.starts, self.tell = jobs, retries, command, starts, tell
        unfinished = [run for run in runs if not _is_done(run)]
        self.elsewhere = [run for run in unfinished if is_locked(run.config.run_dir)]
        self.waiting = deque(run for run in unfinished if run not in self.elsewhere)
        self.children: dict[str, tuple[PlannedRun, subprocess.Popen[bytes]]] = {}
        self.failures: Counter[str] = Counter()
        self.stops = 0
        for run in self.elsewhere:
            tell(f"{run.name} is being trained by another process: it is waited for")

    @property
    def running(self) -> set[str]:
        """Names of the runs that some process trains."""
        return {*self.children, *(run.name for run in self.elsewhere)}

    def step(self, stops: int) -> bool:
        """Look after the runs once.

        Args:
            stops: Requests to stop until now [1].

        Returns:
            Whether some runs are not over.
        """
        for name, (run, process) in list(self.children.items()):
            if process.poll() is not None:
                del self.children[name]
                self._over(run, process, is_stopping=stops > 0)
        if stops:
            self._stop(stops)
            return bool(self.children)
        for run in [run for run in self.elsewhere if not is_locked(run.config.run_dir)]:
            self.elsewhere.remove(run)
            if not _is_done(run):
                self.waiting.append(run)
        while self.waiting and len(self.running) < self.jobs:
            self._start(self.waiting.popleft())
        return bool(self.children or self.elsewhere or self.waiting)

    def end(self) -> None:
        """End the runs that are left, after an error of this process."""
        for _, process in self.children.values():
            process.terminate()
        for _, process in self.children.values():
            process.wait()

    def _start(self, run: PlannedRun) -> None:
        folder = run.config.run_dir
        if is_locked(folder):
            self.elsewhere.append(run)
            return
        try:
            source = _checkpoint_of(folder)
        except CheckpointError as error:
            self._fail(run, str(error))
            return
        make_folder(folder, "folder of the run")
        if source is None:
            write_record(folder, init_from_sha256=self.starts[run.init_from] if run.init_from else None)
        write_record(folder, error=None)
        words = self.command(run, source is not None)
        with (folder / LOG_NAME).open("ab") as log:
            log.write(f"{_PROMPT}{shlex.join(words)}\n".encode())
            log.flush()
            # A session of its own: the terminal's Ctrl-C comes to this process alone, which passes it on once.
            process = subprocess.Popen(
                words, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
        write_record(folder, pid=process.pid)
        self.children[run.name] = run, process

    def _over(self, run: PlannedRun, process: subprocess.Popen[bytes], *, is_stopping: bool) -> None:
        code = process.returncode
        if code != 0:
            _end_group(process.pid)
        if is_stopping or (code == 0 and _is_done(run)):
            return
        if is_locked(run.config.run_dir):
            self.elsewhere.append(run)  # another process was faster
            return
        self.failures[run.name] += 1
        ending = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        reason = f"{ending}: {_last_line(run.config.run_dir / LOG_NAME)}"
        if self.failures[run.name] > self.retries:
            self._fail(run, reason)
            return
        self.tell(f"{run.name}: {reason}; tried again ({self.failures[run.name]} of {self.retries})")
        self.waiting.appendleft(run)

    def _fail(self, run: PlannedRun, reason: str) -> None:
        write_record(run.config.run_dir, error=reason)
        self.tell(f"{run.name} failed: {reason}")

    def _stop(self, stops: int) -> None:
        # The first request lets `train` finish its update and write a checkpoint, the second ends it at once.
        for _, process in self.children.values():
            if self.stops == 0:
                process.terminate()
            elif stops > self.stops:
                _end_group(process.pid)
        self.stops = stops


def _require_same(run: PlannedRun, starts: Mapping[Path, str]) -> None:
    # What is there of a run was begun with the configuration and the warm start that are asked for.
    folder = run.config.run_dir
    if folder.exists() and not folder.is_dir():
        msg = f"{folder} is a file; accepted: a run's folder, or a path where one can be made"
        raise CheckpointError(msg)
    source = _checkpoint_of(folder)
    if source is None:
        return
    before, _ = read_config(source)
    free = {*MACHINE_FIELDS, "total_frames", "run_dir"}
    fields = changed_fields(before, run.config)
    changed = [f"{name} {then}, not {now}" for name, (then, now) in fields.items() if name not in free]
    if changed:
        shown = ", ".join(changed[:3])
        more = f" and {len(changed) - 3} more" if len(changed) > 3 else ""
        msg = f"{folder} was trained with {shown}{more}; accepted: its own configuration, or another --runs"
        raise CheckpointError(msg)
    record = read_record(folder)
    asked = starts[run.init_from] if run.init_from else None
    if record.get("init_from_sha256", asked) != asked:
        msg = f"{folder} started from other networks than {run.init_from}; accepted: the same, or another --runs"
        raise CheckpointError(msg)


def _checkpoint_of(folder: Path) -> Path | None:
    # Its newest good checkpoint, or None where the run has not written any.
    for _ in range(3):
        if not any((folder / CHECKPOINT_FOLDER).glob("checkpoint-*")):
            return None
        try:
            return find_checkpoint(folder)
        except CheckpointError:
            if not is_locked(folder):
                raise
            time.sleep(_POLL_SECONDS)  # the process that trains has just taken it away
    return find_checkpoint(folder)


def _is_done(run: PlannedRun) -> bool:
    source = _checkpoint_of(run.config.run_dir)
    return source is not None and read_config(source)[1]["frames"] >= run.config.total_frames


def _machine_flags(config: TrainConfig) -> Iterator[str]:
    for field in MACHINE_FIELDS:
        parent, _, name = field.replace("_", "-").rpartition(".")
        prefix = f"--{parent}." if parent else "--"
        value = operator.attrgetter(field)(config)
        if isinstance(value, bool):
            yield prefix + (name if value else f"no-{name}")
        else:
            yield from (prefix + name, str(value))


def _end_group(pid: int) -> None:
    """Kill what is left of a child's session, such as workers of a learner that was killed."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)


def _last_line(path: Path) -> str:
    """Return the last line that was printed; a bar's states count as lines."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 4096))
        text = file.read().decode(errors="replace")
    last = next((line.strip() for line in reversed(re.split(r"[\r\n]", text)) if line.strip()), _PROMPT)
    return "no output" if last.startswith(_PROMPT.strip()) else last
