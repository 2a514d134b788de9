"""Figures of matplotlib: their frames, margins and files."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
from PIL import Image

from cura_torchrl.trainers.pictures import raster

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from cura_torchrl.trainers.pictures.render_config import StillFormat

_DOTS = 140
"""Resolution of the pictures [pixel/inch]."""


def tidy(axis: Any) -> None:
    """Draw a faint grid and no frame.

    Args:
        axis: Where to draw.
    """
    axis.grid(color=raster.GRID, linewidth=0.6)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=9)


def set_margins(
    figure: Figure, *, left: float = 0.6, right: float = 0.15, top: float = 0.35, bottom: float = 0.55
) -> None:
    """Set the margins; matplotlib's automatic layout takes longer than all the rest of a figure.

    Args:
        figure: The figure.
        left: Margin on the left [inch].
        right: Margin on the right [inch].
        top: Margin above [inch].
        bottom: Margin below [inch].
    """
    width, height = figure.get_size_inches()
    figure.subplots_adjust(left / width, bottom / height, 1 - right / width, 1 - top / height)


def encode(figure: Figure, kind: StillFormat, *, cut: bool = False) -> bytes:
    """Return a figure as a file.

    Args:
        figure: The figure.
        kind: Format of the file.
        cut: Whether the picture ends where what is drawn does, inside of the figure or beyond it.

    Returns:
        Content of the file; the same figure gives the same.
    """
    drawn = io.BytesIO()
    extent = "tight" if cut else None
    if kind == "svg":
        # Nothing is there by chance: neither a date nor names of parts.
        with mpl.rc_context({"svg.hashsalt": "figure"}):
            figure.savefig(drawn, format="svg", facecolor="white", bbox_inches=extent, metadata={"Date": None})
        return drawn.getvalue()
    figure.savefig(drawn, format="png", dpi=_DOTS, facecolor="white", bbox_inches=extent)
    # A palette of 256 colours makes a third of the size.
    image = Image.open(drawn).convert("RGB").quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    packed = io.BytesIO()
    image.save(packed, "PNG", optimize=True)
    return packed.getvalue()
