"""What a run shows and keeps while it trains: a row per update in progress.csv, TorchRL's logger, a progress bar."""

from __future__ import annotations

import csv
import importlib.util
import math
import sys
from typing import TYPE_CHECKING

from tqdm import tqdm

from cura_torchrl.trainers.errors import UnavailableError

if TYPE_CHECKING:
    from pathlib import Path

    from torchrl.record.loggers import Logger

    from cura_torchrl.trainers.config import TrainConfig

PROGRESS_NAME = "progress.csv"
"""File of a run with one row per update; what plots read."""


class Progress:
    """Rows, logger and bar of one run.

    Rows after ``frames`` are dropped first: they belong to updates that a killed run made after its last checkpoint.

    Args:
        config: The run's configuration.
        frames: Environment steps so far [1].

    Raises:
        UnavailableError: If the logger's package is not installed.
    """

    def __init__(self, config: TrainConfig, *, frames: int) -> None:
        self._path = config.run_dir / PROGRESS_NAME
        self._rows = [row for row in read_progress(self._path) if row["frames"] <= frames]
        self._logger = _make_logger(config)
        self._bar = tqdm(
            total=config.total_frames,
            initial=frames,
            unit="f",
            unit_scale=True,
            file=sys.stderr,
            smoothing=0.1,
            mininterval=1.0,
        )
        self._columns: list[str] = []

    def add(self, row: dict[str, float]) -> None:
        """Record one update.

        Args:
            row: Numbers by name; ``frames`` is the environment steps so far.
        """
        self._rows.append(row)
        new = [name for name in row if name not in self._columns]
        if new or not self._path.exists():
            self._rewrite()
        else:
            with self._path.open("a", newline="", encoding="utf-8") as file:
                csv.DictWriter(file, self._columns, restval="").writerow(_rounded(row))
        step = int(row["frames"])
        self._logger.log_metrics({name: value for name, value in row.items() if math.isfinite(value)}, step)
        self._bar.update(step - self._bar.n)
        shown = {"success": row.get("success", math.nan), "collision": row.get("collision", math.nan)}
        self._bar.set_postfix_str(
            f"{row['frames_per_second']:.0f} f/s, K={row['max_obstacles']:.0f}, "
            + ", ".join(f"{name} {value:.0%}" if math.isfinite(value) else f"{name} -" for name, value in shown.items())
        )

    def close(self) -> None:
        """Finish the bar, leaving its last state on the screen."""
        self._bar.close()

    def _rewrite(self) -> None:
        self._columns = list(dict.fromkeys(name for row in self._rows for name in row))
        partial = self._path.with_name(f"{self._path.name}.partial")
        with partial.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self._columns, restval="")
            writer.writeheader()
            writer.writerows(map(_rounded, self._rows))
        partial.replace(self._path)


def read_progress(path: Path) -> list[dict[str, float]]:
    """Return the rows of a run's progress.csv.

    Args:
        path: The file; one that does not exist has no rows.

    Returns:
        One dictionary per update; a cell that is empty is left out. A last row that was cut off is left out too.
    """
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    whole = [line for line in lines if line.endswith("\n")]
    return [{name: float(text) for name, text in entry.items() if text} for entry in csv.DictReader(whole)]


def _rounded(row: dict[str, float]) -> dict[str, str]:
    # Ten digits keep a count of frames whole.
    return {name: f"{value:.10g}" for name, value in row.items()}


def require_logger(config: TrainConfig) -> None:
    """Raise unless the logger can be imported.

    Args:
        config: The run.

    Raises:
        UnavailableError: If its package is not installed.
    """
    if config.logger != "csv" and importlib.util.find_spec(config.logger) is None:
        install = f"pip install cura-torchrl[{config.logger}]"
        msg = f"logger is {config.logger!r}, which is not installed; accepted: csv, or first {install}"
        raise UnavailableError(msg)


def _make_logger(config: TrainConfig) -> Logger:
    from torchrl.record.loggers import get_logger  # noqa: PLC0415 - rows are read without torch

    require_logger(config)
    # A folder of the run, or, where all runs are in one list, the run's name.
    name = config.run_dir.name if config.logger == "wandb" else "log"
    return get_logger(config.logger, logger_name=str(config.run_dir), experiment_name=name)
