"""Does the objective pay for crashing? Costs over the last steps before collisions, beside matched safe windows.

A negative sum is a reward. Costs are those that enter the advantage, normalised as in training:
python benchmarks/research/crash_reward.py --output runs/research/crash_reward.json
"""

from __future__ import annotations

from contextlib import closing
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from matplotlib.figure import Figure
from recording import PERIOD, estimator_watch, normalised_costs, parser, record, save, task
from scipy.spatial import cKDTree

from cura_torchrl.trainers.evaluation.statistics import bootstrap_interval
from cura_torchrl.trainers.loaded_policy import load_policy
from cura_torchrl.trainers.threads import one_thread

if TYPE_CHECKING:
    from numpy.typing import NDArray

WINDOW = 10
"""Steps before the collision's own [1]."""
HISTORY = 25
"""Steps before the collision that the figure shows [1]."""
SAFE = 20
"""Steps after a safe window in which nothing may collide [1]."""
FORESEEN = 0.3
"""Risk that it has to reach before a collision for that to count as foreseen [1]."""
PARTS = ("risk", "uncertainty", "sum")
TITLES = {"risk": "risk cost", "uncertainty": "uncertainty cost", "sum": "weighted sum"}


def collisions(notes: dict[str, NDArray[Any]], window: int) -> NDArray[np.int64]:
    """Return (row, step) of the collisions with so many steps of their episode recorded before them, ``[M, 2]``."""
    found = np.argwhere(notes["terminated"])
    found = found[found[:, 1] >= window]
    same = notes["episode"][found[:, 0], found[:, 1] - window] == notes["episode"][found[:, 0], found[:, 1]]
    return found[same]


def safe_starts(notes: dict[str, NDArray[Any]]) -> NDArray[np.int64]:
    """Return (row, step) where windows start that no collision follows, every fifth step, ``[M, 2]``."""
    episode, length = notes["episode"], WINDOW + SAFE
    starts = np.argwhere(np.ones_like(episode[:, :-length], dtype=bool))
    starts = starts[starts[:, 1] % 5 == 0]
    same = episode[starts[:, 0], starts[:, 1] + length] == episode[starts[:, 0], starts[:, 1]]
    return starts[same]


