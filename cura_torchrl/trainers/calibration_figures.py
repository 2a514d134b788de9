"""Figures of the collision estimator's calibration, as PNG."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from cura_torchrl.trainers.calibration_config import CONDITIONS
from cura_torchrl.trainers.scene_axes import encode

if TYPE_CHECKING:
    from numpy.typing import NDArray

_COLOURS = ("C0", "C1", "C2", "C3", "C4", "C5", "C6", "C7")
_LINEAR = {"mean": 1e-2, "variance": 1e-3}
"""Up to where the axes of the comparison with the truth are linear [1]."""
_FEW = 20
"""States below which a bin of the reliability diagram is not drawn [1]."""


def reliability_figure(methods: dict[str, Any]) -> bytes:
    """Return the share of states that collide within 2 s by what was predicted, a panel a condition.

    Args:
        methods: As in ``calibration.json``.

    Returns:
        Content of a PNG file.
    """
    figure, panels = _panels(methods)
    for axis, condition in panels:
        for (method, found), colour in zip(methods.items(), _COLOURS, strict=False):
            rows = [row for row in found[condition]["reliability"] if row["states"] >= _FEW]
            predicted = np.array([row["predicted"] for row in rows])
            _draw(axis, predicted, np.array([row["came_out"] for row in rows]), label=method, colour=colour)
        axis.set_xlabel("predicted P(collision within 2 s) [1]")
    _look_closer(panels[0][0], high=True)
    panels[0][0].set_ylabel("share that collided [1]")
    panels[0][0].legend(fontsize=8, loc="upper left")
    return encode(figure, "png")


def coverage_figure(methods: dict[str, Any]) -> bytes:
    """Return how often central intervals hold what came out, by how often they promise to, a panel a condition.

    Args:
        methods: As in ``calibration.json``.

    Returns:
        Content of a PNG file.
    """
    figure, panels = _panels(methods)
    for axis, condition in panels:
        for (method, found), colour in zip(methods.items(), _COLOURS, strict=False):
            rows = found[condition]["coverage"]
            rows = [row for row in rows if np.isfinite(row["promised"])]
            promised = np.array([row["promised"] for row in rows])
            _draw(axis, promised, np.array([row["came_out"] for row in rows]), label=method, colour=colour)
        axis.set_xlabel("promised coverage [1]")
    _look_closer(panels[0][0], high=False)
    panels[0][0].set_ylabel("share inside the interval [1]")
    panels[0][0].legend(fontsize=8, loc="upper left")
    return encode(figure, "png")


def truth_figure(truths: dict[str, dict[str, NDArray[Any]]]) -> bytes:
    """Return predicted mean and variance beside those of simulated futures, a column a method.

    Args:
        truths: From :func:`~.futures.against_truth`, by method.

    Returns:
        Content of a PNG file.
    """
    figure = Figure(figsize=(0.8 + 3.4 * len(truths), 6.8), layout="constrained")
    axes = figure.subplots(2, len(truths), squeeze=False, sharex="row", sharey="row")
    for row, (name, unit) in zip(axes, (("mean", "mean of C [1]"), ("variance", "variance of C [1]")), strict=True):
        top = max(float(np.max(truth[f"{kind}_{name}"])) for truth in truths.values() for kind in ("true", "predicted"))
        for axis, (method, truth) in zip(row, truths.items(), strict=True):
            axis.plot([0.0, top], [0.0, top], color="0.6", linewidth=1, zorder=0)
            for chosen, marker, label in ((~truth["by_risk"], "o", "at random"), (truth["by_risk"], "^", "by risk")):
                true, predicted = truth[f"true_{name}"][chosen], truth[f"predicted_{name}"][chosen]
                error = 1.96 * truth["mean_error"][chosen] if name == "mean" else None
                axis.errorbar(
                    true, predicted, xerr=error, fmt=marker, markersize=4, alpha=0.7, linewidth=0.7, label=label
                )
            # Linear near 0, where most states are, and logarithmic beyond.
            axis.set_xscale("symlog", linthresh=_LINEAR[name])
            axis.set_yscale("symlog", linthresh=_LINEAR[name])
            axis.set_title(method, loc="left", fontsize=10)
            axis.set_xlabel(f"true {unit}", fontsize=9)
            axis.grid(alpha=0.3)
        row[0].set_ylabel(f"predicted {unit}", fontsize=9)
    axes[0, 0].legend(fontsize=8, title="states drawn", title_fontsize=8)
    return encode(figure, "png")


def _panels(methods: dict[str, Any]) -> tuple[Figure, list[tuple[Any, str]]]:
    """Return a figure and its panels with their conditions."""
    conditions = [name for name in CONDITIONS if name in next(iter(methods.values()))]
    figure = Figure(figsize=(0.6 + 2.9 * len(conditions), 3.3), layout="constrained")
    axes = figure.subplots(1, len(conditions), squeeze=False, sharex=True, sharey=True)[0]
    for axis, condition in zip(axes, conditions, strict=True):
        axis.plot([0.0, 1.0], [0.0, 1.0], color="0.6", linewidth=1, zorder=0)
        axis.set_title(condition, loc="left", fontsize=10)
        axis.grid(alpha=0.3)
    return figure, list(zip(axes, conditions, strict=True))


def _look_closer(axis: Any, *, high: bool) -> None:
    """Let all panels show where points are, near 0 or near 1; intervals may reach beyond."""
    points = [np.concatenate(bars.lines[0].get_data()) for panel in axis.figure.axes for bars in panel.containers]
    if not points:
        return
    far = float((np.concatenate(points) if high else 1.0 - np.concatenate(points)).max())
    reach, margin = min(1.0, 1.5 * far + 0.02), 0.02
    limits = (-margin * reach, reach) if high else (1.0 - reach, 1.0 + margin * reach)
    axis.set(xlim=limits, ylim=limits)


def _draw(axis: Any, x: NDArray[np.float64], rows: NDArray[np.float64], *, label: str, colour: str) -> None:
    """Draw a line with its intervals; rows hold value, lower and upper bound."""
    if not len(x):
        return
    middle, low, high = rows.T
    error = np.nan_to_num(np.stack([middle - low, high - middle])).clip(0.0)
    axis.errorbar(x, middle, yerr=error, fmt="o-", markersize=3.5, linewidth=1.2, capsize=2, label=label, color=colour)
