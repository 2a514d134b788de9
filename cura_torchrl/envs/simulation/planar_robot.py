"""The robot as planar worlds see it: rectangles that push, and outlines that must touch no obstacle."""

from __future__ import annotations

import torch

from cura_torchrl.envs import geometry
from cura_torchrl.envs.simulation.contact import Rectangle
from cura_torchrl.envs.simulation.interface import ArmShape, HandLinearization, RobotShape
from cura_torchrl.envs.simulation.pushing import Pushers

BASE_DOF = 3
"""The base's joints (x, y, yaw), which come first."""


class PlanarRobot:
    """N robots, here a chassis alone that pushes with its faces. Nothing of it is state: ticks only read it.

    Args:
        shape: The robot seen from above.
        num_worlds: Number of robots N.
        device: Where the tensors live.
    """

    def __init__(self, shape: RobotShape, num_worlds: int, device: torch.device | None = None) -> None:
        sizes, arm_dof = [shape.chassis_size], 0
        if shape.arm is not None:
            sizes, arm_dof = [shape.arm.hand_size, *sizes], len(shape.arm.joint_lower)
        self.dof, self.num_pushers = BASE_DOF + arm_dof, len(sizes)
        self._chassis_height = shape.chassis_height

        def zeros(*size: int) -> torch.Tensor:
            return torch.zeros(num_worlds, *size, dtype=torch.float64, device=device)

        self._half = torch.tensor(sizes, dtype=torch.float64, device=device) / 2
        self._jacobian = zeros(self.num_pushers, 4, self.dof)
        self._jacobian[:, :, [0, 1, 3], [0, 1, 2]] = 1.0  # every pusher moves as the base does
        self._flat_jacobian = zeros(4 * self.num_pushers, self.dof)
        self._mobility = torch.zeros(4, 4, self.num_pushers, num_worlds, dtype=torch.float64, device=device)

    @property
    def outlined(self) -> slice:
        """Which of (base, arm, object) :meth:`outlines` and the object are, in the order of contact flags."""
        return slice(0, 3, 2)

    def linearize(self, hand: HandLinearization, position: torch.Tensor, inverse_inertia: torch.Tensor) -> None:  # noqa: ARG002
        """Take over how the pushers answer to impulses until the next IK solution.

        Args:
            hand: Where the hand is and how it moves.
            position: Joints, base first [m, rad], shape ``[N, J]``.
            inverse_inertia: Inverse of the joint-space inertia, shape ``[N, J, J]``.
        """
        answer = geometry.matvec(inverse_inertia[:, None, None], self._jacobian)
        mobility = geometry.matvec(self._jacobian[:, :, None], answer)  # J M^-1 J^T
        self._mobility = mobility.permute(2, 3, 1, 0).contiguous()
        self._flat_jacobian = self._jacobian.flatten(1, 2)

    def pushers(self, position: torch.Tensor, velocity: torch.Tensor) -> Pushers:
        """Return what pushes, with the twists of some joint velocity.

        Args:
            position: Joints, base first [m, rad], shape ``[N, J]``.
            velocity: Their velocities, shape ``[N, J]``.

        Returns:
            B pushers in each world.
        """
        x, y, yaw = (part[None] for part in position[:, :BASE_DOF].unbind(-1))
        length, width = self._half.T[..., None].expand(2, 1, len(position))
        return Pushers(
            rectangle=Rectangle(x, y, yaw.cos(), yaw.sin(), length, width),
            height=torch.full_like(yaw, self._chassis_height),
            anchor=(x, y),
            twist=self._twist(velocity),
            mobility=self._mobility,
        )

    def _twist(self, velocity: torch.Tensor) -> torch.Tensor:
        twist = geometry.matvec(self._flat_jacobian, velocity).view(len(velocity), self.num_pushers, 4)
        return twist.permute(2, 1, 0).contiguous()

    def recoil(self, impulse: torch.Tensor) -> torch.Tensor:
        """Return joint impulses of impulses on the pushers.

        Args:
            impulse: Impulses at their anchors (x, y, z [N s], yaw [N m s]), shape ``[4, B, N]``.

        Returns:
            Impulses [N s, N m s], shape ``[N, J]``.
        """
        wrench = impulse.permute(2, 1, 0).reshape(impulse.shape[-1], -1)
        return geometry.matvec(self._flat_jacobian.mT, wrench)

    def stopped(
        self,
        velocity: torch.Tensor,
        position: torch.Tensor,  # noqa: ARG002 - a base has no stops
        inverse_inertia: torch.Tensor,  # noqa: ARG002
        period: float,  # noqa: ARG002
    ) -> torch.Tensor:
        """Return joint velocities that lead no joint past its stops.

        Args:
            velocity: Joint velocities, shape ``[N, J]``.
            position: Joints [m, rad], shape ``[N, J]``.
            inverse_inertia: Inverse of the joint-space inertia, shape ``[N, J, J]``.
            period: Time of a tick [s].

        Returns:
            Velocities, shape ``[N, J]``.
        """
        return velocity

    def clamp_(self, position: torch.Tensor) -> None:
        """Put joints back that are past their stops.

        Args:
            position: Joints [m, rad], shape ``[N, J]``; changed in place.
        """

    def outlines(self, position: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the K rectangles that the robot is seen as from above.

        Args:
            position: Joints, base first [m, rad], shape ``[N, J]``.

        Returns:
            Poses (x [m], y [m], yaw [rad]), shape ``[K, N, 3]``; half lengths and half widths [m], shape ``[K, N]``.
        """
        base = position[:, :BASE_DOF]
        length, width = self._half[-1].expand(len(base), 2).T
        return base[None], length[None], width[None]


class PlanarArmRobot(PlanarRobot):
    """N robots whose hand pushes too, before the chassis.

    Args:
        shape: The robot seen from above.
        arm: Its arm.
        num_worlds: Number of robots N.
        device: Where the tensors live.
    """

    def __init__(self, shape: RobotShape, arm: ArmShape, num_worlds: int, device: torch.device | None = None) -> None:
        super().__init__(shape, num_worlds, device)
        self._arm = arm
        stops = torch.tensor([arm.joint_lower, arm.joint_upper], dtype=torch.float64, device=device)
        self._lower, self._upper = stops[..., None]

        def zeros(*size: int) -> torch.Tensor:
            return torch.zeros(num_worlds, *size, dtype=torch.float64, device=device)

        joints = len(arm.joint_lower)
        self._hand = HandLinearization(zeros(3), zeros(3, 3), zeros(6, joints), reference=zeros(joints))
        self._hand_yaw, self._hand_front, self._hand_jacobian = zeros(), zeros(), zeros(4, joints)

    @property
    def outlined(self) -> slice:
        """All three."""
        return slice(None)

    def linearize(self, hand: HandLinearization, position: torch.Tensor, inverse_inertia: torch.Tensor) -> None:
        """Take over where the hand is and how it moves until the next IK solution.

        Args:
            hand: The hand.
            position: Joints, base first [m, rad], shape ``[N, J]``.
            inverse_inertia: Inverse of the joint-space inertia, shape ``[N, J, J]``.
        """
        self._hand = hand
        axis = hand.rotation[..., 2]
        along, across = self._arm.hand_front
        self._hand_yaw = geometry.angle_of(axis[:, :2])
        self._hand_front = along * geometry.norm(axis[:, :2]) - across * axis[:, 2]
        yaw = position[:, 2]
        reach = geometry.rotate(hand.tcp[:, :2], yaw)
        own = self._jacobian[:, 0]
        own[:, 0, 2], own[:, 1, 2] = -reach[:, 1], reach[:, 0]
        own[:, :2, 3:] = geometry.rotate(hand.jacobian[:, :2].mT, yaw[:, None]).mT
        own[:, 2, 3:], own[:, 3, 3:] = hand.jacobian[:, 2], hand.jacobian[:, 5]
        self._hand_jacobian = torch.cat([hand.jacobian[:, :3], hand.jacobian[:, 5:]], dim=1)
        super().linearize(hand, position, inverse_inertia)

    def _hand_pose(self, position: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the TCP in the world [m] ``[N, 3]``, and the yaw of the hand's axis in the world [rad] ``[N]``."""
        hand = self._hand
        change = position[:, 3:] - hand.reference
        moved = geometry.matvec(self._hand_jacobian, change)
        tcp = hand.tcp + moved[:, :3]
        base = position[:, :3]
        level = geometry.from_frame(base, tcp[:, :2])
        return torch.cat([level, tcp[:, 2:]], dim=-1), base[:, 2] + self._hand_yaw + moved[:, 3]

    def pushers(self, position: torch.Tensor, velocity: torch.Tensor) -> Pushers:
        """Return hand and chassis as they are, with the twists of some joint velocity.

        Args:
            position: Joints, base first [m, rad], shape ``[N, J]``.
            velocity: Their velocities, shape ``[N, J]``.

        Returns:
            Two pushers in each world.
        """
        tcp, yaw = self._hand_pose(position)
        base = position[:, :3]
        heading = torch.stack([yaw, base[:, 2]])
        cos, sin = heading.cos(), heading.sin()
        anchor = torch.stack([tcp[:, :2], base[:, :2]]).permute(2, 0, 1)
        ahead = torch.stack([self._hand_front - self._half[0, 0], torch.zeros_like(yaw)])
        length, width = self._half.T[..., None].expand(2, 2, len(yaw))
        return Pushers(
            rectangle=Rectangle(anchor[0] + ahead * cos, anchor[1] + ahead * sin, cos, sin, length, width),
            height=torch.stack([tcp[:, 2], torch.full_like(yaw, self._chassis_height)]),
            anchor=(anchor[0], anchor[1]),
            twist=self._twist(velocity),
            mobility=self._mobility,
        )

    def stopped(
        self, velocity: torch.Tensor, position: torch.Tensor, inverse_inertia: torch.Tensor, period: float
    ) -> torch.Tensor:
        """Return joint velocities that lead no joint of the arm past its stops, by one impulse after the other.

        Args:
            velocity: Joint velocities, shape ``[N, J]``.
            position: Joints [m, rad], shape ``[N, J]``.
            inverse_inertia: Inverse of the joint-space inertia, shape ``[N, J, J]``.
            period: Time of a tick [s].

        Returns:
            Velocities, shape ``[N, J]``.
        """
        position = position.T
        answers = inverse_inertia.permute(2, 1, 0)
        velocity = velocity.T
        for joint, (lower, upper) in enumerate(zip(self._lower, self._upper, strict=True), start=BASE_DOF):
            own, least = velocity[joint], (lower - position[joint]) / period
            allowed = torch.minimum(torch.maximum(own, least), (upper - position[joint]) / period)
            velocity = velocity + answers[joint] * ((allowed - own) / answers[joint, joint])
        return velocity.T

    def clamp_(self, position: torch.Tensor) -> None:
        """Put joints of the arm back that are past their stops.

        Args:
            position: Joints [m, rad], shape ``[N, J]``; changed in place.
        """
        position[:, BASE_DOF:].clamp_(self._lower[:, 0], self._upper[:, 0])

    def outlines(self, position: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return chassis and arm from above.

        Args:
            position: Joints, base first [m, rad], shape ``[N, J]``.

        Returns:
            Poses (x [m], y [m], yaw [rad]), shape ``[2, N, 3]``; half lengths and half widths [m], shape ``[2, N]``.
        """
        tcp, yaw = self._hand_pose(position)
        base = position[:, :BASE_DOF]
        tip = tcp[:, :2] + self._hand_front[:, None] * torch.stack([yaw.cos(), yaw.sin()], dim=-1)
        front = base[:, :2] + self._half[1, 0] * torch.stack([base[:, 2].cos(), base[:, 2].sin()], dim=-1)
        arm = tip - front
        arm_pose = torch.cat([(front + tip) / 2, geometry.angle_of(arm)[:, None]], dim=-1)
        length, width = self._half[1].expand(len(base), 2).T
        arm_width = torch.full_like(yaw, self._arm.half_width)
        return (
            torch.stack([base, arm_pose]),
            torch.stack([length, geometry.norm(arm) / 2]),
            torch.stack([width, arm_width]),
        )


def planar_robot(shape: RobotShape, num_worlds: int, device: torch.device | None = None) -> PlanarRobot:
    """Return the robot of a shape, with its hand if it has one.

    Args:
        shape: The robot seen from above.
        num_worlds: Number of robots N.
        device: Where the tensors live.

    Returns:
        N robots.
    """
    if shape.arm is None:
        return PlanarRobot(shape, num_worlds, device)
    return PlanarArmRobot(shape, shape.arm, num_worlds, device)
