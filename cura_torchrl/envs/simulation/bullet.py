"""PyBullet: N worlds, one client each, stepped one after the other. The only file that knows the engine.

World gravity is zero: a gravity-compensated arm then needs no inverse dynamics, and the object's weight is an external
force on its centre of mass in every tick. A reset rebuilds the world from nothing, so an episode cannot depend on
earlier ones.
"""

from __future__ import annotations

import contextlib
import os
import sys
from operator import itemgetter
from struct import Struct
from typing import TYPE_CHECKING

import numpy as np
import pybullet as bullet
import torch

from cura_torchrl.envs.simulation.interface import SceneState, SimulationError, TorqueLaw, WorldState

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from cura_torchrl.envs.config import PhysicsConfig

ROBOT, OBJECT, OBSTACLE, FLOOR = 2, 4, 8, 16
"""Collision groups. Bullet tests rays as group 1."""

_RAY_GROUP = 1
_MAX_RAYS = 8192
"""Rays in one call; Bullet returns nothing for 16,384 numpy rays or more."""

_BASE_LINKS = ("base_slide_x", "base_slide_y", "base_link")
"""The robot's first links; all later ones belong to the arm."""

_position, _velocity = itemgetter(0), itemgetter(1)
"""What is wanted of Bullet's answer for a joint."""


