"""Can looking pay? Scripted pushers that know what their LiDAR has hit, and how much of the loss looking recovers.

The loss is that of the straight one against the same one whose rays pass through the object. Plays frozen scenes:
python benchmarks/research/looking_pays.py --output runs/research/looking_pays.json
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lookers import PeekingPusher, SeeingPusher, SwingingPusher, WeavingPusher
from matplotlib.figure import Figure
from recording import KINDS, PERIOD, SIZES, gaps, save, share_of

from cura_torchrl import keys
from cura_torchrl.envs import geometry
from cura_torchrl.envs.config import LidarConfig, PushEnvConfig, ScenarioConfig, TaskConfig
from cura_torchrl.envs.mdp.observations import OBSERVATION_SLICES
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.trainers.evaluation.episodes import Episode, play_episodes, summarise
from cura_torchrl.trainers.evaluation.statistics import bootstrap_interval
from cura_torchrl.trainers.threads import one_thread

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray
    from tensordict import TensorDictBase

MOVING = 0.2
"""Speed above which the object counts as moving [m/s]."""
STRATEGIES: dict[str, Callable[[], SeeingPusher]] = {
    "straight": SeeingPusher,
    "no occlusion": SeeingPusher,
    "slow": lambda: SeeingPusher(speed=0.55),
    "swing": SwingingPusher,
    "swing, slow": lambda: SwingingPusher(speed=0.55),
    "weave": WeavingPusher,
    "peek": PeekingPusher,
    "wait": lambda: SeeingPusher(wait=15.0),
}
"""The first two bound the loss: both go straight, the second's rays pass through the object."""


def play(
    strategy: str, kind: Any, size: float, options: argparse.Namespace
) -> tuple[list[Episode], list[bool], torch.Tensor]:
    """Return how the scenes of a cell are played.

    Returns:
        The episodes; of each collision whether it was with a known obstacle; how far beside the object's way the base
        was [m], in every step in which the object moved.
    """
    scenario = ScenarioConfig(kind=kind, object_edges=(size,), max_obstacles=options.max_obstacles)
    task = dataclasses.replace(TaskConfig(), scenario=scenario, stream="eval", privileged=True)
    lidar = LidarConfig(occlusion=strategy != "no occlusion")
    config = PushEnvConfig(simulator="planar", task=task, lidar=lidar)
    policy, known, beside = STRATEGIES[strategy](), [], []
    with closing(PushEnv(min(options.envs, options.episodes), config, seed=options.seed)) as env:

        def watch(state: TensorDictBase, playing: torch.Tensor) -> None:
            collides = state[keys.CONTACT].any(-1) & ~state[keys.SUCCESS][:, 0] & playing
            rows = collides.nonzero().flatten()
            known.extend(policy.known[rows, gaps(env)[rows].argmin(-1)].tolist())
            parts = {name: state[keys.OBSERVATION][:, part] for name, part in OBSERVATION_SLICES.items()}
            centre, velocity = parts["object_position"][:, :2], parts["object_velocity"]
            speed = geometry.norm(velocity)
            across = (velocity[:, 0] * centre[:, 1] - velocity[:, 1] * centre[:, 0]).abs() / speed.clamp_min(1e-6)
            beside.append(across[playing & (speed > MOVING)])

        return play_episodes(env, policy, torch.arange(options.episodes), watch=watch), known, torch.cat(beside)


def outcome(episodes: list[Episode], known: list[bool], beside: torch.Tensor) -> dict[str, Any]:
    """Return the counts and Wilson's intervals of a cell, and the outcomes scene by scene."""
    total = summarise(episodes)
    count = total["episodes"]
    return {
        "episodes": count,
        "success": share_of(total["successes"], count),
        "collision": share_of(total["collisions"], count),
        "collisions_with_known": sum(known),
        "beside_m": {f"q{round(100 * share)}": round(float(beside.quantile(share)), 3) for share in (0.5, 0.9)},
        "timeout": total["timeouts"] / count,
        "mean_seconds": PERIOD * total["mean_steps"],
        "outcomes": total["outcomes"],
    }


