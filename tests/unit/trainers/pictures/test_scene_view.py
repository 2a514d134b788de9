"""The 3-D view shows the recording."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest
from PIL import Image, ImageColor

from cura_torchrl.trainers.pictures import raster
from cura_torchrl.trainers.pictures.scene_view import FOOTER, HEADER, draw_scene, make_camera, scene_frames
from tests.recordings import make_recording

SIZE = (480, 240)


def near(frame: Image.Image, colour: str) -> np.ndarray:
    """Return where a frame has nearly a colour, shape ``[H, W]``."""
    return (np.abs(np.asarray(frame).astype(int) - ImageColor.getrgb(colour)) < 40).all(-1)


@pytest.fixture(scope="module")
def seen() -> tuple[Image.Image, np.ndarray]:
    """The last state of a straight drive, the object on its left, seen in 3-D, and where some points are.

    The points: object, obstacle, robot's path, object's path, and floor that the LiDAR sees.
    """
    aside = np.array([0.0, 0.8, 0.0], dtype=np.float32)
    straight = make_recording()
    recording = make_recording(
        object_pose=straight.object_pose + aside, object_position=straight.object_position + aside
    )
    with closing(make_camera(recording, SIZE)) as camera:
        picture = draw_scene(camera, recording, 2)
        points = [(4.5, 0.8, 0.5), (8.0, 0.0, 0.2), (2.2, 0.0, 0.0), (3.4, 0.8, 0.0), (4.0, 3.0, 0.0)]
        return picture, camera.project(np.array(points))


def pixel(picture: Image.Image, place: np.ndarray) -> np.ndarray:
    """Return the colour at a place."""
    return np.asarray(picture)[int(place[1]), int(place[0])].astype(int)


def test_object_and_obstacle_are_where_they_were(seen: tuple[Image.Image, np.ndarray]) -> None:
    """Catches a camera that shows another state, or bodies beside their places."""
    picture, places = seen
    red, green, blue = pixel(picture, places[0])
    assert red > 1.5 * green  # magenta, however bright
    assert blue > 1.5 * green
    obstacle = pixel(picture, places[1])
    # It appeared 0.8 s ago, and is still marked.
    assert obstacle[0] > 1.5 * obstacle[2]


def test_paths_and_what_the_lidar_sees_lie_on_the_floor(seen: tuple[Image.Image, np.ndarray]) -> None:
    """Catches a floor that is mirrored, shifted or missing."""
    picture, places = seen
    assert pixel(picture, places[2]) == pytest.approx(np.array(ImageColor.getrgb(raster.ROBOT)), abs=40)
    assert pixel(picture, places[3]) == pytest.approx(np.array(ImageColor.getrgb(raster.OBJECT)), abs=40)
    assert pixel(picture, places[4]) == pytest.approx(np.array(ImageColor.getrgb(raster.RAY)), abs=30)


def test_frames_stand_side_by_side_and_end_with_the_last_state() -> None:
    """Catches a frame that is cut off, or an animation that is shorter than the longest recording."""
    pair = [make_recording(outcome="collision"), make_recording()]
    frames = list(scene_frames(pair, size=SIZE, every=2))
    assert len(frames) == 2
    assert {frame.size for frame in frames} == {(2 * 480, 240 + HEADER + FOOTER)}
    body = np.asarray(frames[-1])[HEADER + 2 : HEADER + 238]
    # Both have played the same; only the outcome that is written above differs.
    assert np.array_equal(body[:, 4:470], body[:, 484:950])
    assert near(frames[-1].crop((0, 0, 480, HEADER)), raster.FAILURE).sum() > 20
    assert near(frames[-1].crop((480, 0, 960, HEADER)), raster.FAILURE).sum() == 0
