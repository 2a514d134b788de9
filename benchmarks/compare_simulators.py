"""Print how the success rates of the same policies on the same scenes differ between the two simulators, as Markdown.

Reads what ``evaluate --json`` printed:
python benchmarks/compare_simulators.py benchmarks/results/bullet benchmarks/results/planar
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from results_table import SIZES, successes

from cura_torchrl.trainers.statistics import paired_difference

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def read(folder: Path) -> dict[tuple[str, str, int, float], dict[str, Any]]:
    """Return the results of a folder that say how each scene ended, by method, scenario, K and size."""
    results = [json.loads(file.read_text(encoding="utf-8")) for file in sorted(folder.glob("*.json"))]
    paired = [result for result in results if "outcomes" in result]
    return {(r["method"], r["scenario"], r["max_obstacles"], r["object_size"]): r for r in paired}


def row(name: str, one: NDArray[np.bool_], other: NDArray[np.bool_]) -> str:
    """Return a row of the table: rates of both simulators, scene by scene, and their difference in points."""
    middle, low, high = (100 * value for value in paired_difference(one, other))
    rates = " | ".join(f"{100 * own.mean():.1f} ({len(own)})" for own in (one, other))
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
                pair = (successes([results[key] for key in keys]) for results in (bullet, planar))
                print(row(f"{method}, {size} m, {len(keys)} cells", *pair))


if __name__ == "__main__":
    main()
