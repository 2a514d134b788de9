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
from cura_torchrl.envs.simulation.interface import HandLinearization, SimulationError, WorldState
from cura_torchrl.envs.simulation.pushing import Cube, PushContact, Pushers
from cura_torchrl.envs.simulation.rays import free_share

if TYPE_CHECKING:
    from cura_torchrl.envs.config import PhysicsConfig
    from cura_torchrl.envs.simulation.interface import RobotShape, SceneState, TorqueLaw


_ARM = slice(3, 10)
"""The arm's joints; the base's come first."""


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
        self._dynamics, self._shape, self._period = dynamics, shape, physics.planar_period

        def zeros(*size: int) -> torch.Tensor:
            return torch.zeros(num_worlds, *size, dtype=torch.float64, device=device)

        self._position, self._velocity = zeros(10), zeros(10)
        self._graph: CudaGraph | None = None
        self._is_captured = physics.planar_graph and self._position.device.type == "cuda"
        self._inertia = torch.eye(10, dtype=torch.float64, device=device).repeat(num_worlds, 1, 1)
        self._inverse_inertia = zeros(10, 10)
        self._cube = Cube(zeros(3), zeros(3), zeros() + 1.0, zeros() + 1.0, zeros() + 1.0, zeros(3))
        self._pushing = PushContact(num_worlds, 2, physics, device)
        self._half = torch.tensor([shape.hand_size, shape.chassis_size], dtype=torch.float64, device=device) / 2
        stops = torch.tensor([shape.joint_lower, shape.joint_upper], dtype=torch.float64, device=device)
        self._lower, self._upper = stops[..., None]
        self._obstacle_pose, self._obstacle_edge = zeros(0, 3), zeros(0)
        self._contact = torch.zeros(num_worlds, 3, dtype=torch.bool, device=device)
        self._jacobian = zeros(2, 4, 10)
        self._jacobian[:, :, [0, 1, 3], [0, 1, 2]] = 1.0  # hand and chassis move as the base does
        self._flat_jacobian, self._mobility = zeros(8, 10), zeros(4, 4, 2)
        self._hand = HandLinearization(zeros(3), zeros(3, 3), zeros(6, 7), reference=zeros(7))
        self._hand_yaw, self._hand_front, self._hand_jacobian = zeros(), zeros(), zeros(4, 7)

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
        self._inverse_inertia = torch.linalg.inv_ex(self._inertia).inverse
        for start in range(0, ticks, law.ik_ticks):
            law.solve_ik()
            self._linearize(law.hand)
            for _ in range(min(law.ik_ticks, ticks - start)):
                self._tick(law)
            self._note_contacts()

    def _linearize(self, hand: HandLinearization) -> None:
        """Take over where the hand is and how it moves until the next IK solution."""
        self._hand = hand
        axis = hand.rotation[..., 2]
        along, across = self._shape.hand_front
        self._hand_yaw = geometry.angle_of(axis[:, :2])
        self._hand_front = along * geometry.norm(axis[:, :2]) - across * axis[:, 2]
        yaw = self._position[:, 2]
        reach = geometry.rotate(hand.tcp[:, :2], yaw)
        own = self._jacobian[:, 0]
        own[:, 0, 2], own[:, 1, 2] = -reach[:, 1], reach[:, 0]
        own[:, :2, 3:] = geometry.rotate(hand.jacobian[:, :2].mT, yaw[:, None]).mT
        own[:, 2, 3:], own[:, 3, 3:] = hand.jacobian[:, 2], hand.jacobian[:, 5]
        self._hand_jacobian = torch.cat([hand.jacobian[:, :3], hand.jacobian[:, 5:]], dim=1)
        mobility = self._jacobian @ self._inverse_inertia[:, None] @ self._jacobian.mT
        self._mobility = mobility.permute(2, 3, 1, 0).contiguous()
        self._flat_jacobian = self._jacobian.flatten(1, 2)

    def _tick(self, law: TorqueLaw) -> None:
        torque = law.torques(self._position, self._velocity)
        free = self._velocity + self._period * geometry.matvec(self._inverse_inertia, torque)
        impulse = self._pushing.solve(self._cube, self._pushers(free))
        recoil = geometry.matvec(self._flat_jacobian.mT, impulse.permute(2, 1, 0).reshape(len(free), -1))
        self._velocity[...] = self._stopped(free + geometry.matvec(self._inverse_inertia, recoil))
        self._position += self._period * self._velocity
        # One pass over the stops leaves a residue where joints hit several at once: it must not add up.
        self._position[:, _ARM].clamp_(self._lower[:, 0], self._upper[:, 0])
        self._cube.pose += self._period * self._cube.twist

    def _stopped(self, velocity: torch.Tensor) -> torch.Tensor:
        """Return joint velocities that lead no joint of the arm past its stops, by one impulse after the other."""
        position = self._position.T
        answers = self._inverse_inertia.permute(2, 1, 0)
        velocity = velocity.T
        for joint, (lower, upper) in enumerate(zip(self._lower, self._upper, strict=True), start=_ARM.start):
            own, least = velocity[joint], (lower - position[joint]) / self._period
            allowed = torch.minimum(torch.maximum(own, least), (upper - position[joint]) / self._period)
            velocity = velocity + answers[joint] * ((allowed - own) / answers[joint, joint])
        return velocity.T

    def _hand_pose(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the TCP in the world [m] ``[N, 3]``, and the yaw of the hand's axis in the world [rad] ``[N]``."""
        hand = self._hand
        change = self._position[:, 3:] - hand.reference
        moved = geometry.matvec(self._hand_jacobian, change)
        tcp = hand.tcp + moved[:, :3]
        base = self._position[:, :3]
        level = geometry.from_frame(base, tcp[:, :2])
        return torch.cat([level, tcp[:, 2:]], dim=-1), base[:, 2] + self._hand_yaw + moved[:, 3]

    def _pushers(self, velocity: torch.Tensor) -> Pushers:
        """Return hand and chassis as they are, with the twists of some joint velocity."""
        tcp, yaw = self._hand_pose()
        base = self._position[:, :3]
        heading = torch.stack([yaw, base[:, 2]])
        cos, sin = heading.cos(), heading.sin()
        anchor = torch.stack([tcp[:, :2], base[:, :2]]).permute(2, 0, 1)
        ahead = torch.stack([self._hand_front - self._half[0, 0], torch.zeros_like(yaw)])
        length, width = self._half.T[..., None].expand(2, 2, len(yaw))
        twist = geometry.matvec(self._flat_jacobian, velocity).view(len(yaw), 2, 4)
        return Pushers(
            rectangle=Rectangle(anchor[0] + ahead * cos, anchor[1] + ahead * sin, cos, sin, length, width),
            height=torch.stack([tcp[:, 2], torch.full_like(yaw, self._shape.chassis_height)]),
            anchor=(anchor[0], anchor[1]),
            twist=twist.permute(2, 1, 0).contiguous(),
            mobility=self._mobility,
        )

    def _note_contacts(self) -> None:
        """Note which of chassis, arm and cube overlap an obstacle."""
        tcp, yaw = self._hand_pose()
        base, shape = self._position[:, :3], self._shape
        tip = tcp[:, :2] + self._hand_front[:, None] * torch.stack([yaw.cos(), yaw.sin()], dim=-1)
        front = base[:, :2] + self._half[1, 0] * torch.stack([base[:, 2].cos(), base[:, 2].sin()], dim=-1)
        arm = tip - front
        arm_pose = torch.cat([(front + tip) / 2, geometry.angle_of(arm)[:, None]], dim=-1)
        poses = torch.stack([base, arm_pose, self._cube_pose()])[..., None, :]
        length, width = self._half[1].expand(len(base), 2).T
        arm_width = torch.full_like(yaw, shape.arm_half_width)
        half = self._cube.edge / 2
        halves = torch.stack(
            [torch.stack([length, geometry.norm(arm) / 2, half]), torch.stack([width, arm_width, half])]
        )
        obstacle_half = self._obstacle_edge / 2
        touches = overlap(
            _rectangle(poses, halves[0, ..., None], halves[1, ..., None]),
            _rectangle(self._obstacle_pose, obstacle_half, obstacle_half),
        )
        self._contact |= (touches & (self._obstacle_edge > 0)).any(-1).T

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
