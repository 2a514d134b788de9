"""Still pictures: readable files with what they promise in them."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
from matplotlib.figure import Figure
from PIL import Image, ImageColor

from cura_torchrl.envs.config import ScenarioConfig
from cura_torchrl.trainers.pictures import figures, raster
from cura_torchrl.trainers.pictures.estimate_figures import distribution_figure
from cura_torchrl.trainers.pictures.scene_axes import draw_paths
from tests.recordings import make_recording


def pixels(content: bytes) -> np.ndarray:
    """Return a PNG's pixels, shape ``[H, W, 3]``."""
    with Image.open(io.BytesIO(content)) as image:
        assert image.format == "PNG"
        return np.asarray(image.convert("RGB"))


def count(picture: np.ndarray, colour: str) -> int:
    """Return how many pixels have nearly a colour; the palette rounds."""
    return int((np.abs(picture.astype(int) - ImageColor.getrgb(colour)) < 12).all(-1).sum())


def test_paths_show_robot_object_and_obstacle_for_each_recording() -> None:
    """Catches an empty plot, or one recording drawn twice in the same place."""
    picture = pixels(figures.paths_figure([make_recording(), make_recording(outcome="collision")]))
    for half in np.array_split(picture, 2, axis=1):
        assert count(half, raster.ROBOT) > 500
        assert count(half, raster.OBJECT) > 500
        assert count(half, raster.OBSTACLE) > 50
    left, right = np.array_split(picture, 2, axis=1)
    assert count(left, raster.FAILURE) == 0
    assert count(right, raster.FAILURE) > 10


def test_a_path_that_leaves_the_scene_is_shown() -> None:
    """Catches paths that are cut off, and neighbours to another scale."""
    near, far = make_recording(), make_recording()
    far = dataclasses.replace(far, object_pose=far.object_pose + np.array([0.0, 6.0, 0.0]))
    left, right = Figure().subplots(1, 2, sharey=True)
    draw_paths(left, far)
    assert left.get_xlim() == (raster.SCENE_X.low, raster.SCENE_X.high)
    draw_paths(right, near)
    low, high = right.get_ylim()
    assert low == raster.SCENE_Y.low
    assert far.object_pose[:, 1].max() < high < 8.0


def test_snapshots_and_distributions_are_pictures() -> None:
    """Catches maps in wrong colours, and distributions that are not of the chosen moments."""
    pair = [make_recording(), make_recording(outcome="time-out")]
    maps = pixels(figures.snapshots_figure(pair[:1]))
    # In the three windows half has been seen and half has not; all is free.
    dark, light, free = (
        int((np.abs(maps.astype(int) - colours[value]) < 12).all(-1).sum())
        for colours, value in (
            (raster.CONFIDENCE_COLOURS, 0),
            (raster.CONFIDENCE_COLOURS, 255),
            (raster.OCCUPANCY_COLOURS, 0),
        )
    )
    assert 0.8 < light / dark < 1.2
    assert 1.6 < free / light < 2.4
    bars = pixels(distribution_figure(pair))
    # Half of the atoms are 0 and half are 1: two bars in each of six plots, and the mean between them.
    assert count(bars, raster.UNCERTAINTY) > 1000
    assert count(bars, raster.RISK) > 500


def test_layout_shows_the_three_regions_to_scale() -> None:
    """Catches a region that is missing, or drawn with length and width swapped."""
    picture = pixels(figures.layout_figure(ScenarioConfig()))
    # Colours at 30 % over white: 255 - 0.3 * (255 - c).
    areas = []
    for colour in (raster.GOAL, raster.ROBOT):
        pale = [round(255 - 0.3 * (255 - c)) for c in ImageColor.getrgb(colour)]
        areas.append(int((np.abs(picture.astype(int) - pale) < 12).all(-1).sum()))
    # 8 m by 6 m for obstacles against 2 m by 4 m for the goal, less what is drawn on top of the former.
    assert 4.5 < areas[0] / areas[1] < 6.0


def test_curves_are_drawn_with_and_without_a_history() -> None:
    """Catches a demo that fails where no curve is shipped, or at a rate that is not known yet."""
    after = [{"frames": 10.0, "success": float("nan"), "reward": 1.0}, {"frames": 20.0, "success": 0.5, "reward": 2.0}]
    before = [{"frames": 1e6 * i, "success": 0.1 * i, "reward": float(i)} for i in range(8)]
    without, with_ = pixels(figures.curve_figure([], after)), pixels(figures.curve_figure(before, after))
    assert count(with_, raster.ROBOT) > count(without, raster.ROBOT) + 200
    assert count(without, raster.UNCERTAINTY) > 50