def match(notes: dict[str, NDArray[Any]], starts: NDArray[np.int64], safe: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return for every start the safe window of the same object whose start is most alike in risk, distance, time."""

    def features(at: NDArray[np.int64]) -> NDArray[np.float64]:
        row, step = at.T
        risk = np.log10(notes["risk"][row, step].clip(1e-3))
        distance = notes["clearance"][row, step].clip(None, 4.0)
        return np.stack([risk / 0.3, distance / 0.5, notes["elapsed"][row, step] * PERIOD / 5.0], axis=-1)

    matched = np.zeros_like(starts)
    edge, safe_edge = (notes["edge"][at[:, 0], at[:, 1]] for at in (starts, safe))
    for size in np.unique(edge):
        pool = safe[safe_edge == size]
        matched[edge == size] = pool[cKDTree(features(pool)).query(features(starts[edge == size]))[1]]
    return matched


def window_sums(values: NDArray[np.float32], starts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the sums over the windows that begin at some (row, step)."""
    steps = starts[:, 1:] + np.arange(WINDOW)
    return values[starts[:, :1], steps].sum(1).astype(np.float64)


def measure(notes: dict[str, NDArray[Any]], costs: dict[str, NDArray[np.float32]]) -> dict[str, Any]:
    """Return the mean sums with intervals over collisions."""
    ends = collisions(notes, WINDOW)
    starts = ends - np.array([0, WINDOW])
    matched = match(notes, starts, safe_starts(notes))
    result: dict[str, Any] = {"collisions": len(ends), "episodes": len(np.unique(notes["episode"]))}
    for name, values in costs.items():
        before, safe = window_sums(values, starts), window_sums(values, matched)
        last = values[ends[:, 0], ends[:, 1]].astype(np.float64)
        rows = {"before": before, "last_step": last, "with_last": before + last, "safe": safe, "excess": before - safe}
        result[name] = {
            key: [float(row.mean()), *bootstrap_interval(lambda pick, row=row: row[pick].mean(), len(row))]
            for key, row in rows.items()
        }
        result[name]["share_negative"] = float((before + last < 0).mean())
    foreseen = notes["risk"][starts[:, :1], starts[:, 1:] + np.arange(WINDOW)].max(-1) >= FORESEEN
    result["foreseen"] = {"collisions": int(foreseen.sum())}
    for name in PARTS if foreseen.any() else ():
        row = window_sums(costs[name], starts[foreseen])
        bounds = bootstrap_interval(lambda pick, row=row: row[pick].mean(), len(row))
        result["foreseen"][name] = [float(row.mean()), *bounds]
    for name in ("risk", "uncertainty", "clearance"):
        values = notes[name]
        result[f"{name}_at_start"] = [float(np.median(values[at[:, 0], at[:, 1]])) for at in (starts, matched, ends)]
    return result


def draw(notes: dict[str, NDArray[Any]], costs: dict[str, NDArray[np.float32]]) -> tuple[Figure, dict[str, Any]]:
    """Return the figure of mean costs over the time to the collision, and its numbers."""
    ends = collisions(notes, HISTORY)
    time = -PERIOD * np.arange(HISTORY, -1, -1)
    matched = match(notes, ends - np.array([0, WINDOW]), safe_starts(notes))
    figure = Figure(figsize=(11, 3.3), layout="constrained")
    curves: dict[str, Any] = {"time_s": time.round(2).tolist()}
    for axis, name in zip(figure.subplots(1, 3), PARTS, strict=True):
        rows = costs[name][ends[:, :1], ends[:, 1:] + np.arange(-HISTORY, 1)].astype(np.float64)
        low, high = bootstrap_interval(lambda pick, rows=rows: rows[pick].mean(0), len(rows), draws=300)
        curves[name] = rows.mean(0).round(4).tolist()
        axis.axhline(0.0, color="0.6", linewidth=0.8)
        axis.plot(time, rows.mean(0), color="C3", label=f"before a collision ({len(rows)})")
        axis.fill_between(time, low, high, color="C3", alpha=0.25, linewidth=0)
        level = window_sums(costs[name], matched).mean() / WINDOW
        axis.axhline(level, color="C0", linestyle="--", label="matched safe windows, mean")
        axis.set_title(f"{TITLES[name]}, normalised", loc="left", fontsize=9)
        axis.set_xlabel("time to the collision [s]")
        axis.set_ylabel("mean cost a step [1]")
        axis.grid(alpha=0.3)
    figure.axes[0].legend(fontsize=8)
    return figure, curves


def main() -> None:
    """Parse the command line, play, measure, write."""
    command = parser(__doc__, "runs/research/crash_reward.json")
    command.add_argument("--rollouts", type=int, default=7, help="rollouts of the trained length to record")
    options = command.parse_args()
    loaded = load_policy(options.checkpoint)
    torch.manual_seed(options.seed)
    played = task(loaded, max_obstacles=options.max_obstacles)
    with (
        one_thread(),
        closing(
            loaded.make_env(options.envs, task=played, simulator="planar", keep_map=True, seed=options.seed)
        ) as env,
    ):
        steps = options.rollouts * loaded.config.ppo.rollout_steps
        notes = record(env, loaded.policy, steps, estimator_watch(loaded, env))
    costs = normalised_costs(loaded, notes)
    figure, curves = draw(notes, costs)
    cura = loaded.config.cura
    facts = {
        "checkpoint": loaded.config.method, "trained_frames": loaded.record["frames"], "seed": options.seed,
        "max_obstacles": options.max_obstacles, "frames": notes["risk"].size, "window_steps": WINDOW,
        "weights": {"risk": cura.risk_coeff, "uncertainty": cura.uncertainty_coeff},
    }  # fmt: skip
    save({**facts, **measure(notes, costs), "curves": curves}, figure, options.output)


if __name__ == "__main__":
    main()
