"""The impedance law of one robot and tick, compiled for the CPU: on arrays of ten numbers NumPy is mostly overhead."""

from __future__ import annotations

import math

import numpy as np

from cura_torchrl.compiled import Doubles, compiled
from cura_torchrl.envs.robots.ridgeback import BASE_DOF


@compiled
def torques_of_one(
    world: int, joints: Doubles, motions: Doubles, gains: Doubles, constants: Doubles, period: float,
    speed_bound: float, torque: Doubles,
) -> None:  # fmt: skip
    """Work out torques as :meth:`cura_torchrl.envs.robots.controller.ImpedanceController.torques` does.

    With no joints but the base's (J = 3) it is :meth:`cura_torchrl.envs.robots.base_controller.BaseController.torques`.

    Args:
        world: Which robot n.
        joints: Its joints' positions and velocities [m or rad; per second], shape ``[2, J]``; J is 10 with an arm.
        motions: Velocity command of the bases and reference of the arms, moved on in row n; then the command's target
            and the reference's rate; shape ``[N, 2, J]``.
        gains: What turns the spring's and damper's forces into torques [1], shape ``[N, J, J]``.
        constants: Stiffness, damping, torque limit, lowest and highest reference, and change of the velocity command in
            a tick, by joint, shape ``[6, J]``.
        period: Time between two ticks [s].
        speed_bound: Largest square of the base's speed [m^2/s^2].
        torque: Where the forces and torques go [N or N m], shape ``[J]``.
    """
    state, target, gain = motions[world, 0], motions[world, 1], gains[world]
    position, velocity = joints[0], joints[1]
    stiffness, damping, limit = constants[0], constants[1], constants[2]
    force = np.empty_like(torque)
    _move_base(state, target, constants[5], speed_bound)
    cos, sin = math.cos(position[2]), math.sin(position[2])
    force[0] = damping[0] * (cos * state[0] - sin * state[1] - velocity[0])
    force[1] = damping[1] * (sin * state[0] + cos * state[1] - velocity[1])
    force[2] = damping[2] * (state[2] - velocity[2])
    for j in range(BASE_DOF, len(force)):
        drag = damping[j] * velocity[j]
        centre, reach = position[j] + drag / stiffness[j], limit[j] / stiffness[j]
        reference = max(state[j] + target[j] * period, constants[3, j], centre - reach)
        state[j] = min(reference, constants[4, j], centre + reach)
        force[j] = stiffness[j] * (state[j] - position[j] - period * velocity[j]) - drag
    for i in range(len(force)):
        total = 0.0
        for j in range(len(force)):
            total += gain[i, j] * force[j]
        torque[i] = total if i < BASE_DOF else min(max(total, -limit[i]), limit[i])


@compiled
def _move_base(command: Doubles, target: Doubles, limit: Doubles, speed_bound: float) -> None:
    ramp = (target[0] - command[0], target[1] - command[1], target[2] - command[2])
    ahead, left = min(max(ramp[0], -limit[0]), limit[0]), min(max(ramp[1], -limit[1]), limit[1])
    if (command[0] + ahead) ** 2 + (command[1] + left) ** 2 > speed_bound:
        slowest = max(abs(ramp[0]) / limit[0], abs(ramp[1]) / limit[1], 1.0)
        ahead, left = ramp[0] / slowest, ramp[1] / slowest
    command[0] += ahead
    command[1] += left
    command[2] += min(max(ramp[2], -limit[2]), limit[2])
