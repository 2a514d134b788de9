"""The inverse kinematics of a robot, compiled for the CPU: on small matrices tensor operations are mostly overhead."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cura_torchrl.compiled import Doubles, compiled
from cura_torchrl.envs.robots.ridgeback import BASE_DOF
from cura_torchrl.envs.robots.ridgeback_franka import ARM_DOF


class Follow(NamedTuple):
    """What :class:`cura_torchrl.envs.config.RobotConfig` says under these names, and the time between two solutions."""

    horizon: float
    """Time between two solutions [s]."""
    position_gain: float
    tcp_leash: float
    max_tcp_speed: float
    orientation_gain: float
    max_hand_yaw: float
    max_hand_rate: float
    hand_tilt: float
    posture_gain: float
    ik_damping: float


@compiled
def rates_of_one(
    world: int, motions: Doubles, tcp_references: Doubles, aims: Doubles, workspaces: Doubles, offsets: Doubles,
    postures: Doubles, follow: Follow,
) -> None:  # fmt: skip
    """Set a robot's rates as :meth:`cura_torchrl.envs.robots.controller.ImpedanceController.solve_ik` does.

    Args:
        world: Which robot n.
        motions: As in :func:`cura_torchrl.envs.robots.torque_kernel.torques_of_one`; the rates are set in row n.
        tcp_references: References of the TCPs, moved on in row n [m], shape ``[N, 3]``.
        aims: Commanded velocities of the TCPs [m/s], then the objects' centres (x, y) in the base frame [m], shape
            ``[N, 5]``.
        workspaces: Where the references may be [m], shape ``[N, 3, 2]``.
        offsets: Those of :class:`cura_torchrl.envs.robots.kinematics.ArmKinematics`, shape ``[8, 3, 4]``.
        postures: Home posture [rad] and largest rate [rad/s] of the joints, shape ``[2, 7]``.
        follow: Gains and limits.
    """
    joints, rates, aim = motions[world, 0, BASE_DOF:], motions[world, 1, BASE_DOF:], aims[world]
    pose, jacobian, task = np.empty((3, 4)), np.empty((6, ARM_DOF)), np.empty(6)
    place_hand(joints, offsets, pose, jacobian)
    for i in range(3):
        _follow_tcp(i, tcp_references[world], pose[i, 3], aim[i], workspaces[world, i], follow, task)
    _face(pose, aim[3] - pose[0, 3], aim[4] - pose[1, 3], follow, task)
    # v = p + J^T (J J^T + lambda^2 I)^-1 (t - J p): the twist t, and the posture p in what it leaves free.
    for j in range(ARM_DOF):
        rates[j] = follow.posture_gain * (postures[0, j] - joints[j])
        for i in range(6):
            task[i] -= jacobian[i, j] * rates[j]
    _solve_damped(jacobian, follow.ik_damping, task)
    for j in range(ARM_DOF):
        for i in range(6):
            rates[j] += jacobian[i, j] * task[i]
        rates[j] = min(max(rates[j], -postures[1, j]), postures[1, j])


@compiled
def place_hands(joints: Doubles, poses: Doubles, jacobians: Doubles, offsets: Doubles) -> None:
    """Do :func:`place_hand` for many robots.

    Args:
        joints: Arm joints [rad], shape ``[N, 7]``.
        poses: Where the TCPs' rotations and positions [m] go, shape ``[N, 3, 4]``.
        jacobians: Where the Jacobians go [m/rad, 1], shape ``[N, 6, 7]``.
        offsets: As in :func:`rates_of_one`.
    """
    for n in range(joints.shape[0]):
        place_hand(joints[n], offsets, poses[n], jacobians[n])


@compiled
def place_hand(joints: Doubles, offsets: Doubles, pose: Doubles, jacobian: Doubles) -> None:
    """Work out where the TCP is and how it moves with the joints, as ``ArmKinematics.forward`` does.

    Args:
        joints: Arm joints [rad], shape ``[7]``.
        offsets: As in :func:`rates_of_one`.
        pose: Where the TCP's rotation and position [m] go, shape ``[3, 4]``.
        jacobian: Where the Jacobian goes [m/rad, 1], shape ``[6, 7]``.
    """
    pose[:] = offsets[0]
    for j in range(ARM_DOF):
        for i in range(3):
            jacobian[i, j], jacobian[3 + i, j] = pose[i, 3], pose[i, 2]
        _turn(pose, joints[j])
        _attach(pose, offsets[j + 1])
    for j in range(ARM_DOF):
        x, y, z = pose[0, 3] - jacobian[0, j], pose[1, 3] - jacobian[1, j], pose[2, 3] - jacobian[2, j]
        axis = jacobian[3:, j]
        jacobian[0, j] = axis[1] * z - axis[2] * y
        jacobian[1, j] = axis[2] * x - axis[0] * z
        jacobian[2, j] = axis[0] * y - axis[1] * x


@compiled
def place_links(joints: Doubles, poses: Doubles, offsets: Doubles) -> None:
    """Work out where the links of many robots are, as ``ArmKinematics.links`` does.

    Args:
        joints: Arm joints [rad], shape ``[N, 7]``.
        poses: Where the links' rotations and positions [m] go, shape ``[N, 7, 3, 4]``.
        offsets: As in :func:`rates_of_one`.
    """
    pose = np.empty((3, 4))
    for n in range(joints.shape[0]):
        pose[:] = offsets[0]
        for j in range(ARM_DOF):
            _turn(pose, joints[n, j])
            poses[n, j] = pose
            _attach(pose, offsets[j + 1])


@compiled
def _turn(pose: Doubles, angle: float) -> None:
    cos, sin = math.cos(angle), math.sin(angle)
    for i in range(3):
        x, y = pose[i, 0], pose[i, 1]
        pose[i, 0], pose[i, 1] = cos * x + sin * y, cos * y - sin * x


@compiled
def _attach(pose: Doubles, offset: Doubles) -> None:
    for i in range(3):
        x, y, z = pose[i, 0], pose[i, 1], pose[i, 2]
        for k in range(3):
            pose[i, k] = x * offset[0, k] + y * offset[1, k] + z * offset[2, k]
        pose[i, 3] += x * offset[0, 3] + y * offset[1, 3] + z * offset[2, 3]


@compiled
def _follow_tcp(
    i: int, references: Doubles, at: float, speed: float, workspace: Doubles, follow: Follow, task: Doubles
) -> None:
    before = references[i]
    after = min(max(before + follow.horizon * speed, workspace[0]), workspace[1])
    # On a leash to where the joints' reference can be: it must not wind up against a blocked object.
    after = min(max(after, at - follow.tcp_leash), at + follow.tcp_leash)
    references[i] = after
    velocity, bound = (
        (after - before) / follow.horizon + follow.position_gain * (after - at),
        2.0 * follow.max_tcp_speed,
    )
    task[i] = min(max(velocity, -bound), bound)


@compiled
def _face(pose: Doubles, ahead: float, left: float, follow: Follow, task: Doubles) -> None:
    yaw = min(max(math.atan2(left, max(ahead, 1e-3)), -follow.max_hand_yaw), follow.max_hand_yaw)
    cos, sin, level, down = math.cos(yaw), math.sin(yaw), math.cos(follow.hand_tilt), math.sin(follow.hand_tilt)
    # Columns as of hand_rotation: fingers x axis, fingers, axis.
    target = ((down * cos, sin, level * cos), (down * sin, -cos, level * sin), (level, 0.0, -down))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        error = 0.0
        for column in range(3):
            error += pose[j, column] * target[k][column] - pose[k, column] * target[j][column]
        rate = follow.orientation_gain * 0.5 * error
        task[3 + i] = min(max(rate, -follow.max_hand_rate), follow.max_hand_rate)


@compiled
def _solve_damped(jacobian: Doubles, damping: float, task: Doubles) -> None:
    # task <- (J J^T + damping^2 I)^-1 task, by Cholesky's factor of the symmetric matrix.
    rows, columns = jacobian.shape
    factor = np.empty((rows, rows))
    for i in range(rows):
        for j in range(i + 1):
            total = damping**2 if i == j else 0.0
            for k in range(columns):
                total += jacobian[i, k] * jacobian[j, k]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            factor[i, j] = math.sqrt(total) if i == j else total / factor[j, j]
        for k in range(i):
            task[i] -= factor[i, k] * task[k]
        task[i] /= factor[i, i]
    for i in range(rows - 1, -1, -1):
        for k in range(i + 1, rows):
            task[i] -= factor[k, i] * task[k]
        task[i] /= factor[i, i]
