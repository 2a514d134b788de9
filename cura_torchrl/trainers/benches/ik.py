"""The arm's differential inverse kinematics, batched, beside the same robot by robot and beside PyBullet's own."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import torch

from cura_torchrl.envs.config import RobotConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.robots import ridgeback_franka as model
from cura_torchrl.envs.robots.kinematics import ArmKinematics, damped_least_squares
from cura_torchrl.envs.simulation.bullet_floor import BulletFloor
from cura_torchrl.trainers.benches.report import Report, measure, rates, timed

if TYPE_CHECKING:
    from cura_torchrl.trainers.benches.config import BenchConfig

ITERATIONS = 20
"""PyBullet's own default [1]."""


def run(config: BenchConfig) -> Report:
    """Measure inverse kinematics.

    Args:
        config: How.

    Returns:
        Forward kinematics, Jacobian and damped least squares of all robots at once beside one at a time, and beside
        ``calculateInverseKinematics``, robot by robot.
    """
    report, count = Report(), config.num_envs
    arm, damping = ArmKinematics(), RobotConfig().ik_damping
    joints = torch.tensor(model.HOME, dtype=torch.float64) + 0.1 * torch.randn(count, 7, dtype=torch.float64)
    twist = 0.1 * torch.randn(count, 6, dtype=torch.float64)
    env = PushEnv(count, seed=config.seed)
    env.reset()
    floor = BulletFloor(env._worlds)
    base = env.world_state.base_pose
    targets = [(x + 0.8, y, 0.4) for x, y, _ in base.tolist()]

    def solve(rows: slice) -> torch.Tensor:
        jacobian = arm.forward(joints[rows])[2]
        return damped_least_squares(jacobian, twist[rows], damping)[0]

    def one_by_one() -> torch.Tensor:
        return torch.cat([solve(slice(row, row + 1)) for row in range(count)])

    plays = {
        "batched": timed(functools.partial(solve, slice(None))),
        "one by one": timed(one_by_one),
        "one iteration": timed(functools.partial(floor.solve_ik, targets, 1)),
        "iterations": timed(functools.partial(floor.solve_ik, targets, ITERATIONS)),
    }
    taken = measure(plays, 3 * config.rounds, "inverse kinematics")
    env.close()
    bullet = "PyBullet's calculateInverseKinematics"
    report.add_figure(f"damped least squares, {count} robots at once", rates(count, taken["batched"]), "robots/s")
    report.add_figure(f"{bullet}, 1 iteration", rates(count, taken["one iteration"]), "robots/s")
    report.add_ratio("one at a time / batched", taken["one by one"], taken["batched"])
    report.add_ratio(f"{bullet}, 1 iteration / batched", taken["one iteration"], taken["batched"])
    report.add_ratio(f"{bullet}, {ITERATIONS} / batched", taken["iterations"], taken["batched"])
    difference = (solve(slice(None)) - one_by_one()).abs().max().item()
    report.add_check("batched and one at a time, difference [rad/s]", difference, 1e-9)
    return report
