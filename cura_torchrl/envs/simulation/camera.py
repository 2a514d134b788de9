"""A camera on recorded states: PyBullet's software renderer, which needs neither a display nor a GPU.

Nothing is simulated here: bodies are put where they were. The floor is not drawn, for it would take most of the time;
:meth:`Camera.floor_to_picture` tells where it lies in the picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import pybullet as bullet

from cura_torchrl.envs.simulation.bullet import silent

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

Colour: TypeAlias = "tuple[int, int, int]"
"""Red, green, blue, 0 to 255."""

_NEAR, _FAR = 0.3, 60.0
"""Depths between which things are drawn [m]."""
_LIGHT = (-2.0, -3.0, 6.0)
"""Where the light comes from, world frame."""
_AWAY = (0.0, 0.0, -20.0)
"""Where an obstacle is that has not appeared, world frame [m]."""


@dataclass(frozen=True, kw_only=True)
class View:
    """Where the camera stands and what it looks at, world frame."""

    eye: tuple[float, float, float]
    """Position of the camera [m]."""
    target: tuple[float, float, float]
    """Point in the middle of the picture [m]."""
    field_of_view: float = 50.0
    """Vertical angle that is seen [deg]."""


class Camera:
    """Robot, object and obstacles in a client of PyBullet's own, seen from where one likes.

    Args:
        urdf: The robot's model.
        object_edge: Edge of the pushed cube [m].
        obstacle_edges: Edges of the obstacles [m], 0 for those that never appear, shape ``[M]``.
        size: Width and height of the pictures [pixel].
        colours: Colours of the robot's base and of the object.
    """

    def __init__(
        self, urdf: Path, *, object_edge: float, obstacle_edges: Sequence[float], size: tuple[int, int],
        colours: tuple[Colour, Colour],
    ) -> None:  # fmt: skip
        self.size = size
        with silent():
            self._client = bullet.connect(bullet.DIRECT)
            # Fixed links stay apart: merged ones would lose their own colours.
            self._robot = bullet.loadURDF(str(urdf), useFixedBase=True, physicsClientId=self._client)
        entries = [
            bullet.getJointInfo(self._robot, joint, physicsClientId=self._client)
            for joint in range(bullet.getNumJoints(self._robot, physicsClientId=self._client))
        ]
        self._joints = [entry[0] for entry in entries if entry[2] != bullet.JOINT_FIXED]
        for base in (entry[0] for entry in entries if entry[12] == b"base_link"):
            self._paint(self._robot, colours[0], link=base, shapeIndex=0)
        self._object = self._box(object_edge, colours[1])
        self._obstacles = [self._box(edge, (128, 128, 128)) if edge > 0 else None for edge in obstacle_edges]
        self._edges = list(obstacle_edges)
        self._matrices = np.eye(4), np.eye(4)

    def close(self) -> None:
        """Disconnect the client; harmless when done twice."""
        if self._client >= 0:
            bullet.disconnect(self._client)
        self._client = -1

    def place_robot(self, joints: Sequence[float]) -> None:
        """Put the robot where it was.

        Args:
            joints: Positions of its moving joints, base first [m, rad], shape ``[J]``.

        Raises:
            ValueError: If the robot has not as many.
        """
        if len(joints) != len(self._joints):
            msg = f"number of joint positions is {len(joints)}; accepted: {len(self._joints)}, those of the robot"
            raise ValueError(msg)
        for joint, value in zip(self._joints, joints, strict=True):
            bullet.resetJointState(self._robot, joint, value, physicsClientId=self._client)

    def place_object(self, position: Sequence[float], quaternion: Sequence[float]) -> None:
        """Put the object where it was.

        Args:
            position: Centre of the cube, world frame [m].
            quaternion: Its orientation, xyzw.
        """
        bullet.resetBasePositionAndOrientation(self._object, position, quaternion, physicsClientId=self._client)

    def place_obstacles(self, poses: NDArray[np.floating], colours: Sequence[Colour | None]) -> None:
        """Put the obstacles on the floor.

        Args:
            poses: (x [m], y [m], yaw [rad]), shape ``[M, 3]``.
            colours: Colour of each; None where it has not appeared.
        """
        for body, edge, pose, colour in zip(self._obstacles, self._edges, poses.tolist(), colours, strict=True):
            if body is None:
                continue
            x, y, yaw = pose
            place = _AWAY if colour is None else (x, y, edge / 2)
            turn = (0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))
            bullet.resetBasePositionAndOrientation(body, place, turn, physicsClientId=self._client)
            if colour is not None:
                self._paint(body, colour)

    def look(self, view: View) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Take a picture.

        Args:
            view: Where the camera stands.

        Returns:
            Colours, shape ``[H, W, 3]``, and where any body is seen, shape ``[H, W]``.
        """
        width, height = self.size
        seen = bullet.computeViewMatrix(view.eye, view.target, (0.0, 0.0, 1.0))
        lens = bullet.computeProjectionMatrixFOV(view.field_of_view, width / height, _NEAR, _FAR)
        self._matrices = np.reshape(seen, (4, 4)).T, np.reshape(lens, (4, 4)).T
        _, _, pixels, _, bodies = bullet.getCameraImage(
            width, height, seen, lens, shadow=0, lightDirection=_LIGHT, renderer=bullet.ER_TINY_RENDERER,
            physicsClientId=self._client,
        )  # fmt: skip
        colours = np.reshape(pixels, (height, width, 4)).astype(np.uint8)[..., :3]
        return colours, np.reshape(bodies, (height, width)) >= 0

    def project(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return where points are seen in the last picture, whatever hides them.

        Args:
            points: Points in the world frame [m], shape ``[M, 3]``.

        Returns:
            Column and row [pixel] and depth [m], negative behind the camera, shape ``[M, 3]``.
        """
        seen, lens = self._matrices
        clip = np.concatenate([points, np.ones((len(points), 1))], -1) @ (self._to_pixels() @ lens @ seen).T
        return np.concatenate([clip[:, :2], clip[:, 3:]], -1) / np.stack([clip[:, 3]] * 2 + [np.ones(len(clip))], -1)

    def floor_to_picture(self) -> NDArray[np.float64]:
        """Return how the floor is seen in the last picture.

        Returns:
            Matrix H, shape ``[3, 3]``: the point (x, y) of the floor is at (column, row) = (a / c, b / c) with
            (a, b, c) = H (x, y, 1), if c [m], its depth, is positive.
        """
        seen, lens = self._matrices
        return (self._to_pixels() @ lens @ seen)[np.ix_((0, 1, 3), (0, 1, 3))]

    def _to_pixels(self) -> NDArray[np.float64]:
        # From Bullet's picture, -1 to 1 with y upwards, to columns and rows.
        width, height = self.size
        matrix = np.eye(4)
        matrix[0], matrix[1] = (width / 2, 0.0, 0.0, width / 2), (0.0, -height / 2, 0.0, height / 2)
        return matrix

    def _box(self, edge: float, colour: Colour) -> int:
        shape = bullet.createVisualShape(
            bullet.GEOM_BOX, halfExtents=[edge / 2] * 3, rgbaColor=_rgba(colour), physicsClientId=self._client
        )
        body: int = bullet.createMultiBody(0, -1, shape, basePosition=_AWAY, physicsClientId=self._client)
        return body

    def _paint(self, body: int, colour: Colour, *, link: int = -1, **options: int) -> None:
        bullet.changeVisualShape(body, link, rgbaColor=_rgba(colour), physicsClientId=self._client, **options)


def _rgba(colour: Colour) -> list[float]:
    return [*(value / 255 for value in colour), 1.0]
