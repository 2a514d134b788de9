"""Print what benchmarks/scaling.py has measured as the tables of docs/scaling.md.

python benchmarks/scaling_table.py benchmarks/results/scaling.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence


def as_tables(result: dict[str, Any]) -> str:
    """Return a result as the tables of ``docs/scaling.md``.

    Args:
        result: What this script prints.
    """
    model, measured, limit = result["model"], result["measured"], result["saturation"]
    facts = {
        "a frame as it is collected": f"{measured['frame_bytes_collected']:,.0f} bytes",
        "a frame as it is sent, pickled": f"{measured['frame_bytes_pickled']:,.0f} bytes",
        "the policy's weights, pickled": f"{model['weight_bytes']:,.0f} bytes",
        "one core collects": f"{model['core_fps']:,.0f} frames/s",
        "the learner, one thread": f"{model['learner_fps']:,.0f} frames/s",
        "the learner's process takes a frame from Ray": f"{model['fetch_seconds_per_frame'] * 1e6:.1f} microseconds",
        "each worker adds to an iteration": f"{model['call_seconds_per_worker'] * 1e3:.1f} ms",
        "waiting for the answers of one worker": f"{model['call_seconds'] * 1e3:.1f} ms",
    }
    for count, seconds in measured["ray_seconds"]["send"].items():
        cell = (
            f"{seconds['wall'] * 1e3:.0f} ms on the wall, {seconds['processor'] * 1e3:.1f} ms of the learner's process"
        )
        facts[f"weights to {count} workers of one machine"] = cell
    without_learning = limit["frames_per_second_without_learning"]
    limits = {
        "limit, whatever the number of nodes": f"{limit['frames_per_second']:,.0f} frames/s",
        "workers that would collect as much": f"{limit['workers']:.0f}",
        "limit of Ray and network, if learning took no time": f"{without_learning:,.0f} frames/s",
    }
    rows = [
        (
            f"{row['nodes']:,}",
            f"{row['workers']:,}",
            f"{row['frames_per_rollout']:,}",
            f"{row['frames_per_second']:,.0f}",
            *(f"{row['shares'][part]:.1%}" for part in ("collect", "learn")),
            f"{row['shares']['calls'] + row['shares']['fetch']:.1%}",
            f"{row['shares']['network']:.1%}",
        )
        for row in result["predictions"]
    ]
    checks = [
        (count, *(f"{check[name]:.2f}" for name in ("measured", "predicted", "wall")))
        for count, check in result["check"].items()
    ]
    heads = ("Nodes", "Workers", "Rollout", "Frames/s", "Collect", "Learn", "Ray", "Network")
    return "\n".join(
        [
            _table(("Measured", ""), facts.items()),
            _table(("Workers", "Measured [s]", "Predicted [s]", "Wall [s]"), checks),
            _table(heads, rows),
            _table(("Saturation", ""), limits.items()),
        ]
    )


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


if __name__ == "__main__":
    print(as_tables(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))), end="")
