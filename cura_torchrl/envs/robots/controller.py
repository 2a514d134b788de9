"""From policy action to joint torques: velocity ramps, differential IK on the joint reference, 200 Hz joint impedance.

The reference lives in joint space and integrates the commanded end-effector velocity. Where it may be is bounded by the
TCP's workspace, by the joint limits, and by the torque that it can ask for.

All this is there twice: for all robots at once in tensors on any device, and compiled for one robot at a time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from cura_torchrl.envs import geometry
from cura_torchrl.envs.robots import ridgeback_franka as model
from cura_torchrl.envs.robots.ik_kernel import Follow, rates_of_one
from cura_torchrl.envs.robots.kinematics import ArmKinematics, damped_least_squares
from cura_torchrl.envs.robots.ridgeback_franka import BASE_DOF, DOF
from cura_torchrl.envs.robots.torque_kernel import torques_of_one
from cura_torchrl.envs.simulation.interface import HandLinearization

if TYPE_CHECKING:
    from cura_torchrl.envs.config import RobotConfig


class ImpedanceController:
    """Joint references and torques of N robots. State: base velocity command and joint reference of each.

    Args:
        num_worlds: Number of robots N.
        robot: Limits and gains.
        period: Time between two ticks [s].
        device: Where the tensors live; the CPU when None.
    """

    def __init__(
        self,
        num_worlds: int,
        robot: RobotConfig,
        period: float,
        device: torch.device | None = None,
    ) -> None:
        self.config = robot
        self.kinematics = ArmKinematics(device)
        self.period = period
        self.ik_ticks = max(1, round(1.0 / (robot.ik_rate * self.period)))

        def tensor(values: Any) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float64, device=device)

        self._postures = tensor([model.HOME, model.VELOCITY_LIMIT])
        self._home, self._speed = self._postures
        mass = (model.BASE_MASS, model.BASE_MASS, model.BASE_YAW_INERTIA)
        ramp = [period * robot.max_base_acceleration] * 2 + [period * robot.max_base_yaw_acceleration]
        unused = [0.0] * BASE_DOF
        # One array, as each more costs the compiled law a tenth of a microsecond a tick; columns are joints.
        self._constants = tensor(
            [
                [*unused, *robot.stiffness],
                [*(m / robot.base_time_constant for m in mass), *robot.damping],
                [*unused, *model.TORQUE_LIMIT],
                [*unused, *model.JOINT_LOWER],
                [*unused, *model.JOINT_UPPER],
                [*ramp, *[0.0] * len(model.ARM_JOINTS)],
            ]
        )
        stiffness, damping, limit = self._constants[:3, BASE_DOF:]
        # The spring, less what the damper takes, may ask for no more than the joint has: else the reference runs away.
        self._reach, self._lag = limit / stiffness, damping / stiffness
        self._speed_bound = robot.max_base_speed**2 * (1.0 + 1e-9)  # the margin is for rounding
        workspace = tensor([robot.workspace_x, robot.workspace_y, robot.workspace_z]).expand(num_worlds, 3, 2)
        self._workspace = workspace.clone()
        self.tcp_reference = tensor(model.HOME_TCP).expand(num_worlds, 3).clone()
        # What the hand is to do: the TCP's velocity, and the object's centre in the base frame.
        self._aims = tensor([[0.0, 0.0, 0.0, 2.0, 0.0]] * num_worlds)
        self._tcp_target, self._object_xy_b = self._aims[:, :3], self._aims[:, 3:]
        # The base's velocity command and the arm's reference; then where the base heads, and the reference's rate.
        self._motion = tensor([[[0.0] * BASE_DOF + list(model.HOME), [0.0] * DOF]] * num_worlds)
        self.base_command, self.reference = self._motion[:, 0, :BASE_DOF], self._motion[:, 0, BASE_DOF:]
        self._base_target, self._rate = self._motion[:, 1, :BASE_DOF], self._motion[:, 1, BASE_DOF:]
        self._gain = self._motion.new_zeros(num_worlds, DOF, DOF)
        self.hand = HandLinearization(*self.kinematics.forward(self._home[None]), reference=self._home[None])
        if self._motion.device.type == "cpu":
            self._compile(robot)

    def _compile(self, robot: RobotConfig) -> None:
        """Gather what the compiled forms work on: the tensors' memory as arrays."""
        self._torque = np.zeros(DOF)
        for_tick = (part.numpy() for part in (self._motion, self._gain, self._constants))
        self._tick_parts: tuple[Any, ...] = (*for_tick, self.period, self._speed_bound, self._torque)
        hand = (self.tcp_reference, self._aims, self._workspace)
        for_ik = (self._motion, *hand, self.kinematics.offsets, self._postures)
        names = [name for name in Follow._fields if name != "horizon"]
        follow = Follow(self.ik_ticks * self.period, **{name: getattr(robot, name) for name in names})
        self._ik_parts: tuple[Any, ...] = (*(part.numpy() for part in for_ik), follow)

    def reset(self, rows: torch.Tensor, height_limit: torch.Tensor) -> None:
        """Put robots at rest in the home posture.

        Args:
            rows: Indices of the robots, shape ``[B]``.
            height_limit: Highest TCP reference that does not tip the object [m], shape ``[B]``.
        """
        self.reference[rows] = self._home
        self.base_command[rows] = 0.0
        self.tcp_reference[rows] = self.tcp_reference.new_tensor(model.HOME_TCP)
        self._workspace[rows, 2, 1] = height_limit.to(self._workspace).clamp_max(self.config.workspace_z[1])

    def state(self) -> tuple[torch.Tensor, ...]:
        """Return what a policy step changes, in place: the motion of base and joints, and the TCP's reference."""
        return self._motion, self.tcp_reference

    def command(self, action: torch.Tensor, object_xy_b: torch.Tensor, mass_matrix: torch.Tensor) -> None:
        """Take the action of a policy step.

        Args:
            action: Base (vx, vy, wz) and end-effector (vx, vy, vz) as shares of their maxima, shape ``[N, 6]``.
            object_xy_b: Object's centre in the base frame, which the hand turns to [m], shape ``[N, 2]``.
            mass_matrix: Joint-space inertia, kept for the policy step [kg, kg m^2], shape ``[N, 10, 10]``.
        """
        config = self.config
        shares = action.double().clamp(-1.0, 1.0)
        planar = shares[:, :2] / geometry.norm(shares[:, :2]).clamp_min(1.0)[:, None] * config.max_base_speed
        turn = shares[:, 2:3] * config.max_base_yaw_rate
        self._base_target[...] = torch.cat([planar, turn], dim=-1)
        self._tcp_target[...] = shares[:, 3:6] * config.max_tcp_speed
        self._object_xy_b[...] = object_xy_b
        # tau = M (M + D dt + K dt^2)^-1 (...): the implicit (stable) form of the impedance law.
        stiffness, damping = self._constants[:2]
        implicit = mass_matrix + torch.diag(damping * self.period + stiffness * self.period**2)
        self._gain[...] = mass_matrix @ torch.linalg.inv_ex(implicit).inverse

    def torques(self, position: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        """Return the joint torques of one tick; :meth:`solve_ik` sets where the robots head.

        Args:
            position: Joints (base x [m], y [m], yaw [rad], arm [rad]), shape ``[N, 10]``.
            velocity: Their velocities, shape ``[N, 10]``.

        Returns:
            Forces and torques [N, N, N m, N m ...], shape ``[N, 10]``.

        Source:
            Tan, Liu and Turk (2011), "Stable proportional-derivative controllers", eq. (11).
        """
        stiffness, damping, limit, lower, upper, _ = self._constants[:, BASE_DOF:]
        arm_position, arm_velocity = position[:, BASE_DOF:], velocity[:, BASE_DOF:]
        centre, reach = arm_position + self._lag * arm_velocity, self._reach
        reference = self.reference + self._rate * self.period
        reference = torch.maximum(torch.maximum(reference, lower), centre - reach)
        reference = torch.minimum(torch.minimum(reference, upper), centre + reach)
        self.reference[...] = reference
        self.base_command += self._ramp_step(self.base_command, self._base_target)
        base_force = self._constants[1, :BASE_DOF] * (
            self._to_world(self.base_command, position[:, 2]) - velocity[:, :BASE_DOF]
        )
        error = reference - arm_position - self.period * arm_velocity
        force = torch.cat([base_force, stiffness * error - damping * arm_velocity], dim=-1)
        torque = geometry.matvec(self._gain, force)
        arm = torque[:, BASE_DOF:]
        torch.minimum(torch.maximum(arm, -limit, out=arm), limit, out=arm)
        return torque

    def torques_of(self, world: int, joints: np.ndarray) -> list[float]:
        """Return what :meth:`torques` does, for one robot on the CPU: quicker than operations on a batch of one.

        Args:
            world: Which robot.
            joints: Its joints' positions, then velocities, shape ``[2, 10]``.

        Returns:
            Forces and torques [N, N, N m, N m ...], one a joint.
        """
        torques_of_one(world, joints, *self._tick_parts)
        torque: list[float] = self._torque.tolist()
        return torque

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
        """Set the rate of every joint reference from the commanded twist; due every ``ik_ticks`` ticks."""
        reference = self.reference.clone()
        tcp, rotation, jacobian = self.kinematics.forward(reference)
        self.hand = HandLinearization(tcp, rotation, jacobian, reference=reference)
        twist = torch.cat([self._linear(tcp), self._angular(tcp, rotation)], dim=-1)
        rate, free = damped_least_squares(jacobian, twist, self.config.ik_damping)
        posture = self.config.posture_gain * (self._home - reference)
        rate = rate + geometry.matvec(free, posture)
        self._rate[...] = torch.maximum(torch.minimum(rate, self._speed), -self._speed)

    def solve_ik_of(self, world: int) -> None:
        """Do what :meth:`solve_ik` does but for :attr:`hand`, for one robot on the CPU.

        Args:
            world: Which robot.
        """
        rates_of_one(world, *self._ik_parts)

    def _linear(self, at: torch.Tensor) -> torch.Tensor:
        """Return the velocity that moves the TCP's reference as commanded, and follows it [m/s]."""
        config, horizon = self.config, self.ik_ticks * self.period
        before, bounds = self.tcp_reference.clone(), self._workspace
        after = torch.clamp(before + horizon * self._tcp_target, bounds[..., 0], bounds[..., 1])
        # On a leash to where the joints' reference can be: it must not wind up against a blocked object.
        after = torch.clamp(after, at - config.tcp_leash, at + config.tcp_leash)
        self.tcp_reference[...] = after
        follow = (after - before) / horizon + config.position_gain * (after - at)
        return follow.clamp(-2.0 * config.max_tcp_speed, 2.0 * config.max_tcp_speed)

    def _angular(self, tcp: torch.Tensor, rotation: torch.Tensor) -> torch.Tensor:
        """Return the angular velocity that turns the hand's axis to the object's centre, within limits [rad/s]."""
        config = self.config
        offset = self._object_xy_b - tcp[:, :2]
        ahead = torch.stack([offset[:, 0].clamp_min(1e-3), offset[:, 1]], dim=-1)
        yaw = geometry.angle_of(ahead).clamp(-config.max_hand_yaw, config.max_hand_yaw)
        target = hand_rotation(yaw, config.hand_tilt)
        # Sum of the cross products of the axes: twice the rotation vector to first order.
        error = 0.5 * torch.cross(rotation.mT, target.mT, dim=-1).sum(-2)
        return (config.orientation_gain * error).clamp(-config.max_hand_rate, config.max_hand_rate)


def hand_rotation(yaw: torch.Tensor, tilt: float) -> torch.Tensor:
    """Return the hand's rotation for an axis that points forward and down, fingers side by side.

    Args:
        yaw: Angle of the hand's axis from the base's x axis in the plane [rad], shape ``[N]``.
        tilt: Angle of the axis below the horizontal [rad].

    Returns:
        Rotation matrices whose third column is the hand's axis, shape ``[N, 3, 3]``.

    Examples:
        >>> hand_rotation(torch.zeros(1), 0.0)[0].round().int().tolist()
        [[0, 0, 1], [0, -1, 0], [1, 0, 0]]
    """
    zero, pitch = torch.zeros_like(yaw), torch.full_like(yaw, tilt)
    axis = torch.stack([pitch.cos() * yaw.cos(), pitch.cos() * yaw.sin(), -pitch.sin()], dim=-1)
    fingers = torch.stack([yaw.sin(), -yaw.cos(), zero], dim=-1)
    return torch.stack([torch.cross(fingers, axis, dim=-1), fingers, axis], dim=-1)
