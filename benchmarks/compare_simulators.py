"""Print how the success rates of the same policies on the same scenes differ between the two simulators, as Markdown.

Reads what ``evaluate --json`` printed:
python benchmarks/compare_simulators.py benchmarks/results/bullet benchmarks/results/planar
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

from cura_torchrl.trainers.statistics import wilson_interval

SIZES = (0.5, 0.75, 1.0)


def difference(one: tuple[int, int], other: tuple[int, int]) -> tuple[float, float, float]:
    """Return the difference of two rates with its 95 % interval, as if the episodes were not the same.

    Args:
        one: Successes and trials.
        other: Successes and trials that the first are subtracted from.

    Returns:
        Difference, lower and upper bound [1].

    Source:
        Newcombe (1998), "Interval estimation for the difference between independent proportions", method 10.

    Examples:
        >>> [round(value, 3) for value in difference((48, 80), (56, 70))]
        [0.2, 0.053, 0.334]
    """
    (rate_a, low_a, high_a), (rate_b, low_b, high_b) = ((k / n, *wilson_interval(k, n)) for k, n in (one, other))
    middle = rate_b - rate_a
    below = math.hypot(rate_b - low_b, high_a - rate_a)
    above = math.hypot(high_b - rate_b, rate_a - low_a)
    return middle, middle - below, middle + above


def read(folder: Path) -> dict[tuple[str, str, int, float], dict[str, Any]]:
    """Return the results of a folder by method, scenario, K and size."""
    results = [json.loads(file.read_text(encoding="utf-8")) for file in sorted(folder.glob("*.json"))]
    return {(r["method"], r["scenario"], r["max_obstacles"], r["object_size"]): r for r in results}


def row(name: str, one: tuple[int, int], other: tuple[int, int]) -> str:
    """Return a row of the table: rates of both simulators and their difference in points."""
    middle, low, high = (100 * value for value in difference(one, other))
    rates = " | ".join(f"{100 * k / n:.1f} ({n})" for k, n in (one, other))
    return f"| {name} | {rates} | {middle:+.1f} ({low:+.1f} to {high:+.1f}) |"


def main() -> None:
    """Parse the command line and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs=2, help="results on PyBullet, results on the planar simulator")
    bullet, planar = (read(folder) for folder in parser.parse_args().folders)
    print("| Policy, size | PyBullet [%] (episodes) | planar [%] (episodes) | difference [points] (95 % interval) |")
    print("|---|---|---|---|")
    shared = [key for key in bullet if key in planar]
    for method in sorted({key[0] for key in shared}):
        for size in SIZES:
            keys = [key for key in shared if key[0] == method and key[3] == size]
            if keys:
                sums = [
                    (sum(r[key]["successes"] for key in keys), sum(r[key]["episodes"] for key in keys))
                    for r in (bullet, planar)
                ]
                print(row(f"{method}, {size} m, {len(keys)} cells", *sums))


if __name__ == "__main__":
    main()
