"""A simulator made of tensors: N worlds seen from above, stepped at once on any device.

The robot has the joints, the inertia and the control law that it has in PyBullet, less the Coriolis forces; cube, hand
and chassis push each other in the plane; obstacles are only looked at and counted as touched. Nothing tips over.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import torch

from cura_torchrl.envs import geometry
from cura_torchrl.envs.simulation.contact import Rectangle, overlap
from cura_torchrl.envs.simulation.cuda_graph import CudaGraph
from cura_torchrl.envs.simulation.interface import SimulationError, WorldState
from cura_torchrl.envs.simulation.planar_robot import planar_robot
from cura_torchrl.envs.simulation.pushing import Cube, PushContact
from cura_torchrl.envs.simulation.rays import free_share

if TYPE_CHECKING:
    from cura_torchrl.envs.config import PhysicsConfig
    from cura_torchrl.envs.simulation.interface import RobotShape, SceneState, TorqueLaw


class Dynamics(Protocol):
    """What knows the robot's inertia; see :class:`cura_torchrl.envs.robots.dynamics.RobotDynamics`."""

    def mass_matrix(self, joint_position: torch.Tensor) -> torch.Tensor:
        """Return the joint-space inertia ``[N, J, J]`` at joint positions ``[N, J]``."""
        ...


