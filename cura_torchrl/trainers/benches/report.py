"""What the benchmarks share: measuring in turn, and figures and ratios with their spread."""

from __future__ import annotations

import statistics
import sys
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence


@dataclass
class Report:
    """What was measured: figures and ratios with their spread over the rounds, and what must hold for them to count."""

    figures: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Median, least and most of each figure, and its unit."""
    ratios: dict[str, dict[str, Any]] = field(default_factory=dict)
    """The same of ratios, each taken within a round, and what is aimed at."""
    checks: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Value of each check, its largest accepted value, and whether it holds."""
    notes: list[str] = field(default_factory=list)
    """What was left out, and why."""

    def add_figure(self, name: str, values: Sequence[float], unit: str) -> None:
        """Add a figure.

        Args:
            name: What it is.
            values: Its value in each round.
            unit: Unit of the values.
        """
        self.figures[name] = {**spread(values), "unit": unit}

    def add_ratio(self, name: str, over: Sequence[float], under: Sequence[float], aim: str | None = None) -> None:
        """Add a ratio of two figures of the same rounds.

        Args:
            name: What is divided by what.
            over: Numerator in each round.
            under: Denominator in each round.
            aim: What is aimed at, such as ">= 0.75"; none is nothing.
        """
        self.ratios[name] = {**spread([a / b for a, b in zip(over, under, strict=True)]), "aim": aim}

    def add_check(self, name: str, value: float, most: float) -> None:
        """Add a condition without which the figures mean nothing.

        Args:
            name: What is compared.
            value: How far it is off.
            most: How far it may be off.
        """
        self.checks[name] = {"value": value, "most": most, "holds": value <= most}


def spread(values: Sequence[float]) -> dict[str, float]:
    """Return median, least and most.

    Args:
        values: One value a round.

    Returns:
        Those three, to four significant digits.

    Examples:
        >>> spread([1.0, 4.0, 2.0])
        {'median': 2.0, 'min': 1.0, 'max': 4.0}
    """
    parts = {"median": statistics.median(values), "min": min(values), "max": max(values)}
    return {name: float(f"{value:.4g}") for name, value in parts.items()}


def timed(function: Callable[[], object], clock: Callable[[], float] = time.process_time) -> Callable[[], float]:
    """Return a function that calls another one and says how long it took.

    Args:
        function: What is timed.
        clock: Clock [s]; processor time of all threads, which other users of the machine disturb least, unless given.

    Returns:
        Function that returns seconds.
    """

    def play() -> float:
        start = clock()
        function()
        return clock() - start

    return play


def measure(plays: Mapping[str, Callable[[], float]], rounds: int, title: str = "") -> dict[str, list[float]]:
    """Measure in turn, so that a disturbance meets all.

    Args:
        plays: What is measured; each returns the seconds that it took.
        rounds: How often each is called, after once to warm up.
        title: Title of the progress bar.

    Returns:
        Seconds in each round, by name.
    """
    seconds: dict[str, list[float]] = {name: [] for name in plays}
    with tqdm(total=(rounds + 1) * len(plays), desc=title, file=sys.stderr, leave=False, disable=None) as bar:
        for index in range(rounds + 1):
            for name, play in plays.items():
                bar.set_postfix_str(name)
                taken = play()
                if index > 0:
                    seconds[name].append(taken)
                bar.update()
    return seconds


def rates(work: float, seconds: Sequence[float]) -> list[float]:
    """Return work per second.

    Args:
        work: Work of a round, in any unit.
        seconds: Time of each round [s].

    Returns:
        Work per second of each round.

    Examples:
        >>> rates(6.0, [2.0, 3.0])
        [3.0, 2.0]
    """
    return [work / taken for taken in seconds]
