"""From policy action to joint torques: velocity ramps, differential IK on the joint reference, 200 Hz joint impedance.

The reference lives in joint space and integrates the commanded end-effector velocity. Where it may be is bounded by the
TCP's workspace, by the joint limits, and by the torque that it can ask for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from cura_torchrl.envs.mdp import geometry
from cura_torchrl.envs.robots import ridgeback_franka as model
from cura_torchrl.envs.robots.kinematics import ArmKinematics, damped_least_squares

if TYPE_CHECKING:
    from cura_torchrl.envs.config import PhysicsConfig, RobotConfig

BASE_DOF = len(model.BASE_JOINTS)


class ImpedanceController:
    """Joint references and torques of N robots. State: base velocity command and joint reference of each.

    Args:
        num_worlds: Number of robots N.
        robot: Limits and gains.
        physics: Clock.
        ticks: Control ticks in a policy step.
    """

    def __init__(self, num_worlds: int, robot: RobotConfig, physics: PhysicsConfig, ticks: int) -> None:
        self.config = robot
        self.kinematics = ArmKinematics()
        self.period = physics.control_period
        self.ik_ticks = max(1, round(1.0 / (robot.ik_rate * self.period)))
        self.ticks = ticks
        self._home = torch.tensor(model.HOME, dtype=torch.float64)
        self._stiffness = np.array(robot.stiffness)
        base_damping = np.array([model.BASE_MASS, model.BASE_MASS, model.BASE_YAW_INERTIA]) / robot.base_time_constant
        self._damping = np.concatenate([base_damping, robot.damping])
        self._torque_limit = np.array(model.TORQUE_LIMIT)
        # The spring, less what the damper takes, may ask for no more than the joint has: else the reference runs away.
        self._reach = self._torque_limit / self._stiffness
        self._lag = np.array(robot.damping) / self._stiffness
        self._lower, self._upper = np.array(model.JOINT_LOWER), np.array(model.JOINT_UPPER)
        self._speed = np.array(model.VELOCITY_LIMIT)
        self._ramp = self.period * np.array([robot.max_base_acceleration] * 2 + [robot.max_base_yaw_acceleration])
        self._speed_bound = robot.max_base_speed**2 * (1.0 + 1e-9)  # the margin is for rounding
        self.reference = np.tile(np.array(model.HOME), (num_worlds, 1))
        self.base_command = np.zeros((num_worlds, BASE_DOF))
        self._base_target = np.zeros((num_worlds, BASE_DOF))
        self._tcp_target = np.zeros((num_worlds, 3))
        self.tcp_reference = np.tile(np.array(model.HOME_TCP), (num_worlds, 1))
        self._height_limit = np.full(num_worlds, robot.workspace_z[1])
        self._object_xy_b = np.tile(np.array([[2.0, 0.0]]), (num_worlds, 1))
        self._gain = np.zeros((num_worlds, BASE_DOF + 7, BASE_DOF + 7))
        self._rate = np.zeros((num_worlds, 7))

    def reset(self, rows: torch.Tensor, height_limit: torch.Tensor) -> None:
        """Put robots at rest in the home posture.

        Args:
            rows: Indices of the robots, shape ``[B]``.
            height_limit: Highest TCP reference that does not tip the object [m], shape ``[B]``.
        """
        index = rows.numpy()
        self.reference[index] = np.array(model.HOME)
        self.tcp_reference[index] = np.array(model.HOME_TCP)
        self.base_command[index] = 0.0
        self._height_limit[index] = np.minimum(height_limit.numpy(), self.config.workspace_z[1])

    def command(self, action: torch.Tensor, object_xy_b: torch.Tensor, mass_matrix: np.ndarray) -> None:
        """Take the action of a policy step.

        Args:
            action: Base (vx, vy, wz) and end-effector (vx, vy, vz) as shares of their maxima, shape ``[N, 6]``.
            object_xy_b: Object's centre in the base frame, which the hand turns to [m], shape ``[N, 2]``.
            mass_matrix: Joint-space inertia, kept for the policy step [kg, kg m^2], shape ``[N, 10, 10]``.
        """
        config = self.config
        shares = action.double().clamp(-1.0, 1.0).numpy()
        norm = np.maximum(np.sqrt(shares[:, 0:1] ** 2 + shares[:, 1:2] ** 2), 1.0)
        self._base_target[:, :2] = shares[:, :2] / norm * config.max_base_speed
        self._base_target[:, 2] = shares[:, 2] * config.max_base_yaw_rate
        self._tcp_target = shares[:, 3:6] * config.max_tcp_speed
        self._object_xy_b = object_xy_b.numpy().copy()
        # tau = M (M + D dt + K dt^2)^-1 (...): the implicit (stable) form of the impedance law.
        implicit = mass_matrix.copy()
        diagonal = np.arange(BASE_DOF + 7)
        implicit[:, diagonal, diagonal] += self._damping * self.period
        arm = diagonal[BASE_DOF:]
        implicit[:, arm, arm] += self._stiffness * self.period**2
        self._gain = mass_matrix @ np.linalg.inv(implicit)

    def torques(self, rows: slice, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Return the joint torques of one tick for consecutive robots; :meth:`solve_ik` sets where they head.

        Args:
            rows: Which robots, B of them.
            position: Their joints (base x [m], y [m], yaw [rad], arm [rad]), shape ``[B, 10]``.
            velocity: Their velocities, shape ``[B, 10]``.

        Returns:
            Forces and torques [N, N, N m, N m ...], shape ``[B, 10]``.

        Source:
            Tan, Liu and Turk (2011), "Stable proportional-derivative controllers", eq. (11).
        """
        arm_position, arm_velocity = position[:, BASE_DOF:], velocity[:, BASE_DOF:]
        reference, command = self.reference[rows], self.base_command[rows]
        reference += self._rate[rows] * self.period
        centre = arm_position + self._lag * arm_velocity
        lower, upper = np.maximum(self._lower, centre - self._reach), np.minimum(self._upper, centre + self._reach)
        np.minimum(np.maximum(reference, lower, out=reference), upper, out=reference)
        command += self._ramp_step(command, self._base_target[rows])
        force = np.empty_like(position)
        force[:, :BASE_DOF] = self._damping[:BASE_DOF] * (_to_world(command, position[:, 2]) - velocity[:, :BASE_DOF])
        error = reference - arm_position - self.period * arm_velocity
        force[:, BASE_DOF:] = self._stiffness * error - self._damping[BASE_DOF:] * arm_velocity
        torque = (self._gain[rows] @ force[:, :, None])[:, :, 0]
        arm = torque[:, BASE_DOF:]
        np.minimum(np.maximum(arm, -self._torque_limit, out=arm), self._torque_limit, out=arm)
        return torque

    def _ramp_step(self, command: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Return the change of the base's velocity command in one tick, within the acceleration of each axis."""
        ramp = target - command
        step = np.minimum(np.maximum(ramp, -self._ramp), self._ramp)
        is_fast = (command[:, 0] + step[:, 0]) ** 2 + (command[:, 1] + step[:, 1]) ** 2 > self._speed_bound
        if is_fast.any():
            # Axis by axis the way between two points of the disc of speeds may lead out of it; straight it cannot.
            planar = ramp[is_fast, :2]
            step[is_fast, :2] = planar / np.maximum(np.abs(planar) / self._ramp[:2], 1.0).max(axis=1, keepdims=True)
        return step

    def solve_ik(self) -> None:
        """Set the rate of every joint reference from the commanded twist; due every ``ik_ticks`` ticks."""
        reference = torch.from_numpy(self.reference.copy())
        tcp, rotation, jacobian = self.kinematics.forward(reference)
        twist = torch.cat([self._linear(tcp), self._angular(tcp, rotation)], dim=-1)
        rate, free = damped_least_squares(jacobian, twist, self.config.ik_damping)
        posture = self.config.posture_gain * (self._home - reference)
        rate = rate + (free @ posture[:, :, None])[:, :, 0]
        self._rate = np.clip(rate.numpy(), -self._speed, self._speed)

    def _linear(self, tcp: torch.Tensor) -> torch.Tensor:
        """Return the velocity that moves the TCP's reference as commanded, and follows it [m/s]."""
        config, horizon = self.config, self.ik_ticks * self.period
        bounds = np.array([config.workspace_x, config.workspace_y, config.workspace_z])
        upper = np.tile(bounds[:, 1], (len(tcp), 1))
        upper[:, 2] = self._height_limit
        at, before = tcp.numpy(), self.tcp_reference
        after = np.clip(before + horizon * self._tcp_target, bounds[:, 0], upper)
        # On a leash to where the joints' reference can be: it must not wind up against a blocked object.
        after = np.clip(after, at - config.tcp_leash, at + config.tcp_leash)
        self.tcp_reference = after
        follow = (after - before) / horizon + config.position_gain * (after - at)
        return torch.from_numpy(np.clip(follow, -2.0 * config.max_tcp_speed, 2.0 * config.max_tcp_speed))

    def _angular(self, tcp: torch.Tensor, rotation: torch.Tensor) -> torch.Tensor:
        """Return the angular velocity that turns the hand's axis to the object's centre, within limits [rad/s]."""
        config = self.config
        offset = torch.from_numpy(self._object_xy_b) - tcp[:, :2]
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


def _to_world(twist: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    cos, sin = np.cos(yaw), np.sin(yaw)
    world = twist.copy()
    world[:, 0] = cos * twist[:, 0] - sin * twist[:, 1]
    world[:, 1] = sin * twist[:, 0] + cos * twist[:, 1]
    return world
