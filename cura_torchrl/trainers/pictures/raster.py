"""Drawing frames fast: panels with axes on Pillow images, drawn twice as large and averaged down for smooth edges."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from PIL import Image, ImageDraw, ImageFont

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

SCALE = 2
"""Drawn pixels along each pixel that is shown [1]."""

ROBOT = "#1a9850"
"""Green of the robot and its path; the paper's choice."""
OBJECT = "#c51b8a"
"""Magenta of the object and its path; the paper's choice, dark enough to differ from the green in lightness too."""
OBSTACLE = "#4d4d4d"
GOAL = "#b07c00"
RAY = "#d9ecf7"
HIT = "#0072b2"
RISK = "#d55e00"
UNCERTAINTY = "#0072b2"
INK = "#1f2328"
FAINT = "#8c959f"
GRID = "#d8dee4"
PAPER = "#ffffff"
ARM = "#0b5c30"
FAILURE = "#b42318"

CONFIDENCE_COLOURS = np.linspace((13, 42, 74), (255, 246, 196), 256).round().astype(np.uint8)
"""Colour of each confidence, 0 to 255, shape ``[256, 3]``: dark is unseen, light is seen now."""
OCCUPANCY_COLOURS = np.linspace((238, 242, 246), (31, 35, 40), 256).round().astype(np.uint8)
"""Colour of each occupancy, 0 to 255, shape ``[256, 3]``: dark is occupied."""


@dataclass(frozen=True)
class Axis:
    """One axis of a panel."""

    low: float
    """Value at the left or lower end."""
    high: float
    """Value at the right or upper end."""
    ticks: tuple[float, ...]
    """Values that are marked."""
    label: str = ""
    """Quantity and unit; empty leaves label and numbers out."""


SCENE_X = Axis(-2.5, 16.0, (0, 2, 4, 6, 8, 10, 12, 14), "x [m]")
SCENE_Y = Axis(-4.625, 4.625, (-4, -2, 0, 2, 4), "y [m]")
"""What a picture of a scene shows, seen from above."""


