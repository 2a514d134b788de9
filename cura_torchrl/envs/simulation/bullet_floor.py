"""PyBullet and nothing around it: what benchmarks compare the package with, in the same worlds.

Nothing in the package needs this file. Beside ``bullet.py`` it is the only one that calls the engine.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import pybullet as bullet

from cura_torchrl.envs.simulation.bullet import OBJECT, OBSTACLE, BulletWorlds

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cura_torchrl.envs.simulation.interface import Worlds

Vector: TypeAlias = "tuple[float, ...]"


class BulletFloor:
    """Bare calls to the engine in worlds that are already there.

    Args:
        worlds: The worlds, after a reset.

    Raises:
        TypeError: If the worlds are not PyBullet's.
    """

    def __init__(self, worlds: Worlds) -> None:
        if not isinstance(worlds, BulletWorlds):
            msg = f"worlds are {type(worlds).__name__}; accepted: BulletWorlds"
            raise TypeError(msg)
        self._worlds = worlds
        self._index = list(worlds._index)

    def play(
        self, torques: Sequence[Sequence[Sequence[float]]], positions: Sequence[Sequence[Vector]] | None = None
    ) -> list[list[Vector]]:
        """Per tick and world: set the torques and the object's weight, step, read the joints.

        Args:
            torques: Torque of each joint in each tick of each world, ``[N][T][J]`` [N, N m].
            positions: Where the object's centre of mass is then, ``[N][T][3]`` [m]; None reads it, a call more.

        Returns:
            The positions that were read, or nothing.
        """
        worlds, found = self._worlds, []
        each = zip(worlds._clients, worlds._robot, worlds._object, worlds._weight.tolist(), strict=True)
        for world, (client, robot, body, weight) in enumerate(each):
            known = None if positions is None else positions[world]
            found.append(self._play_one(client, robot, body, (0.0, 0.0, -weight), torques[world], known))
        return found

    def _play_one(
        self, client: int, robot: int, body: int, weight: Vector, torques: Sequence[Sequence[float]],
        positions: Sequence[Vector] | None,
    ) -> list[Vector]:  # fmt: skip
        command, push, step = bullet.setJointMotorControlArray, bullet.applyExternalForce, bullet.stepSimulation
        read, index, found = bullet.getJointStates, self._index, []
        torque_control, world_frame = bullet.TORQUE_CONTROL, bullet.WORLD_FRAME
        for tick, torque in enumerate(torques):
            if positions is None:
                found.append(bullet.getBasePositionAndOrientation(body, client)[0])
            position = found[tick] if positions is None else positions[tick]
            command(robot, index, torque_control, forces=torque, physicsClientId=client)
            push(body, -1, weight, position, world_frame, client)
            step(client)
            read(robot, index, client)
        return found

    def cast(self, starts: np.ndarray, ends: np.ndarray) -> None:
        """Cast rays in every world, and leave the answers alone.

        Args:
            starts: Where they start [m], shape ``[N, R, 3]``.
            ends: Where they end [m], shape ``[N, R, 3]``.
        """
        mask = OBSTACLE | OBJECT
        for row, client in enumerate(self._worlds._clients):
            bullet.rayTestBatch(starts[row], ends[row], collisionFilterMask=mask, physicsClientId=client)

    def joints(self) -> np.ndarray:
        """Return positions and velocities of the joints as the engine has them, shape ``[N, 2, J]``."""
        states = [
            bullet.getJointStates(robot, self._index, client)
            for robot, client in zip(self._worlds._robot, self._worlds._clients, strict=True)
        ]
        return np.array([[[entry[k] for entry in row] for k in (0, 1)] for row in states])

    def solve_ik(self, targets: Sequence[Vector], iterations: int) -> list[Vector]:
        """Let the engine solve the inverse kinematics of every robot, one after the other.

        Args:
            targets: Where the arm's last link is to be, world frame [m], ``[N][3]``.
            iterations: Most iterations [1].

        Returns:
            Joint positions, ``[N][J]``.
        """
        each = zip(self._worlds._robot, self._worlds._clients, targets, strict=True)
        return [
            bullet.calculateInverseKinematics(
                robot, self._index[-1], target, maxNumIterations=iterations, physicsClientId=client
            )
            for robot, client, target in each
        ]
