"""How trained runs end episodes, and how much they look, side by side on the same scenes of the planar simulator.

python benchmarks/research/compare_runs.py none=runs/none letter=runs/letter --output runs/research/bravery.json
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from recording import KINDS, PERIOD, SIZES, save, share_of, task

from cura_torchrl.trainers.evaluation.active_perception import LookingMeter
from cura_torchrl.trainers.evaluation.episodes import Episode, play_episodes, summarise
from cura_torchrl.trainers.evaluation.statistics import bootstrap_interval
from cura_torchrl.trainers.loaded_policy import LoadedPolicy, load_policy
from cura_torchrl.trainers.threads import one_thread

PANELS = (
    ("success", "success rate [1]"),
    ("collision", "collision rate [1]"),
    ("timeout", "time-out rate [1]"),
    ("object_speed", "object's speed [m/s]"),
    ("unseen_ahead", "unseen of the area ahead [1]"),
    ("beside_q90_m", "beside the object's way, 90 % quantile [m]"),
)


def play(
    loaded: LoadedPolicy, kind: Any, size: float, options: argparse.Namespace
) -> tuple[list[Episode], dict[str, float]]:
    """Return how the scenes of a cell are played, and how much is looked."""
    scenes = task(loaded, kind=kind, object_edges=(size,), max_obstacles=options.max_obstacles)
    scenes = dataclasses.replace(scenes, privileged=True)
    worlds = min(options.envs, options.episodes)
    with closing(loaded.make_env(worlds, task=scenes, simulator="planar", seed=options.seed)) as env:
        meter = LookingMeter(env, loaded.config.env.lidar, PERIOD)
        episodes = play_episodes(env, loaded.policy, torch.arange(options.episodes), watch=meter.watch)
    return episodes, meter.summary()


def outcome(cells: dict[str, tuple[list[Episode], dict[str, float]]]) -> dict[str, Any]:
    """Return rates over all cells with intervals, means of the measures, and the outcomes scene by scene."""
    total = summarise([episode for played, _ in cells.values() for episode in played])
    counts = {"success": total["successes"], "collision": total["collisions"], "timeout": total["timeouts"]}
    measures = [measure for _, measure in cells.values()]
    found = {cell: (summarise(played), measure) for cell, (played, measure) in cells.items()}
    return {
        **{name: share_of(count, total["episodes"]) for name, count in counts.items()},
        **{name: float(np.mean([measure[name] for measure in measures])) for name in measures[0]},
        "cells": {
            cell: {"success": own["success_rate"], **measure, "outcomes": own["outcomes"]}
            for cell, (own, measure) in found.items()
        },
    }


def paired(first: dict[str, Any], second: dict[str, Any]) -> list[float]:
    """Return by how much the first succeeds more often on the same scenes, with its bootstrap interval [1]."""
    scored = [
        np.array([letter == "s" for cell in result["cells"].values() for letter in cell["outcomes"]], dtype=float)
        for result in (first, second)
    ]
    gain = scored[0] - scored[1]
    return [float(gain.mean()), *bootstrap_interval(lambda pick: float(gain[pick].mean()), len(gain))]


def draw(runs: dict[str, dict[str, Any]]) -> Figure:
    """Return the figure: a panel a measure, a bar a run."""
    figure = Figure(figsize=(12, 1.6 + 0.5 * len(runs)), layout="constrained")
    for axis, (name, label) in zip(figure.subplots(2, 3, sharey=True).flat, PANELS, strict=True):
        values = [np.atleast_1d(result[name]) for result in runs.values()]
        middle = np.array([value[0] for value in values])
        error = np.array([[v[0] - v[1], v[2] - v[0]] if len(v) == 3 else [0.0, 0.0] for v in values]).T
        axis.barh(list(runs), middle, xerr=error, error_kw={"elinewidth": 0.8})
        axis.set_xlabel(label)
        axis.grid(axis="x", alpha=0.3)
    figure.axes[0].invert_yaxis()
    return figure


def main() -> None:
    """Play every run and write what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="NAME=RUN", help="a run's or a checkpoint's folder under a name")
    parser.add_argument("--episodes", type=int, default=100, help="scenes a cell")
    parser.add_argument("--envs", type=int, default=100, help="worlds side by side")
    parser.add_argument("--seed", type=int, default=2000, help="seed of the scenes; never 0, the evaluation's")
    parser.add_argument("--max-obstacles", type=int, default=6, help="most obstacles K in an episode")
    parser.add_argument("--output", type=Path, default=Path("runs/research/compare_runs.json"), help="result file")
    options = parser.parse_args()
    results: dict[str, Any] = {}
    for name, folder in (entry.split("=", 1) for entry in options.runs):
        loaded = load_policy(Path(folder))
        with one_thread():
            cells = {
                f"{kind}, {size} m": play(loaded, kind, size, options) for size, kind in itertools.product(SIZES, KINDS)
            }
        results[name] = {"frames": loaded.record["frames"], "commit": loaded.record["commit"], **outcome(cells)}
        shown = {key: np.round(results[name][key], 3).tolist() for key, _ in PANELS}
        print(name, shown, flush=True)
    first = next(iter(results))
    gains = {name: paired(result, results[first]) for name, result in results.items() if name != first}
    settings = {key: value for key, value in vars(options).items() if key not in {"runs", "output"}}
    save({"settings": settings, "runs": results, f"gain_over_{first}": gains}, draw(results), options.output)


if __name__ == "__main__":
    main()
