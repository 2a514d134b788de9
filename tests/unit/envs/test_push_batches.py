"""Rows of a batch: alone, after their end, in copies, and by the episodes they are asked to play."""

from __future__ import annotations

import copy
import dataclasses
import pickle
from contextlib import closing
from typing import Any

import pytest
import torch
from tensordict.nn import TensorDictModule

from cura_torchrl.envs.config import PushEnvConfig, RobotConfig, ScenarioConfig, TaskConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.robots.scripted import ScriptedPusher

SOON = TaskConfig(scenario=ScenarioConfig(obstacle_time=(0.0, 2.0)))
"""Obstacles appear within two seconds."""
PLANAR = PushEnvConfig(task=SOON, simulator="planar")


@pytest.mark.parametrize("model", ["ridgeback_franka", "ridgeback"])
@pytest.mark.parametrize("simulator", ["planar", "bullet"])
def test_what_is_pushed_moves_bitwise_as_it_does_alone(simulator: Any, model: Any) -> None:
    """Catches products that round by the size of the batch: contact makes ten times as much of it in every step."""
    robot = RobotConfig(model=model)
    config, pusher = PushEnvConfig(task=SOON, simulator=simulator, robot=robot), ScriptedPusher(robot)
    # What is emitted is rounded to float32; the simulators' own state is not. 33 is no multiple of a vector's width.
    with closing(PushEnv(33, config)) as together, closing(PushEnv(1, config)) as alone:
        row, steps = 31, 20
        data = together.reset()
        single = alone.reset(episodes=data["episode"][row])
        for _ in range(steps):
            action = pusher(data)["action"]
            data = together.step(data)["next"]
            single = alone.step(single.set("action", action[row : row + 1]))["next"]
            for name, value in vars(alone.world_state).items():
                assert torch.equal(value[0], getattr(together.world_state, name)[row]), name
        assert together.world_state.object_velocity[row].norm() > 0.1


def test_a_row_that_is_stepped_after_its_end_stands_still() -> None:
    """Catches a robot that drives through obstacles after a collision, until its LiDAR is inside of one."""
    ahead = torch.tensor([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]).expand(16, 6)
    policy = TensorDictModule(lambda _: ahead, in_keys=["observation"], out_keys=["action"])
    with closing(PushEnv(16, PLANAR)) as env:
        rollout = env.rollout(120, policy, break_when_any_done=False, break_when_all_done=True)
        collided = rollout["next", "terminated"][:, :-5].any(1).flatten()
        assert collided.any()
        speed = env.world_state.base_velocity[collided].norm(dim=-1)
    assert (speed < 1e-3).all()


def test_worlds_of_pybullet_are_not_copied() -> None:
    """Catches a copy that shares its worlds with the original, and whose controller moves nothing."""
    with closing(PushEnv(1, dataclasses.replace(PLANAR, simulator="bullet"))) as env:
        for copied in (copy.deepcopy, pickle.dumps):
            with pytest.raises(TypeError, match=r"cannot be copied, .*; accepted: to make them there"):
                copied(env)


def test_a_list_of_episodes_is_as_good_as_a_tensor() -> None:
    """Catches an error about an attribute of lists."""
    with closing(PushEnv(2, PLANAR)) as env:
        assert env.reset(episodes=[7, 3])["episode"].flatten().tolist() == [7, 3]
        with pytest.raises(ValueError, match=r"episodes are \[7\]; accepted: 2 integers"):
            env.reset(episodes=[7])
