"""From policy action to joint torques: velocity ramps, differential IK on the joint reference, 200 Hz joint impedance.

The reference lives in joint space and integrates the commanded end-effector velocity. Where it may be is bounded by the
TCP's workspace, by the joint limits, and by the torque that it can ask for.

The law of a tick is written once for NumPy arrays, which are quicker for a few worlds, and for tensors on any device.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from cura_torchrl.envs import geometry
from cura_torchrl.envs.robots import ridgeback_franka as model
from cura_torchrl.envs.robots.kinematics import ArmKinematics, damped_least_squares
from cura_torchrl.envs.simulation.interface import HandLinearization

if TYPE_CHECKING:
    from typing import TypeAlias

    from cura_torchrl.envs.config import RobotConfig

Array: TypeAlias = Any
"""A NumPy array or a tensor, float64; of one kind throughout a controller."""

BASE_DOF = len(model.BASE_JOINTS)


class ImpedanceController:
    """Joint references and torques of N robots. State: base velocity command and joint reference of each.

    Args:
        num_worlds: Number of robots N.
        robot: Limits and gains.
        period: Time between two ticks [s].
        device: Where the law's tensors live; NumPy arrays when None.
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
        self._is_tensor = device is not None
        self._xp: Any = torch if self._is_tensor else np

        def tensor(values: Any) -> torch.Tensor:
            return torch.as_tensor(values, dtype=torch.float64, device=device)

        def array(values: Any) -> Array:
            return self._array(tensor(values))

        self._home = tensor(model.HOME)
        self._stiffness = array(robot.stiffness)
        mass = np.array([model.BASE_MASS, model.BASE_MASS, model.BASE_YAW_INERTIA])
        self._damping = array([*(mass / robot.base_time_constant), *robot.damping])
        self._base_damping = self._damping[:BASE_DOF]
        self._torque_limit = array(model.TORQUE_LIMIT)
        self._torque_floor = -self._torque_limit
        # The spring, less what the damper takes, may ask for no more than the joint has: else the reference runs away.
        reach = self._torque_limit / self._stiffness
        self._reach = self._xp.stack([-reach, reach])[:, None]
        arm_damping = self._damping[BASE_DOF:]
        lag, ahead = arm_damping / self._stiffness, self.period + 0.0 * arm_damping
        self._per_velocity = self._xp.stack([lag, ahead, arm_damping])[:, None]
        self._lower, self._upper = array(model.JOINT_LOWER), array(model.JOINT_UPPER)
        self._speed = tensor(model.VELOCITY_LIMIT)
        self._ramp = self.period * array([robot.max_base_acceleration] * 2 + [robot.max_base_yaw_acceleration])
        self._speed_bound = robot.max_base_speed**2 * (1.0 + 1e-9)  # the margin is for rounding
        workspace = tensor([robot.workspace_x, robot.workspace_y, robot.workspace_z]).expand(num_worlds, 3, 2)
        self._workspace = workspace.clone()
        self.tcp_reference = tensor(model.HOME_TCP).expand(num_worlds, 3).clone()
        self._tcp_target = torch.zeros_like(self.tcp_reference)
        self._object_xy_b = tensor([2.0, 0.0]).expand(num_worlds, 2).clone()
        zeros = tensor(0.0).expand(num_worlds, BASE_DOF + 7)
        self.reference = array(zeros[:, BASE_DOF:] + self._home)
        self.base_command = array(zeros[:, :BASE_DOF].clone())
        self._base_target = array(zeros[:, :BASE_DOF].clone())
        self._plan: list[Array] = []
        self._parts: dict[tuple[int | None, int | None], _Part] = {}
        self._gain = array(torch.zeros(num_worlds, BASE_DOF + 7, BASE_DOF + 7, dtype=torch.float64, device=device))
        self._reference_step = array(zeros[:, BASE_DOF:].clone())
        self.hand = HandLinearization(*self.kinematics.forward(self._home[None]), reference=self._home[None])

    def _array(self, tensor: torch.Tensor) -> Array:
        return tensor if self._is_tensor else tensor.numpy()

    def reset(self, rows: torch.Tensor, height_limit: torch.Tensor) -> None:
        """Put robots at rest in the home posture.

        Args:
            rows: Indices of the robots, shape ``[B]``.
            height_limit: Highest TCP reference that does not tip the object [m], shape ``[B]``.
        """
        index = rows if self._is_tensor else rows.numpy()
        self.reference[index] = self._array(self._home)
        self.base_command[index] = 0.0
        self._plan = []
        self.tcp_reference[rows] = self.tcp_reference.new_tensor(model.HOME_TCP)
        self._workspace[rows, 2, 1] = height_limit.to(self._workspace).clamp_max(self.config.workspace_z[1])

    def command(self, action: torch.Tensor, object_xy_b: torch.Tensor, mass_matrix: Array) -> None:
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
        self._base_target[...] = self._array(torch.cat([planar, turn], dim=-1))
        self._plan = []
        self._tcp_target = shares[:, 3:6] * config.max_tcp_speed
        self._object_xy_b = object_xy_b.clone()
        # tau = M (M + D dt + K dt^2)^-1 (...): the implicit (stable) form of the impedance law.
        implicit = mass_matrix + 0.0
        diagonal = list(range(BASE_DOF + 7))
        implicit[:, diagonal, diagonal] += self._damping * self.period
        arm = diagonal[BASE_DOF:]
        implicit[:, arm, arm] += self._stiffness * self.period**2
        self._gain[...] = mass_matrix @ self._xp.linalg.inv(implicit)

    def torques(self, rows: slice, position: Array, velocity: Array) -> Array:
        """Return the joint torques of one tick for consecutive robots; :meth:`solve_ik` sets where they head.

        A robot belongs to the same ``rows`` from one solution to the next.

        Args:
            rows: Which robots, B of them.
            position: Their joints (base x [m], y [m], yaw [rad], arm [rad]), shape ``[B, 10]``.
            velocity: Their velocities, shape ``[B, 10]``.

        Returns:
            Forces and torques [N, N, N m, N m ...], shape ``[B, 10]``.

        Source:
            Tan, Liu and Turk (2011), "Stable proportional-derivative controllers", eq. (11).
        """
        xp, part = self._xp, self._part(rows)
        arm, reference = position[:, BASE_DOF:], part.reference
        lag, ahead, drag = xp.multiply(velocity[:, BASE_DOF:], self._per_velocity, out=part.scaled)
        lower, upper = xp.add(xp.add(arm, lag, out=lag), self._reach, out=part.bounds)
        reference += part.reference_step
        xp.maximum(xp.maximum(reference, self._lower, out=reference), lower, out=reference)
        xp.minimum(xp.minimum(reference, self._upper, out=reference), upper, out=reference)
        error = xp.subtract(xp.subtract(reference, arm, out=lag), ahead, out=lag)
        xp.subtract(xp.multiply(self._stiffness, error, out=error), drag, out=part.arm_force)
        twist = self._base_twist(part, position[:, 2])
        xp.subtract(twist, velocity[:, :BASE_DOF], out=twist)
        xp.multiply(self._base_damping, twist, out=part.base_force)
        torque = xp.matmul(part.gain, part.force)[:, :, 0]
        arm = torque[:, BASE_DOF:]
        xp.minimum(xp.maximum(arm, self._torque_floor, out=arm), self._torque_limit, out=arm)
        return torque

    def _part(self, rows: slice) -> _Part:
        key = rows.start, rows.stop
        if key not in self._parts:
            self._parts[key] = _Part(self, rows)
        return self._parts[key]

    def _base_twist(self, part: _Part, yaw: Array) -> Array:
        # Moves the base's velocity command on by a tick, and returns it along the world's axes.
        xp, command, twist = self._xp, part.command, part.twist
        if part.tick < len(self._plan):
            command[...] = self._plan[part.tick][part.rows]
        else:
            command += self._ramp_step(command, part.target)
        part.tick += 1
        xp.cos(yaw, out=part.turn[:, 0])
        xp.sin(yaw, out=part.turn[:, 1])
        part.turn[:, 2] = part.turn[:, 0]
        linear, products = command[:, :2], part.products
        xp.multiply(part.turn[:, :2], linear, out=products)
        xp.subtract(products[:, 0], products[:, 1], out=twist[:, 0])
        xp.multiply(part.turn[:, 1:], linear, out=products)
        xp.add(products[:, 0], products[:, 1], out=twist[:, 1])
        twist[:, 2] = command[:, 2]
        return twist

    def _ramp_step(self, command: Array, target: Array) -> Array:
        """Return the change of the base's velocity command in one tick, within the acceleration of each axis."""
        xp, ramp = self._xp, target - command
        step = xp.minimum(xp.maximum(ramp, -self._ramp), self._ramp)
        after = command[:, :2] + step[:, :2]
        is_fast = after[:, 0] ** 2 + after[:, 1] ** 2 > self._speed_bound
        if not self._is_tensor and not is_fast.any():
            return step
        # Axis by axis the way between two points of the disc of speeds may lead out of it; straight it cannot.
        shares = xp.abs(ramp[:, :2]) / self._ramp[:2]
        slowest = xp.maximum(xp.maximum(shares[:, :1], shares[:, 1:]), xp.ones_like(shares[:, :1]))
        step[:, :2] = xp.where(is_fast[:, None], ramp[:, :2] / slowest, step[:, :2])
        return step

    def solve_ik(self) -> None:
        """Set the rate of every joint reference from the commanded twist; due every ``ik_ticks`` ticks."""
        self._plan_base()
        reference = torch.as_tensor(self.reference).clone()
        tcp, rotation, jacobian = self.kinematics.forward(reference)
        self.hand = HandLinearization(tcp, rotation, jacobian, reference=reference)
        twist = torch.cat([self._linear(tcp), self._angular(tcp, rotation)], dim=-1)
        rate, free = damped_least_squares(jacobian, twist, self.config.ik_damping)
        posture = self.config.posture_gain * (self._home - reference)
        rate = rate + (free @ posture[:, :, None])[:, :, 0]
        self._reference_step[...] = self._array(
            torch.maximum(torch.minimum(rate, self._speed), -self._speed) * self.period
        )

    def _plan_base(self) -> None:
        """Work out the base's velocity commands up to the next solution, for all robots at once: they are open loop."""
        self._plan, command = [], self.base_command
        for _ in range(self.ik_ticks):
            command = command + self._ramp_step(command, self._base_target)
            self._plan.append(command)
        for part in self._parts.values():
            part.tick = 0

    def _linear(self, at: torch.Tensor) -> torch.Tensor:
        """Return the velocity that moves the TCP's reference as commanded, and follows it [m/s]."""
        config, horizon = self.config, self.ik_ticks * self.period
        before, bounds = self.tcp_reference, self._workspace
        after = torch.clamp(before + horizon * self._tcp_target, bounds[..., 0], bounds[..., 1])
        # On a leash to where the joints' reference can be: it must not wind up against a blocked object.
        after = torch.clamp(after, at - config.tcp_leash, at + config.tcp_leash)
        self.tcp_reference = after
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


class _Part:
    """Consecutive robots: their rows of the controller's arrays, and work space, made once.

    With a few robots, making views and arrays would take longer than the arithmetic.
    """

    def __init__(self, controller: ImpedanceController, rows: slice) -> None:
        own = controller.base_command
        self.rows, self.tick = rows, 0
        self.reference, self.reference_step = controller.reference[rows], controller._reference_step[rows]
        self.command, self.target, self.gain = own[rows], controller._base_target[rows], controller._gain[rows]

        def empty(*shape: int) -> Array:
            like = torch.as_tensor(own).new_empty(shape)
            return controller._array(like)

        count = len(self.command)
        self.scaled, self.bounds = empty(3, count, 7), empty(2, count, 7)
        self.turn, self.products, self.twist = empty(count, 3), empty(count, 2), empty(count, BASE_DOF)
        self.force = empty(count, BASE_DOF + 7, 1)
        self.base_force, self.arm_force = self.force[:, :BASE_DOF, 0], self.force[:, BASE_DOF:, 0]


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
