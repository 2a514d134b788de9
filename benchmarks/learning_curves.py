"""Draw the curves of runs side by side; a run is a method whose weights are shipped, a folder, or its progress.csv.

python benchmarks/learning_curves.py cura-ppo push --output curves.png
python benchmarks/learning_curves.py runs/cura-ppo-0,runs/cura-ppo-1 runs/push-0,runs/push-1 --output curves.png
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

from matplotlib.figure import Figure

from cura_torchrl.trainers.checkpoint import find_checkpoint, progress_path
from cura_torchrl.trainers.loaded_policy import load_policy
from cura_torchrl.trainers.methods import PRESETS
from cura_torchrl.trainers.training.progress import read_progress

PANELS = (
    ("success", "success rate, last 200 episodes [1]"),
    ("collision", "collision rate, last 200 episodes [1]"),
    ("timeout", "time-out rate, last 200 episodes [1]"),
    ("object_speed", "speed of the object [m/s]"),
    ("risk_auroc", "AUROC of the risk, collision within 2 s [1]"),
    ("explained_variance", "variance that the critic explains [1]"),
)
WINDOW = 15
"""Updates that a point is the mean of [1]."""


def smooth(rows: list[dict[str, float]], name: str) -> tuple[list[float], list[float]]:
    """Return environment steps [million] and moving means.

    Args:
        rows: Rows of a run's progress.
        name: Column.
    """
    points = [(row["frames"] / 1e6, row[name]) for row in rows if math.isfinite(row.get(name, math.nan))]
    windows = [points[max(0, end - WINDOW) : end] for end in range(1, len(points) + 1)]
    return [window[-1][0] for window in windows], [sum(y for _, y in window) / len(window) for window in windows]


def rows_of(run: str) -> list[dict[str, float]]:
    """Return a run's progress.

    Args:
        run: Name of a method, folder of a run, or file with its progress.
    """
    if run.endswith(".csv"):
        return read_progress(Path(run))
    source = load_policy(run).path if run in PRESETS else find_checkpoint(Path(run))
    return read_progress(progress_path(source))


def last_means(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return the frames of a run, and means over its last updates of what tells how it does and what its costs weigh.

    Args:
        rows: Rows of a run's progress.
    """
    names = [name for name, _ in PANELS] + ["episode_steps", "risk_weight", "uncertainty_weight"]
    ends = {name: smooth(rows, name)[1] for name in names}
    return {"frames": rows[-1]["frames"]} | {name: round(values[-1], 4) for name, values in ends.items() if values}


def main() -> None:
    """Parse the command line and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "runs", nargs="+", help="methods whose weights are shipped, or folders of runs; commas join the seeds of one"
    )
    parser.add_argument("--output", type=Path, required=True, help="picture to write")
    parser.add_argument("--summary", type=Path, help="JSON file to write, with means over the last updates of each run")
    options = parser.parse_args()
    figure = Figure(figsize=(11, 5.6), layout="constrained")
    axes = figure.subplots(2, 3, sharex=True)
    summary = {}
    for index, group in enumerate(options.runs):
        seeds = group.split(",")
        name = Path(group).stem if len(seeds) == 1 else Path(seeds[0]).stem.rpartition("-")[0]
        for run in seeds:
            rows = rows_of(run)
            summary[Path(run).stem] = last_means(rows)
            look = {"color": f"C{index}", "linewidth": 1.4 if len(seeds) == 1 else 0.9}
            for axis, (column, _) in zip(axes.flat, PANELS, strict=True):
                axis.plot(*smooth(rows, column), label=name if run == seeds[0] else None, **look)
    for axis, (name, title) in zip(axes.flat, PANELS, strict=True):
        axis.set_title(title, loc="left", fontsize=9)
        axis.grid(alpha=0.3)
        if name != "object_speed":
            axis.set_ylim(0.0, 1.0)
    for axis in axes[-1]:
        axis.set_xlabel("environment steps [million]")
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), 6), fontsize=8)
    figure.savefig(options.output, dpi=110)
    if options.summary is not None:
        options.summary.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