class PlanarWorlds:
    """N planar worlds: floor, robot, cube, obstacles. Their state is changed in place: a CUDA graph knows its memory.

    Args:
        num_worlds: Number of worlds N.
        dynamics: The robot's inertia.
        shape: The robot seen from above.
        physics: Clock and contact.
        device: Where the tensors live.
    """

    def __init__(
        self,
        num_worlds: int,
        dynamics: Dynamics,
        shape: RobotShape,
        physics: PhysicsConfig,
        device: torch.device | None = None,
    ) -> None:
        self.num_worlds = num_worlds
        self._dynamics, self._period = dynamics, physics.planar_period
        self._robot = planar_robot(shape, num_worlds, device)
        dof = self._robot.dof

        def zeros(*size: int) -> torch.Tensor:
            return torch.zeros(num_worlds, *size, dtype=torch.float64, device=device)

        self._position, self._velocity = zeros(dof), zeros(dof)
        self._graph: CudaGraph | None = None
        self._is_captured = physics.planar_graph and self._position.device.type == "cuda"
        self._inertia = torch.eye(dof, dtype=torch.float64, device=device).repeat(num_worlds, 1, 1)
        self._inverse_inertia = zeros(dof, dof)
        self._cube = Cube(zeros(3), zeros(3), zeros() + 1.0, zeros() + 1.0, zeros() + 1.0, zeros(3))
        self._pushing = PushContact(num_worlds, self._robot.num_pushers, physics, device)
        self._obstacle_pose, self._obstacle_edge = zeros(0, 3), zeros(0)
        self._contact = torch.zeros(num_worlds, 3, dtype=torch.bool, device=device)

    def close(self) -> None:
        """Do nothing: there is nothing to release."""

    def reset(self, rows: torch.Tensor, scene: SceneState) -> None:
        """Put worlds at their start.

        Args:
            rows: Indices of the worlds, shape ``[B]``.
            scene: Where everything starts, batch ``[B]``.
        """
        if self._obstacle_edge.shape[1] != scene.num_slots:
            self._obstacle_pose = self._position.new_zeros(self.num_worlds, scene.num_slots, 3)
            self._obstacle_edge = self._position.new_zeros(self.num_worlds, scene.num_slots)
            self._graph = None
        cube = self._cube
        self._position[rows], self._velocity[rows] = scene.joint_position.to(self._position), 0.0
        for own, start in (
            (cube.edge, scene.object_edge),
            (cube.mass, scene.object_mass),
            (cube.friction, scene.floor_friction),
            (cube.com_offset, scene.com_offset),
            (cube.pose, scene.object_pose),
            (cube.twist, torch.zeros_like(scene.object_pose)),
        ):
            own[rows] = start.to(own)
        cube.pose[rows, :2] += self._com_offset()[rows]
        self._pushing.reset(rows, cube)
        self._obstacle_edge[rows] = 0.0
        self._contact[rows] = False

    def place_obstacles(self, is_new: torch.Tensor, pose: torch.Tensor, edge: torch.Tensor) -> None:
        """Let static cubes appear on the floor.

        Args:
            is_new: Which obstacles appear now, bool, shape ``[N, M]``.
            pose: Their centres (x [m], y [m], yaw [rad]) in the world frame, shape ``[N, M, 3]``.
            edge: Their edges [m], shape ``[N, M]``.
        """
        self._obstacle_pose[...] = torch.where(is_new[..., None], pose, self._obstacle_pose)
        self._obstacle_edge[...] = torch.where(is_new, edge, self._obstacle_edge)

    def mass_matrix(self) -> torch.Tensor:
        """Return the joint-space inertia of every robot [kg, kg m^2], shape ``[N, J, J]``.

        The ticks after it move the robots with this inertia: it changes little within a policy step.
        """
        self._inertia[...] = self._dynamics.mass_matrix(self._position)
        return self._inertia

    def advance(self, law: TorqueLaw, ticks: int) -> None:
        """Run control and physics of one policy step.

        Args:
            law: Joint torques from joint states, called in every tick.
            ticks: Number of ticks.

        Raises:
            SimulationError: If a state is not finite.
        """
        if self._is_captured:
            if self._graph is None:
                self._graph = CudaGraph(lambda: self._run(law, ticks), [*self._state(), *law.state()])
            self._graph.replay()
        else:
            self._run(law, ticks)
        finite = self._velocity.isfinite().all(-1) & self._cube.twist.isfinite().all(-1)
        if not bool(finite.all()):
            msg = f"worlds {(~finite).nonzero().flatten().tolist()} have a state that is not finite"
            raise SimulationError(msg)

    def _state(self) -> tuple[torch.Tensor, ...]:
        """Return what a policy step changes."""
        return self._position, self._velocity, self._contact, self._cube.pose, self._cube.twist, *self._pushing.state()

    def _run(self, law: TorqueLaw, ticks: int) -> None:
        self._contact[...] = False
        # What cannot be inverted becomes a state that is not finite; to be told at once would wait for the device.
        self._inverse_inertia = geometry.inverse(self._inertia)
        for start in range(0, ticks, law.ik_ticks):
            law.solve_ik()
            self._robot.linearize(law.hand, self._position, self._inverse_inertia)
            for _ in range(min(law.ik_ticks, ticks - start)):
                self._tick(law)
            self._note_contacts()

    def _tick(self, law: TorqueLaw) -> None:
        torque = law.torques(self._position, self._velocity)
        free = self._velocity + self._period * geometry.matvec(self._inverse_inertia, torque)
        impulse = self._pushing.solve(self._cube, self._robot.pushers(self._position, free))
        pushed = free + geometry.matvec(self._inverse_inertia, self._robot.recoil(impulse))
        self._velocity[...] = self._robot.stopped(pushed, self._position, self._inverse_inertia, self._period)
        self._position += self._period * self._velocity
        # One pass over the stops leaves a residue where joints hit several at once: it must not add up.
        self._robot.clamp_(self._position)
        self._cube.pose += self._period * self._cube.twist

    def _note_contacts(self) -> None:
        """Note which of chassis, arm and cube overlap an obstacle."""
        poses, lengths, widths = self._robot.outlines(self._position)
        half = self._cube.edge[None] / 2
        poses = torch.cat([poses, self._cube_pose()[None]])[..., None, :]
        obstacle_half = self._obstacle_edge / 2
        touches = overlap(
            _rectangle(poses, torch.cat([lengths, half])[..., None], torch.cat([widths, half])[..., None]),
            _rectangle(self._obstacle_pose, obstacle_half, obstacle_half),
        )
        self._contact[:, self._robot.outlined] |= (touches & (self._obstacle_edge > 0)).any(-1).T

    def cast(self, rows: torch.Tensor, origin: torch.Tensor, ends: torch.Tensor, *, see_object: bool) -> torch.Tensor:
        """Cast rays against the squares that cube and obstacles are seen from above. Rays never see the robot.

        Args:
            rows: Indices of the worlds, shape ``[B]``.
            origin: Where the rays start, world frame [m], shape ``[B, 3]``.
            ends: Where they end, world frame [m], shape ``[B, R, 3]``.
            see_object: Whether rays hit the pushed object.

        Returns:
            Share of the ray that is free [1], 1 for a miss, shape ``[B, R]``.

        Raises:
            SimulationError: If a ray is not finite.
        """
        if not bool((origin.sum() + ends.sum()).isfinite()):  # one pass in place of three
            msg = "rays that are not finite; accepted: finite rays"
            raise SimulationError(msg)
        pose, edge = self._obstacle_pose[rows], self._obstacle_edge[rows]
        if see_object:
            pose = torch.cat([pose, self._cube_pose()[rows, None]], dim=1)
            edge = torch.cat([edge, self._cube.edge[rows, None]], dim=1)
        return free_share(origin[:, :2], ends[..., :2], pose, edge / 2)

    def _cube_pose(self) -> torch.Tensor:
        cube = self._cube
        return torch.cat([cube.pose[:, :2] - self._com_offset(), cube.pose[:, 2:]], dim=-1)

    def _com_offset(self) -> torch.Tensor:
        """Return the centre of mass from the cube's centre, world frame [m], shape ``[N, 2]``."""
        return geometry.rotate(self._cube.com_offset[:, :2], self._cube.pose[:, 2])

    def state(self) -> WorldState:
        """Return the state of every world, batch ``[N]``."""
        cube, pose = self._cube, self._cube_pose()
        height, still = (cube.edge / 2)[:, None], torch.zeros_like(pose)
        offset, turning = self._com_offset(), cube.twist[:, 2]
        velocity = cube.twist[:, :2] - torch.stack([-turning * offset[:, 1], turning * offset[:, 0]], dim=-1)
        return WorldState(
            base_pose=self._position[:, :3].clone(),
            base_velocity=self._velocity[:, :3].clone(),
            joint_position=self._position[:, 3:].clone(),
            joint_velocity=self._velocity[:, 3:].clone(),
            object_position=torch.cat([pose[:, :2], height], dim=-1),
            object_quaternion=geometry.quaternion_from_yaw(pose[:, 2]),
            object_velocity=torch.cat([velocity, still[:, :1]], dim=-1),
            object_angular_velocity=torch.cat([still[:, :2], turning[:, None]], dim=-1),
            contact=self._contact.clone(),
        )


def _rectangle(pose: torch.Tensor, half_length: torch.Tensor, half_width: torch.Tensor) -> Rectangle:
    x, y, yaw = pose.unbind(-1)
    return Rectangle(x, y, yaw.cos(), yaw.sin(), half_length, half_width)
