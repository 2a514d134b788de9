"""The scripted pusher: proof that physics, kinematics and control can do the job."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from cura_torchrl.envs.config import PushEnvConfig, ScenarioConfig, TaskConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.robots.scripted import ScriptedPusher

if TYPE_CHECKING:
    from tensordict import TensorDictBase


def play(edges: tuple[float, ...], num_envs: int, steps: int) -> TensorDictBase:
    """Return a rollout without obstacles, batch ``[N, T]``."""
    scenario = ScenarioConfig(object_edges=edges, max_obstacles=0)
    env = PushEnv(num_envs, PushEnvConfig(task=TaskConfig(scenario=scenario, stream="eval", success_time=0.0)))
    rollout = env.rollout(steps, ScriptedPusher(), break_when_any_done=False)
    env.close()
    return rollout


def test_it_gets_the_box_going():
    """Catches physics or control in which the box is not moved, or slips off the hand at once."""
    data = play((0.5, 0.75, 1.0), 3, 35)
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
