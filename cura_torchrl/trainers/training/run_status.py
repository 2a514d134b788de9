"""How far a run is, read from its folder alone, whoever trains it."""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from cura_torchrl.trainers.training.progress import PROGRESS_NAME, read_progress
from cura_torchrl.trainers.training.run_folder import CHECKPOINT_FOLDER, is_locked

if TYPE_CHECKING:
    from pathlib import Path

    from cura_torchrl.trainers.training.train_all_config import PlannedRun

State = Literal["waiting", "running", "done", "failed", "interrupted"]

RECORD_NAME = "train-all.json"
"""File of a run with what its checkpoints do not tell: hash of its warm start, last process, why it failed."""


@dataclass(frozen=True, kw_only=True)
class RunStatus:
    """How far a run is."""

    method: str
    """Method."""
    seed: int
    """Training seed."""
    state: State
    """waiting: never trained; running: a process trains it; interrupted: begun, and no process trains it."""
    frames: int
    """Environment steps so far [1]: of the last update while it runs, else of the last checkpoint."""
    total_frames: int
    """Environment steps that are asked for [1]."""
    frames_per_second: float | None
    """Speed of the last update [1/s]."""
    success: float | None
    """Share of recent episodes that succeed [1]."""
    collision: float | None
    """Share of recent episodes that end in a collision [1]."""
    max_obstacles: float | None
    """K, the most obstacles of an episode at the last update [1]."""
    seconds_left: float | None
    """Time left at that speed [s]; None unless it runs."""
    checkpoint_age: float | None
    """Time since the last checkpoint [s]."""
    error: str | None
    """Why it failed."""

    def as_line(self) -> str:
        """Return the status as one line of text.

        Returns:
            Columns that line up below each other; a dash is what is not known.
        """
        columns = [
            f"{self.method:<19} {self.seed:>3}  {self.state:<11}",
            f"{self.frames:>12,}/{self.total_frames:,} {min(1.0, self.frames / self.total_frames):>4.0%}",
            f"{_shown(self.frames_per_second, ',.0f'):>7} f/s",
            f"success {_shown(self.success, '.0%'):>4}  collision {_shown(self.collision, '.0%'):>4}",
            f"K {_shown(self.max_obstacles, '.0f')}",
            f"left {_duration(self.seconds_left):>7}  checkpoint {_duration(self.checkpoint_age):>7} ago",
        ]
        return "  ".join([*columns, *([self.error] if self.error else [])])


def read_status(run: PlannedRun, *, is_running: bool | None = None) -> RunStatus:
    """Return how far a run is.

    Args:
        run: The run that is asked for.
        is_running: Whether a process trains it; None looks at the lock.

    Returns:
        The status. Reads names, times and small files; whether the checkpoint is whole is not checked.
    """
    folder, total = run.config.run_dir, run.config.total_frames
    running = is_locked(folder) if is_running is None else is_running
    rows = read_progress(folder / PROGRESS_NAME)
    last = rows[-1] if rows else {}
    saved, age = _newest_checkpoint(folder)
    frames = max(saved or 0, int(last.get("frames", 0))) if running else saved or 0
    error = read_record(folder).get("error")
    state: State = "interrupted" if folder.is_dir() else "waiting"
    if saved is not None and saved >= total:
        state = "done"
    elif running:
        state = "running"
    elif error is not None:
        state = "failed"
    speed = _known(last, "frames_per_second")
    return RunStatus(
        method=run.config.method,
        seed=run.config.seed,
        state=state,
        frames=frames,
        total_frames=total,
        frames_per_second=speed,
        success=_known(last, "success"),
        collision=_known(last, "collision"),
        max_obstacles=_known(last, "max_obstacles"),
        seconds_left=max(0, total - frames) / speed if state == "running" and speed else None,
        checkpoint_age=age,
        error=error if state == "failed" else None,
    )


def read_record(folder: Path) -> dict[str, Any]:
    """Return what was written down about a run beside its checkpoints.

    Args:
        folder: The run's folder.

    Returns:
        The record; empty where there is none.
    """
    try:
        record = json.loads((folder / RECORD_NAME).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def write_record(folder: Path, **changes: Any) -> None:
    """Change what is written down about a run, all of it or nothing.

    Args:
        folder: The run's folder, which exists.
        **changes: New values by name.
    """
    stage = folder / f".{RECORD_NAME}"
    stage.write_text(json.dumps({**read_record(folder), **changes}, indent=2) + "\n", encoding="utf-8")
    stage.replace(folder / RECORD_NAME)


def _newest_checkpoint(folder: Path) -> tuple[int | None, float | None]:
    """Return frames and age [s] of the newest checkpoint; a run that trains may take it away meanwhile."""
    try:
        newest = max((folder / CHECKPOINT_FOLDER).glob("checkpoint-*"))
        return int(newest.name.rpartition("-")[2]), max(0.0, time.time() - newest.stat().st_mtime)
    except (OSError, ValueError):
        return None, None


def _known(row: dict[str, float], name: str) -> float | None:
    value = row.get(name, math.nan)
    return value if math.isfinite(value) else None


def _shown(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return "-"
    for unit, length in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"
