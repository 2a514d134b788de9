"""Print the cells that evaluate_cells.sh wrote as Markdown: success [%], its interval, collisions, time-outs.

python benchmarks/results_table.py benchmarks/results/bullet
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

SIZES = (0.5, 0.75, 1.0)


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


def main() -> None:
    """Parse the command line and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of JSON files")
    folder = parser.parse_args().folder
    results = [json.loads(file.read_text(encoding="utf-8")) for file in sorted(folder.glob("*.json"))]
    print(table(results))
    print(f"\n{len(results)} cells; in each cell: success [%] (95 % interval), collisions / time-outs.")


if __name__ == "__main__":
    main()
