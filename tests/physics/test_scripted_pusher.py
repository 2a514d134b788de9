"""The scripted pusher: proof that physics, kinematics and control can do the job."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from cura_torchrl.envs.config import PushEnvConfig, RobotConfig, ScenarioConfig, Simulator, TaskConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.robots.scripted import ScriptedPusher

if TYPE_CHECKING:
    from tensordict import TensorDictBase


ARM, BARE = RobotConfig(), RobotConfig(model="ridgeback")


def play(
    edges: tuple[float, ...], num_envs: int, steps: int, robot: RobotConfig = ARM, simulator: Simulator = "bullet"
) -> TensorDictBase:
    """Return a rollout without obstacles, batch ``[N, T]``."""
    scenario = ScenarioConfig(object_edges=edges, max_obstacles=0)
    task = TaskConfig(scenario=scenario, stream="eval", success_time=0.0)
    env = PushEnv(num_envs, PushEnvConfig(task=task, robot=robot, simulator=simulator))
    rollout = env.rollout(steps, ScriptedPusher(robot), break_when_any_done=False)
    env.close()
    return rollout


@pytest.mark.parametrize("robot", [ARM, BARE], ids=["arm", "base"])
def test_it_gets_the_box_going(robot: RobotConfig):
    """Catches physics or control in which the box is not moved, or slips off the hand or the face at once."""
    data = play((0.5, 0.75, 1.0), 3, 35, robot)
    moved = data["next", "object_pose"][:, -1, 0]
    # 7 s less about 2 s of approach at 0.6 m/s or more: 3 m.
    assert (moved > 2.0).all()
    assert not data["next", "tipped"].any()
    assert not data["next", "contact"].any()


@pytest.mark.slow
@pytest.mark.parametrize("edge", [0.5, 0.75, 1.0])
def test_it_reaches_the_goal(edge: float):
    """Catches an environment that cannot be solved. Threshold: both of two scenes within the 50 s."""
    data = play((edge,), 2, 250)
    reached = data["next", "success"][..., 0].any(1)
    assert reached.all()
    assert not data["next", "tipped"].any()


def test_a_bare_base_reaches_the_goal():
    """Catches a face that loses the box on its way. Threshold: all of 24 scenes within the 50 s, here in some 20 s."""
    data = play((0.5, 0.75, 1.0), 24, 130, BARE, "planar")
    assert data["next", "success"][..., 0].any(1).all()
    assert not data["next", "contact"].any()
