"""Figures of the collision estimator's calibration, as PNG."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from cura_torchrl.trainers.calibration.config import CONDITIONS
from cura_torchrl.trainers.pictures.axes import encode

if TYPE_CHECKING:
    from collections.abc import Callable

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

    def curve(found: dict[str, Any]) -> list[tuple[float, list[float]]]:
        return [(row["predicted"], row["came_out"]) for row in found["reliability"] if row["states"] >= _FEW]

    labels = "predicted P(collision within 2 s) [1]", "share that collided [1]"
    return _curves_figure(methods, curve, labels, near_zero=True)


def coverage_figure(methods: dict[str, Any]) -> bytes:
    """Return how often central intervals hold what came out, by how often they promise to, a panel a condition.

    Args:
        methods: As in ``calibration.json``.

    Returns:
        Content of a PNG file.
    """

    def curve(found: dict[str, Any]) -> list[tuple[float, list[float]]]:
        return [(row["promised"], row["came_out"]) for row in found["coverage"] if np.isfinite(row["promised"])]

    labels = "promised coverage [1]", "share inside the interval [1]"
    return _curves_figure(methods, curve, labels, near_zero=False)


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


def _curves_figure(
    methods: dict[str, Any],
    curve: Callable[[dict[str, Any]], list[tuple[float, list[float]]]],
    labels: tuple[str, str],
    *,
    near_zero: bool,
) -> bytes:
    """Return what came out by what was said, a panel a condition; a curve has value, lower and upper bound by place."""
    conditions = [name for name in CONDITIONS if name in next(iter(methods.values()))]
    figure = Figure(figsize=(0.6 + 2.9 * len(conditions), 3.3), layout="constrained")
    axes = figure.subplots(1, len(conditions), squeeze=False, sharex=True, sharey=True)[0]
    seen = []
    for axis, condition in zip(axes, conditions, strict=True):
        axis.plot([0.0, 1.0], [0.0, 1.0], color="0.6", linewidth=1, zorder=0)
        axis.set_title(condition, loc="left", fontsize=10)
        axis.grid(alpha=0.3)
        for (method, found), colour in zip(methods.items(), itertools.cycle(_COLOURS), strict=False):
            points = curve(found[condition])
            _draw(axis, points, label=method, colour=colour)
            seen += [number for place, bars in points for number in (place, bars[0])]
        axis.set_xlabel(labels[0])
    _look_closer(axes[0], seen, near_zero=near_zero)
    axes[0].set_ylabel(labels[1])
    # A method may have points in some panels only, or in none.
    drawn = {label: line for axis in axes for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    if drawn:
        figure.legend(
            drawn.values(), drawn.keys(), fontsize=8, loc="outside upper center", ncols=len(drawn), frameon=False
        )
    return encode(figure, "png")


def _look_closer(axis: Any, points: list[float], *, near_zero: bool) -> None:
    """Let all panels show where points are, near 0 or near 1; intervals may reach beyond."""
    far = max((point if near_zero else 1.0 - point for point in points), default=1.0)
    reach = min(1.0, 1.5 * far + 0.02)
    limits = (-0.02 * reach, reach) if near_zero else (1.0 - reach, 1.0 + 0.02 * reach)
    axis.set(xlim=limits, ylim=limits)


def _draw(axis: Any, points: list[tuple[float, list[float]]], *, label: str, colour: str) -> None:
    """Draw a line with its intervals."""
    if not points:
        return
    middle, low, high = np.array([bars for _, bars in points]).T
    error = np.nan_to_num(np.stack([middle - low, high - middle])).clip(0.0)
    places = [place for place, _ in points]
    axis.errorbar(
        places, middle, yerr=error, fmt="o-", markersize=3.5, linewidth=1.2, capsize=2, label=label, color=colour
    )
