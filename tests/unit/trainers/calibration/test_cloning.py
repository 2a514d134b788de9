"""Clones of a world go on as it does, and differ where they are told to."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv

from cura_torchrl.envs.config import MapConfig, PushEnvConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.transforms import ConfidenceMap
from cura_torchrl.trainers.calibration.cloning import _draw_more, copy_world, put_obstacles, remove_obstacles, vary


def _env(rows: int) -> TransformedEnv:
    env = PushEnv(rows, PushEnvConfig(simulator="planar"), seed=5)
    coarse = MapConfig(resolution=0.5, window=20)
    return TransformedEnv(env, Compose(ConfidenceMap(coarse, num_rays=360, max_range=10.0)))


def test_clones_of_a_world_go_on_exactly_as_it_does() -> None:
    """Catches a part of the state that is not copied: clones would drift from their world."""
    source, target = _env(3), _env(4)
    state = source.rollout(6)[:, -1]["next"]
    target.rand_step(target.reset())
    copy_world(source, 2, target)
    action = torch.full((1, 6), 0.5)
    for _ in range(3):
        state = source.step(state.set("action", action.expand(3, 6)))["next"]
        copies = target.step(TensorDict({"action": action.expand(4, 6)}, [4]))["next"]
        for key in ("observation", "scan", "object_pose", "confidence_map"):
            # Batches of another size round differently in the last bits.
            torch.testing.assert_close(copies[key], state[key][2:].expand_as(copies[key]), atol=1e-5, rtol=0.0)


def test_varied_clones_differ_in_noise_and_in_obstacles_to_come() -> None:
    """Catches seeds that change nothing, or that move the robot or the obstacles that are there."""
    source, target = _env(3), _env(4)
    source.rollout(3)
    target.rand_step(target.reset())
    copy_world(source, 0, target)
    present, where, _ = target.base_env.obstacles
    vary(target, torch.arange(4))
    copies = target.step(TensorDict({"action": torch.zeros(4, 6)}, [4]))["next"]
    assert (copies["scan"][0] - copies["scan"][1]).abs().max() > 1e-3
    assert torch.equal(copies["object_pose"], copies["object_pose"][:1].expand(4, 3))
    assert torch.equal(target.base_env.obstacles[1][present], where[present])
    times = target.base_env.scenario["obstacle_time"][~present]
    assert ((times >= 0.6) & (times <= 15.0) | (times == 1e9)).all()  # three steps have been played
    assert len(times.unique()) > 2


def test_obstacles_are_replaced_and_removed_where_the_rays_are_cast() -> None:
    """Catches a redrawn obstacle that the simulator does not know of, and one that stays after it was removed."""
    target = _env(2)
    target.reset()
    pose, edge = torch.zeros(2, 6, 3, dtype=torch.float64), torch.zeros(2, 6, dtype=torch.float64)
    base = target.base_env.world_state.base_pose
    pose[:, 0, :2] = base[:, :2] + torch.tensor([0.0, 3.0])  # to the side: nothing else is there
    edge[:, 0] = 1.0
    put_obstacles(target, pose, edge, torch.tensor([True, False]))
    target.base_env.scenario["num_obstacles"][:] = 1
    side = 270  # ray 270 of 360 points to the left
    still = TensorDict({"action": torch.zeros(2, 6)}, [2])
    first = target.step(still)["next"]["scan"][:, side]
    remove_obstacles(target, torch.tensor([False, True]))
    second = target.step(still)["next"]["scan"][:, side]
    assert first[1] < 4.0
    assert second[1] == 10.0
    assert second[0] == pytest.approx(float(first[0]), abs=0.2)
    assert target.base_env.scenario["adversarial"].tolist() == [True, False]


def test_how_many_are_to_come_follows_bayes_for_each_world() -> None:
    """Catches worlds that share one count: of at most 2, none there at half time gives 4/7, 2/7, 1/7; one there 1/2."""
    shares = torch.linspace(0.0005, 0.9995, 1000, dtype=torch.float64)
    angle = ((shares - 0.5) * 2 * torch.pi).repeat(2)
    there = torch.tensor([0, 1]).repeat_interleave(1000)
    more = _draw_more(there, 0.5, 2, angle).view(2, 1000)
    # With a there and f to come: C(a + f, a) / 2^f, so 1, 1/2, 1/4 and 1, 2/2.
    for row, expected in zip(more, ((4 / 7, 2 / 7, 1 / 7), (0.5, 0.5, 0.0)), strict=True):
        assert (torch.bincount(row, minlength=3) / 1000).tolist() == pytest.approx(expected, abs=2e-3)
