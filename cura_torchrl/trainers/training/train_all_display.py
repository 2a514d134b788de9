"""What is shown while many runs train: a bar over all frames, and a line per run."""

from __future__ import annotations

import sys
import time
from collections import Counter
from typing import TYPE_CHECKING

from tqdm import tqdm

from cura_torchrl.trainers.training.run_status import RunStatus, read_status

if TYPE_CHECKING:
    from collections.abc import Sequence
    from collections.abc import Set as AbstractSet

    from cura_torchrl.trainers.training.train_all_config import PlannedRun

_TERMINAL_SECONDS = 2.0
_LOG_SECONDS = 60.0


class Display:
    """Lines and bar on stderr: on a terminal in place, in a log the running ones once a minute.

    Args:
        runs: The runs, in the order of their lines.
    """

    def __init__(self, runs: Sequence[PlannedRun]) -> None:
        self._runs = runs
        self._is_terminal = sys.stderr.isatty()
        self._interval = _TERMINAL_SECONDS if self._is_terminal else _LOG_SECONDS
        self._shown_at = -self._interval
        self._states: dict[str, RunStatus] = {run.name: read_status(run) for run in runs}
        done = sum(self._frames(status) for status in self._states.values())
        total = sum(run.config.total_frames for run in runs)
        self._lines = [
            tqdm(total=0, bar_format="{desc}", position=index, file=sys.stderr, leave=True)
            for index in range(len(runs) if self._is_terminal else 0)
        ]
        self._bar = tqdm(
            total=total,
            initial=done,
            unit="f",
            unit_scale=True,
            file=sys.stderr,
            position=len(self._lines),
            mininterval=self._interval,
        )

    def __enter__(self) -> Display:
        return self

    def __exit__(self, *_: object) -> None:
        self._shown_at = -self._interval
        self.show(frozenset())
        for bar in (*self._lines, self._bar):
            bar.close()

    def tell(self, message: str) -> None:
        """Print a line above all others.

        Args:
            message: The line.
        """
        tqdm.write(message, file=sys.stderr)

    def show(self, running: AbstractSet[str]) -> None:
        """Show how far the runs are, unless that was just done.

        Args:
            running: Names of the runs that some process trains.
        """
        if time.monotonic() - self._shown_at < self._interval:
            return
        self._shown_at = time.monotonic()
        for run in self._runs:
            if self._states[run.name].state != "done":
                self._states[run.name] = read_status(run, is_running=run.name in running)
        statuses = list(self._states.values())
        counts = Counter(status.state for status in statuses)
        self._bar.set_postfix_str(", ".join(f"{count} {state}" for state, count in counts.items()), refresh=False)
        self._bar.update(sum(map(self._frames, statuses)) - self._bar.n)
        self._bar.refresh()
        for line, status in zip(self._lines, statuses, strict=False):
            line.set_description_str(status.as_line())
        if not self._is_terminal:
            for status in statuses:
                if status.state == "running":
                    self.tell(status.as_line())

    @staticmethod
    def _frames(status: RunStatus) -> int:
        return min(status.frames, status.total_frames)
