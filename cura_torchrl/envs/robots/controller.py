"""From policy action to joint torques: velocity ramps, differential IK on the joint reference, 200 Hz joint impedance.

The reference lives in joint space and integrates the commanded end-effector velocity. Where it may be is bounded by the
TCP's workspace, by the joint limits, and by the torque that it can ask for.

All this is there twice: for all robots at once in tensors on any device, and compiled for one robot at a time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch

from cura_torchrl.envs import geometry
from cura_torchrl.envs.robots import ridgeback_franka as model
from cura_torchrl.envs.robots.base_controller import BaseController
from cura_torchrl.envs.robots.ik_kernel import Follow, rates_of_one
from cura_torchrl.envs.robots.kinematics import ArmKinematics, damped_least_squares
from cura_torchrl.envs.robots.ridgeback import BASE_DOF
from cura_torchrl.envs.simulation.interface import HandLinearization

if TYPE_CHECKING:
    from cura_torchrl.envs.config import RobotConfig


class ImpedanceController(BaseController):
    """Joint references and torques of N robots. State: base velocity command and joint reference of each.

    Args:
        num_worlds: Number of robots N.
        robot: Limits and gains.
        period: Time between two ticks [s].
        device: Where the tensors live; the CPU when None.
    """

    inertia = (model.BASE_MASS, model.BASE_MASS, model.BASE_YAW_INERTIA)
    kinematics: ArmKinematics

    def __init__(self, num_worlds: int, robot: RobotConfig, period: float, device: torch.device | None = None) -> None:
        super().__init__(num_worlds, robot, period, device)
        self._postures = self._tensor([model.HOME, model.VELOCITY_LIMIT])
        self._home, self._speed = self._postures
        stiffness, damping, limit = self._constants[:3, BASE_DOF:]
        # The spring, less what the damper takes, may ask for no more than the joint has: else the reference runs away.
        self._reach, self._lag = limit / stiffness, damping / stiffness
        workspace = [robot.workspace_x, robot.workspace_y, robot.workspace_z]
        self._workspace = self._tensor(workspace).expand(num_worlds, 3, 2).clone()
        self.tcp_reference = self._tensor(model.HOME_TCP).expand(num_worlds, 3).clone()
        # What the hand is to do: the TCP's velocity, and the object's centre in the base frame.
        self._aims = self._tensor([[0.0, 0.0, 0.0, 2.0, 0.0]] * num_worlds)
        self._tcp_target, self._object_xy_b = self._aims[:, :3], self._aims[:, 3:]
        self.reference, self._rate = self._motion[:, 0, BASE_DOF:], self._motion[:, 1, BASE_DOF:]
        self.reference[...] = self._home
        self.hand = HandLinearization(*self.kinematics.forward(self._home[None]), reference=self._home[None])
        if self._motion.device.type == "cpu":
            self._compile(robot)

    def _make_kinematics(self) -> ArmKinematics:
        return ArmKinematics(self._device)

    def _columns(self, robot: RobotConfig) -> list[list[float]]:
        arm = (
            robot.stiffness,
            robot.damping,
            model.TORQUE_LIMIT,
            model.JOINT_LOWER,
            model.JOINT_UPPER,
            [0.0] * len(model.ARM_JOINTS),
        )
        # One array, as each more costs the compiled law a tenth of a microsecond a tick.
        return [[*base, *joints] for base, joints in zip(super()._columns(robot), arm, strict=True)]

    def _compile(self, robot: RobotConfig) -> None:
        """Gather what the compiled inverse kinematics works on: the tensors' memory as arrays."""
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
        shares = action.double().clamp(-1.0, 1.0)
        self._command_base(shares, mass_matrix)
        self._tcp_target[...] = shares[:, 3:6] * self.config.max_tcp_speed
        self._object_xy_b[...] = object_xy_b

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
        base_force = self._base_force(position, velocity)
        error = reference - arm_position - self.period * arm_velocity
        force = torch.cat([base_force, stiffness * error - damping * arm_velocity], dim=-1)
        torque = geometry.matvec(self._gain, force)
        arm = torque[:, BASE_DOF:]
        torch.minimum(torch.maximum(arm, -limit, out=arm), limit, out=arm)
        return torque

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
