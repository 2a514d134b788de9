"""The camera shows bodies where they are."""

from __future__ import annotations

from contextlib import closing
from typing import TYPE_CHECKING

import numpy as np
import pytest

from cura_torchrl.envs.robots.ridgeback_franka import HOME, URDF
from cura_torchrl.envs.simulation.camera import Camera, View

if TYPE_CHECKING:
    from collections.abc import Iterator

GREEN, MAGENTA, GREY = (0, 160, 80), (200, 0, 140), (70, 70, 70)
SIZE = (160, 120)
BEHIND = View(eye=(-3.6, -2.2, 3.4), target=(2.2, 0.2, 0.2))


@pytest.fixture(scope="module")
def camera() -> Iterator[Camera]:
    """A robot at the origin, a cube of 1 m ahead of it on the left, two obstacles of which one has appeared."""
    with closing(
        Camera(URDF, object_edge=1.0, obstacle_edges=[0.6, 0.0, 0.4], size=SIZE, colours=(GREEN, MAGENTA))
    ) as made:
        made.place_robot([0.0, 0.0, 0.0, *HOME])
        made.place_object([2.0, 0.8, 0.5], [0.0, 0.0, 0.0, 1.0])
        made.place_obstacles(np.array([[4.0, -1.5, 0.3], [0.0] * 3, [3.0, 3.0, 0.0]]), [GREY, None, None])
        yield made


def hue(picture: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return a pixel's colour relative to its brightest channel: light makes it darker, not another colour."""
    pixel = picture[int(place[1]), int(place[0])].astype(float)
    return pixel / pixel.max()


@pytest.mark.parametrize(
    ("point", "colour"),
    [((2.0, 0.8, 0.5), MAGENTA), ((4.0, -1.5, 0.3), GREY), ((-0.45, 0.0, 0.18), GREEN)],
)
def test_bodies_are_seen_where_they_are_projected(
    camera: Camera, point: tuple[float, float, float], colour: tuple[int, int, int]
) -> None:
    """Catches a mirrored or shifted picture, and bodies in one another's colour."""
    picture, is_body = camera.look(BEHIND)
    assert picture.shape == (120, 160, 3)
    ((column, row, depth),) = camera.project(np.array([point]))
    assert is_body[int(row), int(column)]
    assert hue(picture, np.array([column, row])) == pytest.approx(np.array(colour) / max(colour), abs=0.06)
    # The depth is the distance along the line of sight.
    sight = np.subtract(BEHIND.target, BEHIND.eye)
    assert depth == pytest.approx(np.dot(np.subtract(point, BEHIND.eye), sight) / np.linalg.norm(sight), abs=1e-3)


def test_what_has_not_appeared_is_not_seen_and_the_floor_is_no_body(camera: Camera) -> None:
    """Catches obstacles that are shown before their time."""
    _, is_body = camera.look(BEHIND)
    for column, row, _ in camera.project(np.array([[3.0, 3.0, 0.2], [3.0, -2.5, 0.0]])):
        assert not is_body[int(row), int(column)]


def test_the_floor_is_where_its_points_are(camera: Camera) -> None:
    """Catches a floor that slides under the bodies: its matrix and the projection of points have to agree."""
    camera.look(BEHIND)
    points = np.array([[1.0, 2.0, 0.0], [6.0, -1.0, 0.0]])
    flat = np.concatenate([points[:, :2], np.ones((2, 1))], -1) @ camera.floor_to_picture().T
    assert flat[:, :2] / flat[:, 2:] == pytest.approx(camera.project(points)[:, :2])
    assert (flat[:, 2] > 0).all()


def test_the_point_in_the_middle_is_the_target(camera: Camera) -> None:
    """Catches a picture whose rows run upwards, which a symmetric scene would hide."""
    camera.look(BEHIND)
    middle, higher = camera.project(np.array([BEHIND.target, (2.2, 0.2, 1.2)]))
    assert middle[:2] == pytest.approx([80.0, 60.0], abs=1e-3)
    assert higher[1] < 50.0


def test_joints_of_another_robot_are_refused(camera: Camera) -> None:
    """Catches a recording of the base alone that is shown with an arm in a made-up posture."""
    with pytest.raises(ValueError, match="number of joint positions is 3; accepted: 10"):
        camera.place_robot([0.0, 0.0, 0.0])