class Panel:
    """A plot area that maps values to pixels and clips what is drawn in it.

    Args:
        left: Left edge of the plot area in the frame [pixel].
        top: Its upper edge [pixel].
        width: Its width [pixel].
        height: Its height [pixel].
        x: Horizontal axis.
        y: Vertical axis, upwards.

    Examples:
        >>> panel = Panel(10, 20, width=100, height=50, x=Axis(0.0, 10.0, ()), y=Axis(0.0, 5.0, ()))
        >>> panel.pixel_in_frame(5.0, 5.0)
        (60.0, 20.0)
    """

    def __init__(self, left: int, top: int, *, width: int, height: int, x: Axis, y: Axis) -> None:
        self.left, self.top, self.width, self.height = left, top, width, height
        self.x, self.y = x, y
        self._scale = np.array([width / (x.high - x.low), -height / (y.high - y.low)]) * SCALE
        self._origin = np.array([x.low, y.high])

    def pixels(self, points: NDArray[np.floating]) -> list[tuple[float, float]]:
        """Return where points lie in the panel's own image.

        Args:
            points: Points in the axes' units, shape ``[M, 2]``.

        Returns:
            M pairs [drawn pixel].
        """
        return [(x, y) for x, y in ((np.asarray(points) - self._origin) * self._scale).tolist()]

    def pixel_in_frame(self, x: float, y: float) -> tuple[float, float]:
        """Return where a point lies in the frame that is shown.

        Args:
            x: Value on the horizontal axis.
            y: Value on the vertical axis.

        Returns:
            Column and row [pixel].
        """
        ((column, row),) = self.pixels(np.array([[x, y]]))
        return self.left + column / SCALE, self.top + row / SCALE

    def length(self, value: float) -> float:
        """Return a length along the horizontal axis.

        Args:
            value: Length in the axis' unit.

        Returns:
            Length [drawn pixel].
        """
        return value * float(self._scale[0])

    def blank(self) -> Image.Image:
        """Return an image of the plot area with grid lines at the ticks.

        Returns:
            The image, drawn size.
        """
        image = Image.new("RGB", (self.width * SCALE, self.height * SCALE), PAPER)
        draw = ImageDraw.Draw(image)
        for tick in self.x.ticks:
            (column, _), _ = self.pixels(np.array([[tick, self.y.low], [tick, self.y.high]]))
            draw.line([(column, 0), (column, image.height)], fill=GRID, width=1)
        for tick in self.y.ticks:
            (_, row), _ = self.pixels(np.array([[self.x.low, tick], [self.x.high, tick]]))
            draw.line([(0, row), (image.width, row)], fill=GRID, width=1)
        return image

    def paste(self, frame: Image.Image, content: Image.Image) -> None:
        """Put the plot area into a frame.

        Args:
            frame: Frame of the drawn size; changed in place.
            content: Image of the plot area.
        """
        frame.paste(content, (self.left * SCALE, self.top * SCALE))

    def decorate(self, frame: Image.Image, title: str) -> None:
        """Draw border, ticks, numbers, labels and title around the plot area.

        Args:
            frame: Frame of the drawn size; changed in place.
            title: What the panel shows.
        """
        draw = ImageDraw.Draw(frame)
        left, top = self.left * SCALE, self.top * SCALE
        right, bottom = left + self.width * SCALE, top + self.height * SCALE
        draw.rectangle([left - 1, top - 1, right, bottom], outline=FAINT, width=1)
        draw.text((left, top - 4 * SCALE), title, fill=INK, font=font(11, bold=True), anchor="ls")
        small = font(10)
        if self.x.label:
            for tick in self.x.ticks:
                column = left + (tick - self.x.low) * float(self._scale[0])
                draw.text((column, bottom + 3 * SCALE), f"{tick:g}", fill=INK, font=small, anchor="mt")
            draw.text(((left + right) / 2, bottom + 16 * SCALE), self.x.label, fill=INK, font=small, anchor="mt")
        if self.y.label:
            widest = max((small.getlength(f"{tick:g}") for tick in self.y.ticks), default=0.0)
            for tick in self.y.ticks:
                row = top + (tick - self.y.high) * float(self._scale[1])
                draw.text((left - 4 * SCALE, row), f"{tick:g}", fill=INK, font=small, anchor="rm")
            _draw_upright(frame, self.y.label, (round(left - widest - 14 * SCALE), (top + bottom) // 2))


def _draw_upright(frame: Image.Image, text: str, centre: tuple[int, int]) -> None:
    used = font(10)
    x0, y0, x1, y1 = used.getbbox(text, anchor="ls")
    label = Image.new("RGB", (math.ceil(x1 - x0) + 4, math.ceil(y1 - y0) + 4), PAPER)
    ImageDraw.Draw(label).text((2 - x0, 2 - y0), text, fill=INK, font=used, anchor="ls")
    turned = label.rotate(90, expand=True)
    frame.paste(turned, (centre[0] - turned.width // 2, centre[1] - turned.height // 2))


@functools.cache
def font(size: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    """Return matplotlib's own sans-serif font, which is there wherever matplotlib is.

    Args:
        size: Height as shown [pixel].
        bold: Whether it is bold.

    Returns:
        The font, drawn size.
    """
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(mpl.get_data_path()) / "fonts" / "ttf" / name, size * SCALE)


def rectangle_corners(pose: Sequence[float] | NDArray[np.floating], length: float, width: float) -> NDArray[np.float64]:
    """Return the corners of a rectangle, in order around it.

    Args:
        pose: Centre (x [m], y [m]) and yaw [rad].
        length: Edge along its own x axis [m].
        width: Edge along its own y axis [m].

    Returns:
        Corners [m], shape ``[4, 2]``.

    Examples:
        >>> rectangle_corners((1.0, 0.0, 0.0), 2.0, 1.0).tolist()
        [[2.0, 0.5], [0.0, 0.5], [0.0, -0.5], [2.0, -0.5]]
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    local = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (length / 2, width / 2)
    return local @ np.array([[cos, sin], [-sin, cos]]) + np.asarray(pose[:2], dtype=np.float64)


def three_digits(value: float) -> str:
    """Return a number as it is written into pictures; the estimator's atoms are not bounded by zero.

    Args:
        value: The number.

    Returns:
        Three digits after the point, and no sign where they are zero.

    Examples:
        >>> three_digits(-0.0004), three_digits(0.1256)
        ('0.000', '0.126')
    """
    return f"{round(float(value), 3) + 0.0:.3f}"


def finish(frame: Image.Image) -> Image.Image:
    """Return a frame in the size that is shown.

    Args:
        frame: Frame of the drawn size.

    Returns:
        The frame, each pixel the mean of those that were drawn.
    """
    return frame.reduce(SCALE)
