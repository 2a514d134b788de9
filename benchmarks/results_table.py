"""Print the cells that evaluate_cells.sh wrote as Markdown: success [%], its interval, collisions, time-outs.

Then what occlusion costs, and what CURA-PPO wins back on the same scenes.

python benchmarks/results_table.py benchmarks/results/bullet
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cura_torchrl.trainers.statistics import paired_difference, share_recovered

if TYPE_CHECKING:
    from numpy.typing import NDArray

SIZES = (0.5, 0.75, 1.0)
METHODS = ("push-no-occlusion", "push", "cura-ppo")


def cell(result: dict[str, Any] | None) -> str:
    """Return one cell of the table.

    Args:
        result: What ``evaluate --json`` printed; None where it was not played.
    """
    if result is None:
        return "-"
    rate, low, high = (100.0 * result[name] for name in ("success_rate", "wilson_low", "wilson_high"))
    return f"{rate:.1f} ({low:.0f} to {high:.0f}), {result['collisions']} / {result['timeouts']}"


def table(results: list[dict[str, Any]]) -> str:
    """Return the table, a row for each policy, scenario and K.

    Args:
        results: What ``evaluate --json`` printed, any number of times.
    """
    found = {(r["method"], r["scenario"], r["max_obstacles"], r["object_size"]): r for r in results}
    rows = sorted({key[:3] for key in found}, key=lambda key: (key[2], key[1], key[0]))
    lines = ["| Policy | Scenario | K | 0.5 m | 0.75 m | 1.0 m |", "|---|---|---|---|---|---|"]
    for method, scenario, most in rows:
        shown = scenario if most > 0 else "no obstacles"
        cells = [cell(found.get((method, scenario, most, size))) for size in SIZES]
        lines.append(f"| {method} | {shown} | {most} | {' | '.join(cells)} |")
    return "\n".join(lines)


def successes(results: list[dict[str, Any]]) -> NDArray[np.bool_]:
    """Return whether each scene of some cells ended in success, cell by cell.

    Args:
        results: What ``evaluate --json`` printed.
    """
    return np.array([letter == "s" for result in results for letter in result["outcomes"]])


def comparison(results: list[dict[str, Any]]) -> str:
    """Return what occlusion costs and what CURA-PPO wins back, scene by scene, per cell and over all.

    Args:
        results: What ``evaluate --json`` printed; cells that not all three methods have played are left out.
    """
    played: dict[tuple[str, float], dict[str, dict[str, Any]]] = defaultdict(dict)
    for result in results:
        if result["method"] in METHODS and "outcomes" in result:
            played[result["scenario"], result["object_size"]][result["method"]] = result
    cells = {key: cell for key, cell in played.items() if len(cell) == len(METHODS)}
    rows = {f"{scenario}, {size} m": [cell] for (scenario, size), cell in sorted(cells.items(), reverse=True)}
    lines = ["| Cell (scenes) | lost by occlusion [points] | won back [points] |", "|---|---|---|"]
    for name, group in {**rows, "all": list(cells.values())}.items():
        free, push, cura = (successes([cell[method] for cell in group]) for method in METHODS)
        gains = (paired_difference(push, other) for other in (free, cura))
        shown = [f"{100 * middle:+.1f} ({100 * low:+.1f} to {100 * high:+.1f})" for middle, low, high in gains]
        lines.append(f"| {name} ({len(push)}) | {' | '.join(shown)} |")
    trials = [[successes([cell[method]]) for method in METHODS] for cell in cells.values()]
    share = ", ".join(f"{value:.2f}" for value in share_recovered(trials))
    return "\n".join(
        [*lines, "", f"Share of the loss won back over all cells, and its 95 % bootstrap interval: {share}."]
    )


def main() -> None:
    """Parse the command line and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of JSON files")
    folder = parser.parse_args().folder
    results = [json.loads(file.read_text(encoding="utf-8")) for file in sorted(folder.glob("*.json"))]
    print(table(results) + "\n\n" + comparison(results))
    print(f"\n{len(results)} cells; in each cell: success [%] (95 % interval), collisions / time-outs.")


if __name__ == "__main__":
    main()
