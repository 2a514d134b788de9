"""Panels put values where they belong, and nowhere else."""

from __future__ import annotations

import math

import numpy as np
import pytest
from PIL import Image, ImageDraw

from cura_torchrl.trainers.pictures.raster import SCALE, Axis, Panel, finish, font, rectangle_corners

PANEL = Panel(20, 10, width=100, height=50, x=Axis(-5.0, 5.0, (0,)), y=Axis(0.0, 10.0, (5,)))


def test_corners_turn_counter_clockwise_with_the_yaw() -> None:
    """Catches a rotation of the wrong sense: a quarter turn sends the corner (1, 0.5) to (-0.5, 1)."""
    corners = rectangle_corners((3.0, 4.0, math.pi / 2), 2.0, 1.0)
    assert corners[0] == pytest.approx([2.5, 5.0])
    square = rectangle_corners((0.0, 0.0, math.pi / 4), 2.0, 2.0)
    assert np.linalg.norm(square, axis=1) == pytest.approx([math.sqrt(2.0)] * 4)


@pytest.mark.parametrize(
    ("value", "pixel"), [((-5.0, 0.0), (20.0, 60.0)), ((0.0, 10.0), (70.0, 10.0)), ((2.5, 5.0), (95.0, 35.0))]
)
def test_values_are_placed_linearly_with_y_upwards(value: tuple[float, float], pixel: tuple[float, float]) -> None:
    """Catches a flipped or shifted axis: 10 pixels a unit across, 5 up."""
    assert PANEL.pixel_in_frame(*value) == pytest.approx(pixel)


def test_what_is_drawn_beyond_the_plot_area_is_cut_off() -> None:
    """Catches a robot that drives into the neighbouring panel."""
    frame = Image.new("RGB", (140 * SCALE, 80 * SCALE), "white")
    content = PANEL.blank()
    ImageDraw.Draw(content).polygon(PANEL.pixels(rectangle_corners((5.0, 5.0, 0.0), 4.0, 40.0)), fill="black")
    PANEL.paste(frame, content)
    pixels = np.asarray(finish(frame))
    assert (pixels[10:60, 101:120] == 0).all()
    outside = np.ones((80, 140), dtype=bool)
    outside[10:60, 20:120] = False
    assert (pixels[outside] == 255).all()


def test_decoration_stays_outside_of_the_plot_area() -> None:
    """Catches labels over the data."""
    frame = Image.new("RGB", (240 * SCALE, 140 * SCALE), "white")
    panel = Panel(60, 30, width=100, height=50, x=Axis(-5.0, 5.0, (0, 5), "x [m]"), y=Axis(0.0, 10.0, (0, 10), "y [m]"))
    panel.decorate(frame, "Title")
    pixels = np.asarray(finish(frame))
    assert (pixels[31:79, 61:159] == 255).all()
    for part in (pixels[:30], pixels[81:], pixels[:, :60]):  # title, numbers and label below, those on the left
        assert (part < 128).any()


def test_fonts_are_found_wherever_matplotlib_is() -> None:
    """Catches a font of one machine."""
    assert font(11).getlength("x [m]") > 10
    assert font(11, bold=True) is font(11, bold=True)