def recovered(straight: NDArray[Any], free: NDArray[Any], looking: NDArray[Any]) -> dict[str, Any]:
    """Return what looking gains on the same scenes, and its share of what occlusion costs, with intervals.

    Args:
        straight: Whether the straight pusher succeeds, by scene.
        free: Whether it does without occlusion.
        looking: Whether the looking one does.
    """

    def statistics(pick: NDArray[np.int64]) -> NDArray[np.float64]:
        loss, gain = (free[pick].mean() - straight[pick].mean(), looking[pick].mean() - straight[pick].mean())
        return np.array([loss, gain, gain / loss if loss > 0 else np.nan])

    found = statistics(np.arange(len(straight)))
    low, high = bootstrap_interval(statistics, len(straight))
    return {name: list(row) for name, *row in zip(("loss", "gain", "share"), found.tolist(), low, high, strict=True)}


def compare(cells: dict[str, dict[str, Any]], strategies: list[str]) -> dict[str, Any]:
    """Return the gain of every looking strategy by cell and over all of them."""
    scored = {
        cell: {name: np.array([letter == "s" for letter in result["outcomes"]]) for name, result in results.items()}
        for cell, results in cells.items()
    }
    scored["all"] = {name: np.concatenate([cell[name] for cell in scored.values()]) for name in strategies}
    return {
        cell: {
            name: recovered(results["straight"], results["no occlusion"], results[name])
            for name in strategies
            if name not in {"straight", "no occlusion"}
        }
        for cell, results in scored.items()
    }


def draw(cells: dict[str, dict[str, Any]], strategies: list[str]) -> Figure:
    """Return the figure: success and collision by cell and strategy."""
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    for axis, rate in zip(figure.subplots(2, 1, sharex=True), ("success", "collision"), strict=True):
        for index, name in enumerate(strategies):
            middle, low, high = np.array([results[name][rate] for results in cells.values()]).T
            spot = np.arange(len(cells)) + 0.85 * (index + 0.5) / len(strategies) - 0.425
            error = np.stack([middle - low, high - middle])
            axis.bar(spot, middle, 0.85 / len(strategies), yerr=error, label=name, error_kw={"elinewidth": 0.8})
        axis.set_xticks(np.arange(len(cells)), list(cells))
        axis.set_ylabel(f"{rate} rate [1]")
        axis.grid(axis="y", alpha=0.3)
    # Above the plots: inside it would lie over bars, which start at 0.
    figure.legend(
        *figure.axes[0].get_legend_handles_labels(), loc="outside upper center", fontsize=8, ncols=len(strategies)
    )
    return figure


def main() -> None:
    """Parse the command line, play, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--strategies", nargs="+", default=list(STRATEGIES), choices=list(STRATEGIES))
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS, help="scenarios")
    parser.add_argument("--sizes", nargs="+", type=float, default=list(SIZES), help="edges of the object [m]")
    parser.add_argument("--episodes", type=int, default=300, help="scenes a cell")
    parser.add_argument("--seed", type=int, default=3000, help="seed of the scenes; never 0, the evaluation's")
    parser.add_argument("--envs", type=int, default=300, help="worlds side by side")
    parser.add_argument("--max-obstacles", type=int, default=6, help="most obstacles K in an episode")
    parser.add_argument("--output", type=Path, default=Path("runs/research/looking_pays.json"), help="result file")
    options = parser.parse_args()
    strategies = list(dict.fromkeys(["straight", "no occlusion", *options.strategies]))
    cells: dict[str, dict[str, Any]] = {}
    with one_thread(), torch.no_grad():
        for kind, size in itertools.product(options.kinds, options.sizes):
            results = {name: outcome(*play(name, kind, size, options)) for name in strategies}
            cells[f"{kind}, {size} m"] = results
            for name, result in results.items():
                success, collision = (100 * result[rate][0] for rate in ("success", "collision"))
                print(f"{kind} {size} {name}: success {success:.1f} %, collision {collision:.1f} %", flush=True)
    facts = {"seed": options.seed, "max_obstacles": options.max_obstacles}
    save({**facts, "cells": cells, "recovered": compare(cells, strategies)}, draw(cells, strategies), options.output)


if __name__ == "__main__":
    main()
