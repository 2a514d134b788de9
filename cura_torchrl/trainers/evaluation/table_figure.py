"""The table of success rates as a picture."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from cura_torchrl.trainers.evaluation.table_report import cell_label
from cura_torchrl.trainers.methods import PRESETS
from cura_torchrl.trainers.pictures import raster
from cura_torchrl.trainers.pictures.axes import encode

if TYPE_CHECKING:
    from cura_torchrl.trainers.evaluation.table_numbers import Result
    from cura_torchrl.trainers.pictures.render_config import StillFormat

_COLOURS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6d31", "#7a7a7a", "#5e3c99", "#b8b800",
)  # fmt: skip
"""Told apart by those who do not see red and green (Okabe and Ito), and three more."""
_SPREAD = 0.84
"""Share of the space between two cells that bars fill [1]."""
_FEW = 4
"""Most methods with which all cells fit in one row [1]."""
_CELLS_OF_MANY = 4
"""Cells in a row where there are more methods [1]."""
_MARK: dict[str, Any] = {
    "marker": "D",
    "markersize": 4.5,
    "markerfacecolor": "white",
    "markeredgecolor": raster.INK,
    "zorder": 5,
}
"""Where the paper's number is."""


def table_figure(results: list[Result], title: str, form: StillFormat) -> bytes:
    """Return success per method and cell as bars, with their intervals and the paper's numbers.

    Args:
        results: The numbers.
        title: Which scenes were played, in words.
        form: Format.

    Returns:
        Content of a file of this format; the same for the same numbers.
    """
    methods, cells = (list(dict.fromkeys(names)) for names in zip(*((r.method, r.cell) for r in results), strict=True))
    per_row = len(cells) if len(methods) <= _FEW else _CELLS_OF_MANY
    rows = [cells[start : start + per_row] for start in range(0, len(cells), per_row)]
    width = max(6.0, 1.0 + 1.5 * min(per_row, len(cells)) * max(1.0, len(methods) / 5))
    figure = Figure(figsize=(width, 0.6 + 3.0 * len(rows)))
    axes = np.atleast_1d(figure.subplots(len(rows), 1))
    for axis, shown in zip(axes, rows, strict=True):
        _draw_row(axis, {(r.method, r.cell): r for r in results}, methods, shown)
        # Rows of as many places, so that bars are as wide in the last one.
        axis.set_xlim(-0.5, per_row - 0.5)
    _add_legend(figure, methods, results, title)
    return encode(figure, form, cut=True)


def _draw_row(axis: Any, found: dict[tuple[str, str], Result], methods: list[str], cells: list[str]) -> None:
    width = _SPREAD / len(methods)
    for number, (method, colour) in enumerate(zip(methods, _colours(methods), strict=True)):
        own = [found[method, cell] for cell in cells]
        places = np.arange(len(cells)) + (number - (len(methods) - 1) / 2) * width
        rates = np.array([r.success for r in own])
        # With several seeds the interval is that of the interquartile mean, which the mean may lie outside of.
        errors = np.array([[max(r.success - r.low, 0.0) for r in own], [max(r.high - r.success, 0.0) for r in own]])
        axis.bar(places, 100 * rates, 0.92 * width, color=colour)
        axis.errorbar(places, 100 * rates, 100 * errors, fmt="none", ecolor=raster.INK, elinewidth=1.0, capsize=2.0)
        printed = [(place, 100 * r.paper) for place, r in zip(places, own, strict=True) if not math.isnan(r.paper)]
        if printed:
            axis.plot(*np.array(printed).T, linestyle="none", **_MARK)
    axis.set_xticks(range(len(cells)), [cell_label(cell) for cell in cells])
    axis.set(ylim=(0, 103), ylabel="success within 0.5 m [%]")
    axis.set_yticks(range(0, 101, 20))
    axis.grid(axis="y", color=raster.GRID, linewidth=0.6)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(axis="x", length=0)


def _add_legend(figure: Figure, methods: list[str], results: list[Result], title: str) -> None:
    handles: list[Any] = [
        Line2D([], [], linestyle="none", marker="s", markersize=9, color=colour, label=PRESETS[method].label)
        for method, colour in zip(methods, _colours(methods), strict=True)
    ]
    if any(not math.isnan(r.paper) for r in results):
        handles.append(Line2D([], [], linestyle="none", label="the paper", **_MARK))
    interval = "95 % interval over scenes" if results[0].seeds == 1 else "95 % bootstrap interval of the IQM over seeds"
    handles.append(Line2D([], [], color=raster.INK, linestyle="none", marker="|", markersize=11, label=interval))
    height = float(figure.get_size_inches()[1])
    columns = min(len(handles), 4 if len(methods) > _FEW else 3)
    figure.subplots_adjust(top=1 - 0.1 / height, bottom=0.4 / height, left=0.08, right=0.99, hspace=0.22)
    figure.legend(handles=handles, loc="lower left", bbox_to_anchor=(0.07, 1.0), ncols=columns, frameon=False)
    rows = -(-len(handles) // columns)
    figure.text(0.08, 1 + (0.15 + 0.24 * rows) / height, f"{title[:1].upper()}{title[1:]}", fontsize=10)


def _colours(methods: list[str]) -> list[str]:
    return [_COLOURS[number % len(_COLOURS)] for number, _ in enumerate(methods)]
