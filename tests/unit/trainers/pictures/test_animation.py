"""Animations show the recording: every body at its place, at its time."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image, ImageColor

from cura_torchrl.trainers.pictures import animation, raster
from cura_torchrl.trainers.pictures.animation import (
    COLUMN_WIDTH,
    FRAME_HEIGHT,
    animation_frames,
    map_image,
    scene_panel,
)
from cura_torchrl.trainers.pictures.video import encode_animation
from tests.recordings import TRACKS, make_recording


@pytest.fixture(scope="module")
def frames() -> list[Image.Image]:
    """The same drive twice; the one on the left ends half way."""
    long = make_recording()
    short = make_recording(
        outcome="collision",
        frame_steps=long.frame_steps[:2],
        scans=long.scans[:2],
        maps=long.maps[:2],
        **{name: getattr(long, name)[:4] for name in TRACKS},
    )
    return animation_frames([short, long])


def colour_at(frame: Image.Image, x: float, y: float, *, column: int = 1) -> tuple[int, ...]:
    """Return the colour of a place in the world, as a recording's scene panel shows it."""
    left, top = scene_panel(column).pixel_in_frame(x, y)
    return frame.getpixel((int(left), int(top)))


def test_frames_have_one_column_for_each_recording(frames: list[Image.Image]) -> None:
    """Catches a frame that is cut off, and an animation that ends with the shorter recording."""
    assert len(frames) == 3
    assert {frame.size for frame in frames} == {(2 * COLUMN_WIDTH, FRAME_HEIGHT)}


@pytest.mark.parametrize(("number", "x"), [(0, 0.0), (1, 1.5), (2, 3.0)])
def test_bodies_have_their_colours_at_their_places(frames: list[Image.Image], number: int, x: float) -> None:
    """Catches a wrong frame, scale or axis: frames are states 0, 3, 6, the base moves 0.5 m between states."""
    assert colour_at(frames[number], x + 1.7, 0.3) == ImageColor.getrgb(raster.OBJECT)
    assert colour_at(frames[number], x - 0.3, 0.25) == ImageColor.getrgb(raster.ROBOT)


def test_obstacle_is_drawn_once_it_has_appeared(frames: list[Image.Image]) -> None:
    """Catches pictures that show what is not there yet: it appears in state 2, between the first two frames."""
    assert colour_at(frames[0], 8.0, 0.0) != ImageColor.getrgb(raster.OBSTACLE)
    assert colour_at(frames[1], 8.0, 0.1) == ImageColor.getrgb(raster.OBSTACLE)


def test_paths_are_drawn_behind_the_bodies(frames: list[Image.Image]) -> None:
    """Catches a path that is missing: the base came from x = 0 to x = 3."""
    assert colour_at(frames[2], 1.0, 0.0) == ImageColor.getrgb(raster.ROBOT)
    assert colour_at(frames[2], 1.0, 0.5) != ImageColor.getrgb(raster.ROBOT)


def test_lidar_sees_as_far_as_it_measured(frames: list[Image.Image]) -> None:
    """Catches rays of the wrong length: 5 m around the base."""
    assert colour_at(frames[0], 3.0, 3.0) in {ImageColor.getrgb(raster.RAY), ImageColor.getrgb("#c3dff0")}
    assert colour_at(frames[0], 5.5, 3.0) == (255, 255, 255)


def test_a_recording_that_is_over_stands_still(frames: list[Image.Image]) -> None:
    """Catches an animation that runs past a recording's end, or wraps around."""
    left = [np.asarray(frame)[:, :COLUMN_WIDTH] for frame in frames]
    assert np.array_equal(left[1], left[2])
    assert not np.array_equal(left[0], left[1])


def test_every_second_frame_still_shows_the_end(frames: list[Image.Image]) -> None:
    """Catches a thinned animation that leaves the outcome out."""
    recording = make_recording()
    thin = animation_frames([recording], every=5)
    assert len(thin) == 2
    assert np.array_equal(np.asarray(thin[-1]), np.asarray(animation_frames([recording])[-1]))


def test_map_shows_what_is_ahead_on_the_right_and_the_left_on_top() -> None:
    """Catches a mirrored or turned map: row i lies ahead, column j to the left."""
    values = np.zeros((100, 100), dtype=np.uint8)
    values[99, 0] = 255  # far ahead, far to the right
    picture = np.asarray(map_image(values, raster.CONFIDENCE_COLOURS, 200))
    light, dark = raster.CONFIDENCE_COLOURS[255], raster.CONFIDENCE_COLOURS[0]
    assert (picture[-2:, -2:] == light).all()
    assert (picture[:2, -2:] == dark).all()
    assert (picture[:, :2] == dark).all()


def test_map_panel_shows_the_recorded_confidence(frames: list[Image.Image]) -> None:
    """Catches swapped channels: what is ahead has been seen, nothing is occupied."""
    pixels = np.asarray(frames[0])[:, COLUMN_WIDTH:]
    # The panels' plot areas are 200 pixels wide, at 44 (confidence) and 264 (occupancy), 320 from the top.
    assert (pixels[330, 230] == raster.CONFIDENCE_COLOURS[255]).all()
    assert (pixels[330, 60] == raster.CONFIDENCE_COLOURS[0]).all()
    assert (pixels[330, 450] == raster.OCCUPANCY_COLOURS[0]).all()


def test_atoms_are_drawn_as_bars_in_order_of_size(frames: list[Image.Image]) -> None:
    """Catches unsorted atoms: half of them are 0 and half are 1, so the bars fill the right half."""
    pixels = np.asarray(frames[0])[567:684, COLUMN_WIDTH + 44 : COLUMN_WIDTH + 194]
    is_bar = (np.abs(pixels[20].astype(int) - ImageColor.getrgb(raster.UNCERTAINTY)) < 60).all(-1)
    assert is_bar[:74].sum() == 0
    assert is_bar[76:].mean() > 0.5


def test_animation_is_whole_and_keeps_its_last_frame_longer(frames: list[Image.Image]) -> None:
    """Catches frames that are dropped or altered, and an animation that does not loop."""
    content = encode_animation(frames, frame_time=0.1, hold_time=2.0)
    with Image.open(io.BytesIO(content)) as opened:
        assert (opened.format, opened.n_frames, opened.info["loop"]) == ("WEBP", 3, 0)
        shown = []
        for number in range(3):
            opened.seek(number)
            shown.append((opened.convert("RGB"), opened.info["duration"]))
    assert [duration for _, duration in shown] == [100, 100, 2000]
    assert all(np.array_equal(np.asarray(a), np.asarray(b)) for (a, _), b in zip(shown, frames, strict=True))


def test_scales_of_both_columns_are_the_same() -> None:
    """Catches a baseline whose uncertainty looks small because its axis is long."""
    calm = make_recording(atoms=np.full((7, 50), 0.01, dtype=np.float32))
    left = np.asarray(animation_frames([calm, make_recording()])[0])[567:684, 264:464]
    alone = np.asarray(animation_frames([calm])[0])[567:684, 264:464]
    # R = 0.01 of an axis that ends at 0.2 when alone, at 0.5 beside R = 0.5: the lines differ.
    assert not np.array_equal(left, alone)
    assert animation._ceiling(0.5, least=0.2) == pytest.approx(1.0)
