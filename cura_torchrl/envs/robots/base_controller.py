"""From policy action to the forces of a bare base: a velocity ramp, and the base's share of every robot's law.

All this is there twice: for all robots at once in tensors on any device, and compiled for one robot at a time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
import torch

from cura_torchrl.envs import geometry
from cura_torchrl.envs.robots import ridgeback as model
from cura_torchrl.envs.robots.ridgeback import BASE_DOF
from cura_torchrl.envs.robots.torque_kernel import torques_of_one
from cura_torchrl.envs.simulation.interface import HandLinearization

if TYPE_CHECKING:
    from cura_torchrl.envs.config import RobotConfig


class Kinematics(Protocol):
    """What knows where the TCP is; see :class:`cura_torchrl.envs.robots.kinematics.ArmKinematics`."""

    def forward(self, joint_position: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return TCP [m], rotation and Jacobian ``[N, 3]``, ``[N, 3, 3]``, ``[N, 6, A]`` of arm joints ``[N, A]``."""
        ...


class FaceKinematics:
    """Pose and Jacobian of the front face's centre in the base frame, whose axes the face has.

    Args:
        device: Where the tensors live; the CPU when None.

    Examples:
        >>> position, rotation, jacobian = FaceKinematics().forward(torch.zeros(2, 0, dtype=torch.float64))
        >>> position[0].tolist(), jacobian.shape
        ([0.48, 0.0, 0.18], torch.Size([2, 6, 0]))
    """

    def __init__(self, device: torch.device | None = None) -> None:
        self._face = torch.tensor(model.FACE, dtype=torch.float64, device=device)
        self._axes = torch.eye(3, dtype=torch.float64, device=device)

    def forward(self, joint_position: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return where the face is.

        Args:
            joint_position: Joints of no arm, shape ``[N, 0]``.

        Returns:
            Centre of the face [m], shape ``[N, 3]``; its rotation matrix, shape ``[N, 3, 3]``; the Jacobian, shape
            ``[N, 6, 0]``; all in the base frame.
        """
        rows = len(joint_position)
        return self._face.expand(rows, 3), self._axes.expand(rows, 3, 3), joint_position.new_zeros(rows, 6, 0)


class BaseController:
    """Forces of N bases without an arm. State: the velocity command of each.

    A robot that carries more on its base adds its joints' columns to the constants and its posture to the state.

    Args:
        num_worlds: Number of robots N.
        robot: Limits and gains.
        period: Time between two ticks [s].
        device: Where the tensors live; the CPU when None.
    """

    inertia: ClassVar[tuple[float, float, float]] = (model.BASE_MASS, model.BASE_MASS, model.BASE_YAW_INERTIA)
    """What the base's joints move [kg, kg, kg m^2]."""

    def __init__(self, num_worlds: int, robot: RobotConfig, period: float, device: torch.device | None = None) -> None:
        self.config = robot
        self.period = period
        self.ik_ticks = max(1, round(1.0 / (robot.ik_rate * self.period)))
        self._device = device
        self.kinematics: Kinematics = self._make_kinematics()
        self._constants = self._tensor(self._columns(robot))
        self._speed_bound = robot.max_base_speed**2 * (1.0 + 1e-9)  # the margin is for rounding
        # The base's velocity command and the arm's reference; then where the base heads, and the reference's rate.
        joints = self._constants.shape[1]
        self._motion = self._constants.new_zeros(num_worlds, 2, joints)
        self.base_command, self._base_target = self._motion[:, 0, :BASE_DOF], self._motion[:, 1, :BASE_DOF]
        self._gain = self._motion.new_zeros(num_worlds, joints, joints)
        posture = self._motion[:1, 0, BASE_DOF:]
        self.hand = HandLinearization(*self.kinematics.forward(posture), reference=posture)
        if self._motion.device.type == "cpu":
            self._torque = np.zeros(joints)
            for_tick = (part.numpy() for part in (self._motion, self._gain, self._constants))
            self._tick_parts: tuple[Any, ...] = (*for_tick, self.period, self._speed_bound, self._torque)

    def _make_kinematics(self) -> Kinematics:
        return FaceKinematics(self._device)

    def _tensor(self, values: Any) -> torch.Tensor:
        return torch.as_tensor(values, dtype=torch.float64, device=self._device)

    def _columns(self, robot: RobotConfig) -> list[list[float]]:
        """Return the constants of the law as :func:`.torque_kernel.torques_of_one` takes them; columns are joints."""
        unused = [0.0] * BASE_DOF
        damping = [mass / robot.base_time_constant for mass in self.inertia]
        ramp = [self.period * robot.max_base_acceleration] * 2 + [self.period * robot.max_base_yaw_acceleration]
        return [unused, damping, unused, unused, unused, ramp]

    def reset(self, rows: torch.Tensor, height_limit: torch.Tensor) -> None:  # noqa: ARG002 - the chassis has one height
        """Put robots at rest.

        Args:
            rows: Indices of the robots, shape ``[B]``.
            height_limit: Highest point of pushing that does not tip the object [m], shape ``[B]``.
        """
        self.base_command[rows] = 0.0

    def state(self) -> tuple[torch.Tensor, ...]:
        """Return what a policy step changes, in place: the motion of base and joints."""
        return (self._motion,)

    def command(self, action: torch.Tensor, object_xy_b: torch.Tensor, mass_matrix: torch.Tensor) -> None:  # noqa: ARG002
        """Take the action of a policy step.

        Args:
            action: Base (vx, vy, wz) as shares of their maxima, shape ``[N, 3]``.
            object_xy_b: Object's centre in the base frame, which a face cannot turn to [m], shape ``[N, 2]``.
            mass_matrix: Joint-space inertia, kept for the policy step [kg, kg m^2], shape ``[N, J, J]``.
        """
        self._command_base(action.double().clamp(-1.0, 1.0), mass_matrix)

    def _command_base(self, shares: torch.Tensor, mass_matrix: torch.Tensor) -> None:
        config = self.config
        planar = shares[:, :2] / geometry.norm(shares[:, :2]).clamp_min(1.0)[:, None] * config.max_base_speed
        turn = shares[:, 2:3] * config.max_base_yaw_rate
        self._base_target[...] = torch.cat([planar, turn], dim=-1)
        # tau = M (M + D dt + K dt^2)^-1 (...): the implicit (stable) form of the impedance law.
        stiffness, damping = self._constants[:2]
        implicit = mass_matrix + torch.diag(damping * self.period + stiffness * self.period**2)
        self._gain[...] = geometry.matvec(geometry.inverse(implicit)[:, None], mass_matrix)  # the inverse is symmetric

    def torques(self, position: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        """Return the joint forces of one tick.

        Args:
            position: Joints (base x [m], y [m], yaw [rad]), shape ``[N, 3]``.
            velocity: Their velocities, shape ``[N, 3]``.

        Returns:
            Forces and torque [N, N, N m], shape ``[N, 3]``.

        Source:
            Tan, Liu and Turk (2011), "Stable proportional-derivative controllers", eq. (11), without a spring.
        """
        return geometry.matvec(self._gain, self._base_force(position, velocity))

    def torques_of(self, world: int, joints: np.ndarray) -> list[float]:
        """Return what :meth:`torques` does, for one robot on the CPU: quicker than operations on a batch of one.

        Args:
            world: Which robot.
            joints: Its joints' positions, then velocities, shape ``[2, J]``.

        Returns:
            Forces and torques [N, N, N m, N m ...], one a joint.
        """
        torques_of_one(world, joints, *self._tick_parts)
        torque: list[float] = self._torque.tolist()
        return torque

    def _base_force(self, position: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        """Move the base's command on by one tick.

        Returns:
            The servo's force before the implicit gain, shape ``[N, 3]``.
        """
        self.base_command += self._ramp_step(self.base_command, self._base_target)
        return self._constants[1, :BASE_DOF] * (
            self._to_world(self.base_command, position[:, 2]) - velocity[:, :BASE_DOF]
        )

    def _ramp_step(self, command: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return the change of the base's velocity command in one tick, within the acceleration of each axis."""
        limit, ramp = self._constants[5, :BASE_DOF], target - command
        step = torch.minimum(torch.maximum(ramp, -limit), limit)
        after = command[:, :2] + step[:, :2]
        is_fast = after[:, 0] ** 2 + after[:, 1] ** 2 > self._speed_bound
        # Axis by axis the way between two points of the disc of speeds may lead out of it; straight it cannot.
        slowest = (ramp[:, :2].abs() / limit[:2]).amax(1, keepdim=True).clamp_min(1.0)
        step[:, :2] = torch.where(is_fast[:, None], ramp[:, :2] / slowest, step[:, :2])
        return step

    def _to_world(self, twist: torch.Tensor, yaw: torch.Tensor) -> torch.Tensor:
        return torch.cat([geometry.rotate(twist[:, :2], yaw), twist[:, 2:]], dim=-1)

    def solve_ik(self) -> None:
        """Plan nothing: there are no joints to find."""

    def solve_ik_of(self, world: int) -> None:
        """Plan nothing.

        Args:
            world: Which robot.
        """
