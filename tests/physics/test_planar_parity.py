"""The planar simulator beside PyBullet: the same commands, the same paths. benchmarks/parity.py has the full report."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from cura_torchrl.envs.config import LidarConfig, PushEnvConfig, RobotConfig, ScenarioConfig, TaskConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.robots.scripted import ScriptedPusher

SIMULATORS = ("bullet", "planar")


ARM, BARE = RobotConfig(), RobotConfig(model="ridgeback")


def make_envs(rows: int, robot: RobotConfig = ARM, **scenario: object) -> list[PushEnv]:
    """Return one environment a simulator, of the same scenes and without noise on the scan."""
    task = TaskConfig(scenario=ScenarioConfig(**({"obstacle_time": (0.0, 0.0)} | scenario)))
    config = PushEnvConfig(task=task, lidar=LidarConfig(noise=0.0), robot=robot)
    return [PushEnv(rows, dataclasses.replace(config, simulator=name), seed=3) for name in SIMULATORS]


def test_scans_agree_to_a_millimetre():
    """Catches rays in another frame, and bodies of another size. Threshold: 99.9 % of all rays."""
    one, other = (env.reset()["scan"] for env in make_envs(48))
    assert ((one - other).abs() < 1e-3).double().mean() > 0.999
    assert (one < 9.9).double().mean() > 0.05


def test_the_robot_moves_alike_when_it_touches_nothing():
    """Catches another inertia, law or clock. Threshold: the median within 2 cm after 2 s."""
    envs = make_envs(12, max_obstacles=0, start_gap=(3.0, 3.5))
    generator = torch.Generator().manual_seed(0)
    held = (torch.rand(2, 12, 6, generator=generator) * 2 - 1).repeat_interleave(5, 0)
    last = []
    for env in envs:
        data = env.reset()
        for action in held:
            data = env.step(data.select().set("action", action))["next"]
        last.append((env.world_state.base_pose, data["observation"][:, :3]))
        env.close()
    base, hand = ((one - other)[:, :2].norm(dim=1) for one, other in zip(*last, strict=True))
    assert base.max() < 0.02
    assert hand.median() < 0.02


@pytest.mark.parametrize("robot", [ARM, BARE], ids=["arm", "base"])
def test_boxes_go_where_pybullet_pushes_them(robot: RobotConfig):
    """Catches friction, inertia or contact of another kind. Threshold: the median within 2 cm after 2 s of contact."""
    bullet, planar = make_envs(9, robot, max_obstacles=0, start_gap=(0.2, 0.25))
    policy, actions = ScriptedPusher(robot), []
    data = bullet.reset()
    for _ in range(14):
        data = policy(data)
        actions.append(data["action"].clone())
        data = bullet.step(data)["next"]
    planar.reset()
    for action in actions:
        other = planar.step(data.select().set("action", action))["next"]
    moved = data["object_pose"][:, 0]
    assert moved.median() > 0.3
    assert (data["object_pose"] - other["object_pose"])[:, :2].norm(dim=1).median() < 0.02
    for env in (bullet, planar):
        env.close()


@pytest.mark.slow
def test_the_scripted_pusher_needs_as_long():
    """Catches feedback that works on one simulator alone. Threshold: medians within 5 %."""
    times = []
    for env in make_envs(9, max_obstacles=0):
        data = env.rollout(130, ScriptedPusher(), break_when_any_done=False)
        reached = data["next", "success"][..., 0]
        assert reached.any(1).all()
        times.append(reached.int().argmax(1).double().median())
        env.close()
    assert times[0].item() == pytest.approx(times[1].item(), rel=0.05)