class BulletWorlds:
    """N PyBullet worlds: floor, robot, object, obstacles.

    Args:
        num_worlds: Number of worlds N.
        urdf: The robot's model.
        joints: Names of its moving joints, base first, in the order of every joint array here.
        physics: Clock and contact.
    """

    def __init__(self, num_worlds: int, urdf: Path, joints: tuple[str, ...], physics: PhysicsConfig) -> None:
        if not bullet.isNumpyEnabled():
            msg = "this PyBullet was built without numpy; accepted: the wheels of pybullet 3.2.7 or newer"
            raise SimulationError(msg)
        self.num_worlds = num_worlds
        self._urdf, self._joints, self._physics = str(urdf), joints, physics
        self._index = list(range(len(joints)))
        with silent():
            self._clients = [bullet.connect(bullet.DIRECT) for _ in range(num_worlds)]
        if min(self._clients) < 0:
            self.close()
            msg = f"PyBullet refused one of {num_worlds} clients; accepted: at most 1024 in a process"
            raise SimulationError(msg)
        self._robot = [-1] * num_worlds
        self._object = [-1] * num_worlds
        self._obstacles: list[list[int]] = [[] for _ in range(num_worlds)]
        self._weight = np.zeros(num_worlds)
        self._com_offset = np.zeros((num_worlds, 3))
        self._contact = np.zeros((num_worlds, 3), dtype=bool)
        self._joint_state = np.zeros((num_worlds, 2, len(joints)))

    def __reduce__(self) -> str:
        """Refuse to be copied or pickled: Bullet's worlds would be shared with the copy.

        Raises:
            TypeError: Always.
        """
        msg = (
            "PyBullet's worlds cannot be copied, or sent to another process; accepted: to make them there, with"
            " functools.partial(PushEnv, ...)"
        )
        raise TypeError(msg)

    def close(self) -> None:
        """Disconnect every client; harmless when done twice."""
        for client in self._clients:
            if client >= 0:
                bullet.disconnect(client)
        self._clients = []

    def reset(self, rows: torch.Tensor, scene: SceneState) -> None:
        """Rebuild worlds.

        Args:
            rows: Indices of the worlds, shape ``[B]``.
            scene: Where everything starts, batch ``[B]``.
        """
        with silent():
            for row, world in enumerate(rows.tolist()):
                self._build(world, scene, row)

    def _build(self, world: int, scene: SceneState, row: int) -> None:
        client = self._clients[world]
        bullet.resetSimulation(physicsClientId=client)
        bullet.setGravity(0, 0, 0, physicsClientId=client)
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=self._physics.control_period,
            numSolverIterations=self._physics.solver_iterations,
            enableConeFriction=1,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        floor = bullet.createMultiBody(
            0, bullet.createCollisionShape(bullet.GEOM_PLANE, physicsClientId=client), physicsClientId=client
        )
        # Bullet multiplies the two bodies' friction: with 1 here the object's value is the pair's.
        bullet.changeDynamics(floor, -1, lateralFriction=1.0, restitution=0.0, physicsClientId=client)
        bullet.setCollisionFilterGroupMask(floor, -1, FLOOR, OBJECT, physicsClientId=client)
        self._robot[world] = self._build_robot(client, scene.joint_position[row].tolist())
        self._object[world] = self._build_object(client, world, scene, row)
        self._obstacles[world] = [-1] * scene.num_slots
        self._contact[world] = False
        self._read_joints(world)

    def _build_robot(self, client: int, position: list[float]) -> int:
        flags = (
            bullet.URDF_USE_INERTIA_FROM_FILE
            | bullet.URDF_MAINTAIN_LINK_ORDER
            | bullet.URDF_IGNORE_VISUAL_SHAPES
            | bullet.URDF_MERGE_FIXED_LINKS  # a quarter of the tick's cost otherwise
        )
        robot = bullet.loadURDF(self._urdf, useFixedBase=True, flags=flags, physicsClientId=client)
        names = [bullet.getJointInfo(robot, i, physicsClientId=client)[1].decode() for i in self._index]
        if tuple(names) != self._joints:
            msg = f"the robot's joints are {names}; accepted: {list(self._joints)}"
            raise SimulationError(msg)
        for link in range(-1, len(self._joints)):
            bullet.setCollisionFilterGroupMask(robot, link, ROBOT, OBJECT | OBSTACLE, physicsClientId=client)
            bullet.changeDynamics(
                robot, link, lateralFriction=self._physics.hand_friction, restitution=0.0, linearDamping=0.0,
                angularDamping=0.0, jointDamping=0.0, physicsClientId=client,
            )  # fmt: skip
        for joint, value in zip(self._index, position, strict=True):
            bullet.resetJointState(robot, joint, value, 0.0, physicsClientId=client)
            # Every joint is born with a zero-velocity motor.
            bullet.setJointMotorControl2(robot, joint, bullet.VELOCITY_CONTROL, force=0.0, physicsClientId=client)
        return robot

    def _build_object(self, client: int, world: int, scene: SceneState, row: int) -> int:
        edge, mass = scene.object_edge[row].item(), scene.object_mass[row].item()
        offset, (x, y, yaw) = scene.com_offset[row].tolist(), scene.object_pose[row].tolist()
        shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=[edge / 2] * 3, physicsClientId=client)
        # The inertial frame is the only way to set a centre of mass: changeDynamics has none.
        body = bullet.createMultiBody(
            mass, shape, basePosition=[x, y, edge / 2], baseOrientation=[0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)],
            baseInertialFramePosition=offset, physicsClientId=client,
        )  # fmt: skip
        inertia = mass * edge**2 / 6  # solid cube
        bullet.changeDynamics(
            body, -1, lateralFriction=scene.floor_friction[row].item(), restitution=0.0, linearDamping=0.0,
            angularDamping=0.0, localInertiaDiagonal=[inertia] * 3,
            activationState=bullet.ACTIVATION_STATE_DISABLE_SLEEPING, physicsClientId=client,
        )  # fmt: skip
        seen_by = _RAY_GROUP | ROBOT | OBSTACLE | FLOOR
        bullet.setCollisionFilterGroupMask(body, -1, OBJECT, seen_by, physicsClientId=client)
        self._weight[world] = mass * self._physics.gravity
        self._com_offset[world] = offset
        return body

    def place_obstacles(self, is_new: torch.Tensor, pose: torch.Tensor, edge: torch.Tensor) -> None:
        """Let static cubes appear on the floor.

        Args:
            is_new: Which obstacles appear now, bool, shape ``[N, M]``.
            pose: Their centres (x [m], y [m], yaw [rad]) in the world frame, shape ``[N, M, 3]``.
            edge: Their edges [m], shape ``[N, M]``.
        """
        for world, slot in is_new.nonzero().tolist():
            self._place(world, slot, pose[world, slot].tolist(), edge[world, slot].item())

    def _place(self, world: int, slot: int, pose: list[float], edge: float) -> None:
        client, (x, y, yaw) = self._clients[world], pose
        shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=[edge / 2] * 3, physicsClientId=client)
        body = bullet.createMultiBody(
            0, shape, basePosition=[x, y, edge / 2], baseOrientation=[0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)],
            physicsClientId=client,
        )  # fmt: skip
        bullet.changeDynamics(body, -1, restitution=0.0, physicsClientId=client)
        bullet.setCollisionFilterGroupMask(body, -1, OBSTACLE, _RAY_GROUP | ROBOT | OBJECT, physicsClientId=client)
        self._obstacles[world][slot] = body

    def mass_matrix(self) -> torch.Tensor:
        """Return the joint-space inertia of every robot [kg, kg m^2], shape ``[N, J, J]``."""
        matrices = [
            bullet.calculateMassMatrix(robot, state[0].tolist(), physicsClientId=client)
            for robot, state, client in zip(self._robot, self._joint_state, self._clients, strict=True)
        ]
        return torch.from_numpy(np.array(matrices))

    def advance(self, law: TorqueLaw, ticks: int) -> None:
        """Run control and physics of one policy step.

        Args:
            law: Joint torques from joint states, called in every tick.
            ticks: Number of ticks.

        Raises:
            SimulationError: If a state or a torque is not finite.
        """
        self._contact[:] = False
        for world in range(self.num_worlds):
            self._play(law, world, ticks)
        state = self._joint_state
        finite = np.isfinite(state).all(axis=(1, 2))
        if not finite.all():
            msg = f"worlds {np.flatnonzero(~finite).tolist()} have joint states that are not finite"
            raise SimulationError(msg)

    def _play(self, law: TorqueLaw, world: int, ticks: int) -> None:
        # All ticks of one world in a row: its data stay in the cache. What can be is passed by position, and what is
        # looked up is looked up once: calls of half a microsecond are what the loop is made of.
        client, robot, body = self._clients[world], self._robot[world], self._object[world]
        weight, joints, index = (0.0, 0.0, -self._weight[world].item()), self._joint_state[world], self._index
        command, push, step = bullet.setJointMotorControlArray, bullet.applyExternalForce, bullet.stepSimulation
        read, locate = bullet.getJointStates, bullet.getBasePositionAndOrientation
        torque_control, world_frame = bullet.TORQUE_CONTROL, bullet.WORLD_FRAME
        torques_of, keep = law.torques_of, Struct(f"{joints.size}d").pack_into
        for start in range(0, ticks, law.ik_ticks):
            law.solve_ik_of(world)
            for _ in range(min(law.ik_ticks, ticks - start)):
                command(robot, index, torque_control, forces=torques_of(world, joints), physicsClientId=client)
                push(body, -1, weight, locate(body, client)[0], world_frame, client)
                step(client)
                entries = read(robot, index, client)
                keep(joints, 0, *map(_position, entries), *map(_velocity, entries))
            self._note_contacts(world)

    def _note_contacts(self, world: int) -> None:
        for obstacle in self._obstacles[world]:
            if obstacle < 0:
                continue
            for point in bullet.getContactPoints(bodyA=obstacle, physicsClientId=self._clients[world]):
                if point[8] > 0.0:  # a gap: Bullet reports near pairs too
                    continue
                if point[2] == self._object[world]:
                    self._contact[world, 2] = True
                else:
                    self._contact[world, int(point[4] >= len(_BASE_LINKS))] = True

    def _read_joints(self, world: int) -> None:
        entries = bullet.getJointStates(self._robot[world], self._index, physicsClientId=self._clients[world])
        self._joint_state[world] = np.array([entry[:2] for entry in entries]).T

    def state(self) -> WorldState:
        """Return the state of every world, batch ``[N]``.

        Raises:
            SimulationError: If a pose is not finite.
        """
        poses, twists = [], []
        for client, body in zip(self._clients, self._object, strict=True):
            position, quaternion = bullet.getBasePositionAndOrientation(body, physicsClientId=client)
            linear, angular = bullet.getBaseVelocity(body, physicsClientId=client)
            poses.append(position + quaternion)
            twists.append(linear + angular)
        pose, twist = torch.tensor(poses, dtype=torch.float64), torch.tensor(twists, dtype=torch.float64)
        finite = torch.isfinite(pose).all(-1) & torch.isfinite(twist).all(-1)
        if not bool(finite.all()):
            msg = f"worlds {(~finite).nonzero().flatten().tolist()} have an object whose state is not finite"
            raise SimulationError(msg)
        # Bullet reports the centre of mass; the task speaks of the cube's centre.
        to_centre = _rotate(pose[:, 3:], -torch.from_numpy(self._com_offset))
        joints = torch.from_numpy(self._joint_state.copy())
        return WorldState(
            base_pose=joints[:, 0, :3],
            base_velocity=joints[:, 1, :3],
            joint_position=joints[:, 0, 3:],
            joint_velocity=joints[:, 1, 3:],
            object_position=pose[:, :3] + to_centre,
            object_quaternion=pose[:, 3:],
            object_velocity=twist[:, :3] + torch.cross(twist[:, 3:], to_centre, dim=-1),
            object_angular_velocity=twist[:, 3:],
            contact=torch.from_numpy(self._contact.copy()),
        )

    def cast(self, rows: torch.Tensor, origin: torch.Tensor, ends: torch.Tensor, *, see_object: bool) -> torch.Tensor:
        """Cast rays, one call per world. Rays never see the robot.

        Args:
            rows: Indices of the worlds, shape ``[B]``.
            origin: Where the rays start, world frame [m], shape ``[B, 3]``.
            ends: Where they end, world frame [m], shape ``[B, R, 3]``.
            see_object: Whether rays hit the pushed object.

        Returns:
            Share of the ray that is free [1], 1 for a miss, shape ``[B, R]``.

        Raises:
            SimulationError: If a ray is not finite, or Bullet does not answer every ray.
        """
        num_rays = ends.shape[1]
        finite = bool(origin.isfinite().all() and ends.isfinite().all())
        if num_rays > _MAX_RAYS or not finite:
            msg = f"{num_rays} rays, finite: {finite}; accepted: at most {_MAX_RAYS} finite rays a world"
            raise SimulationError(msg)
        mask = OBSTACLE | (OBJECT if see_object else 0)
        fractions = np.empty(ends.shape[:2])
        starts, targets = origin[:, None].expand(ends.shape).contiguous().numpy(), ends.numpy()
        for row, world in enumerate(rows.tolist()):
            client = self._clients[world]
            hits = bullet.rayTestBatch(starts[row], targets[row], collisionFilterMask=mask, physicsClientId=client)
            if len(hits) != num_rays:
                msg = f"Bullet answered {len(hits)} of {num_rays} rays in world {world}"
                raise SimulationError(msg)
            fractions[row] = [hit[2] for hit in hits]
        return torch.from_numpy(fractions)


def _rotate(quaternion: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    axis, scalar = quaternion[:, :3], quaternion[:, 3:]
    twice = 2.0 * torch.cross(axis, vector, dim=-1)
    return vector + scalar * twice + torch.cross(axis, twice, dim=-1)


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Send C's stdout to nowhere: Bullet prints there and cannot be told not to."""
    sys.stdout.flush()
    saved = os.dup(1)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)
        os.close(nowhere)
