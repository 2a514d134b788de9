"""Learning curves: every column of the runs' progress.csv in a plot, with its unit, one line a run."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from cura_torchrl.trainers.pictures import raster
from cura_torchrl.trainers.pictures.axes import encode, tidy

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    Rows = Sequence[Mapping[str, float]]

_COLUMNS = 3
_STYLES = (
    (raster.UNCERTAINTY, "-"),
    (raster.RISK, "--"),
    (raster.ROBOT, "-."),
    (raster.OBJECT, ":"),
    (raster.INK, "-"),
)
_FEW = 20
"""Points up to which a plot shows all of them [1]."""
_RATES = {"success", "collision", "timeout", "risk_auroc", "clip_fraction", "ESS"}
_AS_THEY_ARE = {"max_obstacles", "lr"}
"""Columns that are set, not measured: they are not smoothed."""


@dataclass(frozen=True)
class Group:
    """Plots that belong together."""

    title: str
    """What they show."""
    columns: tuple[str, ...]
    """Columns of progress.csv that come first; a name that ends in an asterisk is every column that begins so."""


GROUPS = (
    Group(
        "How episodes end",
        ("success", "collision", "timeout", "success_*", "max_obstacles", "episode_steps", "object_speed"),
    ),
    Group("Reward", ("reward", "reward/*")),
    Group(
        "Collision estimator and its costs",
        (
            "risk_auroc",
            "energy_distance",
            "loss_collision",
            "risk_mean",
            "uncertainty_mean",
            "risk_uncertainty_correlation",
            "risk_cost_std",
            "uncertainty_cost_std",
            "risk_weight",
            "uncertainty_weight",
        ),
    ),
    Group(
        "Optimisation",
        (
            "loss_objective",
            "loss_critic",
            "explained_variance",
            "entropy",
            "std",
            "kl",
            "clip_fraction",
            "ESS",
            "lr",
            "loss_entropy",
            "actor_grad_norm",
            "critic_grad_norm",
            "collision_grad_norm",
        ),
    ),
    Group("Speed", ("frames_per_second", "collect_seconds", "update_seconds", "episodes")),
)
"""The plots; a column that no group names is drawn in a last group, so that none is left out."""

_LABELS = {
    "success": "success rate [1]",
    "collision": "collision rate [1]",
    "timeout": "time-out rate [1]",
    "max_obstacles": "most obstacles K in an episode [1]",
    "episode_steps": "length of an episode [steps]",
    "object_speed": "speed of the object [m/s]",
    "reward": "reward per step [1]",
    "risk_auroc": "AUROC of the risk, collision within 2 s [1]",
    "energy_distance": "energy distance to the targets [1]",
    "risk_mean": "mean risk R [1]",
    "uncertainty_mean": "mean uncertainty U [1]",
    "risk_uncertainty_correlation": "correlation of R and U [1]",
    "risk_cost_std": "std. deviation of the risk cost [1]",
    "uncertainty_cost_std": "std. deviation of the uncertainty cost [1]",
    "risk_weight": "weight of the risk cost [1]",
    "uncertainty_weight": "weight of the uncertainty cost [1]",
    "loss_objective": "loss of the actor [1]",
    "loss_critic": "loss of the critic [1]",
    "loss_collision": "loss of the estimator [1]",
    "explained_variance": "variance that the critic explains [1]",
    "entropy": "entropy of the policy [nat]",
    "std": "std. deviation of the actions [1]",
    "ESS": "effective sample size, share of the frames [1]",
    "loss_entropy": "loss of the entropy bonus [1]",
    "episodes": "episodes that rates are taken over [1]",
    "kl": "KL divergence of an update [nat]",
    "clip_fraction": "share of clipped ratios [1]",
    "lr": "learning rate of the actor [1]",
    "actor_grad_norm": "norm of the actor's gradient [1]",
    "critic_grad_norm": "norm of the critic's gradient [1]",
    "collision_grad_norm": "norm of the estimator's gradient [1]",
    "frames_per_second": "environment steps per second [1/s]",
    "collect_seconds": "time to collect a rollout [s]",
    "update_seconds": "time of an update [s]",
}


def label_of(column: str) -> str:
    """Return what a column is called in a plot.

    Args:
        column: Name in progress.csv.

    Returns:
        Quantity and unit.

    Examples:
        >>> label_of("success_0.75m"), label_of("reward/contact"), label_of("my_number")
        ('success rate, box of 0.75 m [1]', 'reward per step: contact [1]', 'my_number')
    """
    if column.startswith("success_") and column.endswith("m"):
        return f"success rate, box of {float(column[len('success_') : -1]):g} m [1]"
    if column.startswith("reward/"):
        return f"reward per step: {column.partition('/')[2].replace('_', ' ')} [1]"
    return _LABELS.get(column, column)


def columns_by_group(runs: Mapping[str, Rows]) -> dict[str, list[str]]:
    """Return which columns there are to draw.

    Args:
        runs: Rows of progress by run.

    Returns:
        Columns with at least one finite number, by title of their group; groups without any are left out.

    Examples:
        >>> columns_by_group({"a": [{"frames": 8.0, "kl": 0.1, "success": 0.5, "mine": 1.0}]})
        {'How episodes end': ['success'], 'Optimisation': ['kl'], 'Other columns': ['mine']}
    """
    entries = (item for rows in runs.values() for row in rows for item in row.items())
    there = dict.fromkeys(name for name, value in entries if name != "frames" and math.isfinite(value))
    found = {}
    for group in GROUPS:
        columns = []
        for wanted in group.columns:
            columns += [name for name in there if _fits(name, wanted) and name not in columns]
        found[group.title] = columns
    drawn = {name for columns in found.values() for name in columns}
    found["Other columns"] = [name for name in there if name not in drawn]
    return {title: columns for title, columns in found.items() if columns}


def _fits(name: str, wanted: str) -> bool:
    return name.startswith(wanted[:-1]) if wanted.endswith("*") else name == wanted


def smooth(rows: Rows, column: str, window: int = 1) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return environment steps and means over the updates around each.

    Args:
        rows: Rows of a run's progress.
        column: Name in progress.csv.
        window: Updates that a point is the mean of, odd [1]; near both ends as many as there are on either side.

    Returns:
        Environment steps [million] and means of the column, of those rows that have a finite number in it.

    Examples:
        >>> rows = [{"frames": 1e6 * (i + 1), "kl": float(i * i)} for i in range(4)]
        >>> [values.round(2).tolist() for values in smooth(rows, "kl", 3)]
        [[1.0, 2.0, 3.0, 4.0], [0.0, 1.67, 4.67, 9.0]]
    """
    points = [(row["frames"] / 1e6, row[column]) for row in rows if math.isfinite(row.get(column, math.nan))]
    if not points:
        return np.empty(0), np.empty(0)
    frames, values = np.array(points, dtype=np.float64).T
    sums = np.concatenate([[0.0], np.cumsum(values)])
    here = np.arange(len(values))
    half = np.minimum(window // 2, np.minimum(here, here[::-1]))
    return frames, (sums[here + half + 1] - sums[here - half]) / (2 * half + 1)


def window_of(rows: Rows) -> int:
    """Return how many updates a smooth line's point is the mean of.

    Args:
        rows: Rows of a run's progress.

    Returns:
        About a thirtieth of the updates, odd [1].

    Examples:
        >>> window_of([{}] * 204), window_of([{}] * 3)
        (7, 1)
    """
    return 1 + 2 * round(len(rows) / 60)


def curves_figure(runs: Mapping[str, Rows], columns: Sequence[str]) -> bytes:
    """Return columns of runs, a plot each.

    Args:
        runs: Rows of progress by the run's name.
        columns: Names in progress.csv, at least one.

    Returns:
        Content of a PNG file.
    """
    rows = -(-len(columns) // _COLUMNS)
    figure = Figure(figsize=(10.5, 0.75 + 2.05 * rows))
    axes = np.atleast_2d(figure.subplots(rows, _COLUMNS))
    for axis, column in zip(axes.flat, columns, strict=False):
        _draw(axis, runs, column)
    for axis in axes.flat[len(columns) :]:
        axis.set_axis_off()
    for axis in axes.flat[max(0, len(columns) - _COLUMNS) : len(columns)]:
        axis.set_xlabel("environment steps [million]", fontsize=9)
    height = figure.get_size_inches()[1]
    figure.subplots_adjust(0.06, 0.5 / height, 0.985, 1 - 0.6 / height, wspace=0.24, hspace=0.42)
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper left", ncols=len(labels), fontsize=9, frameon=False, borderaxespad=0.3)
    return encode(figure, "png")


def _draw(axis: Any, runs: Mapping[str, Rows], column: str) -> None:
    """Draw each run's means, and, faintly, what they are means of."""
    seen = []
    for (name, rows), (colour, style) in zip(runs.items(), cycle(_STYLES), strict=False):
        frames, values = smooth(rows, column)
        seen.append(values)
        if column in _AS_THEY_ARE:
            axis.step(frames, values, where="post", color=colour, linestyle=style, linewidth=1.1, label=name)
            continue
        axis.plot(frames, values, color=colour, linewidth=0.7, alpha=0.22)
        axis.plot(*smooth(rows, column, window_of(rows)), color=colour, linestyle=style, linewidth=1.6, label=name)
    tidy(axis)
    axis.set_title(label_of(column), fontsize=9, loc="left")
    _set_range(axis, column, np.concatenate(seen))


def _set_range(axis: Any, column: str, values: NDArray[np.float64]) -> None:
    axis.tick_params(labelsize=8)
    if column in _RATES or column.startswith("success_"):
        axis.set_ylim(-0.02, 1.02)
    elif column == "max_obstacles":
        axis.set_ylim(-0.2, 6.4)
    elif column == "lr":
        axis.set_yscale("log")
    elif len(values) > _FEW:
        # A few wild updates at the start would leave nothing to see of the rest.
        low, high = np.quantile(values, (0.005, 0.995))
        margin = 0.08 * (high - low) or max(1e-6, 0.05 * abs(high))
        axis.set_ylim(low - margin, high + margin)
