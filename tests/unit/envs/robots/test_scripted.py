"""What the scripted pushers do in situations by hand, in the base frame."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from cura_torchrl.envs.config import RobotConfig
from cura_torchrl.envs.mdp.observations import OBSERVATION_SIZE, OBSERVATION_SLICES
from cura_torchrl.envs.robots.scripted import ScriptedAvoider, ScriptedPusher

BARE = RobotConfig(model="ridgeback")
"""The base without an arm, whose face's centre is 0.48 m ahead."""

FREE = torch.zeros(1, 6, 4)
"""No obstacle."""


def observe(
    centre: tuple[float, float], goal: tuple[float, float], obstacles: torch.Tensor = FREE, reach: float = 0.9
) -> TensorDict:
    """Return what a robot at the origin sees: TCP at (reach, 0), box of edge 0.5, everything at rest."""
    observation = torch.zeros(1, OBSERVATION_SIZE)
    observation[0, OBSERVATION_SLICES["object_heading"]] = torch.tensor([1.0, 0.0])
    parts = {"tcp_position": (reach, 0.0, 0.28), "object_position": (*centre, 0.25), "goal_position": goal}
    for name, value in parts.items():
        observation[0, OBSERVATION_SLICES[name]] = torch.tensor(value)
    data = {"observation": observation, "obstacles": obstacles, "sensor_pose": torch.zeros(1, 3)}
    return TensorDict(data, [1])


def act(policy: ScriptedPusher, *args, **kwargs) -> list[float]:
    """Return the policy's action."""
    return policy(observe(*args, **kwargs))["action"][0].tolist()


def test_it_pushes_straight_at_a_goal_ahead():
    """Catches a sign in the frame or a push aside."""
    vx, vy, wz, *arm = act(ScriptedPusher(), (1.15, 0.0), (10.0, 0.0))
    assert vx > 0.5
    assert (vy, wz) == (0.0, 0.0)
    assert arm == pytest.approx([0.0] * 3, abs=1e-6)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_it_turns_towards_a_goal_aside_and_gets_behind_the_object(side: float):
    """Catches a turn or a sidestep in the wrong direction: the box would roll off the hand."""
    vx, vy, wz, *_ = act(ScriptedPusher(), (1.15, 0.0), (8.0, side * 4.0))
    assert wz * side > 0
    # The goal lies to the left: behind the object is to its right.
    assert vy * side < 0
    assert vx > 0


def test_it_backs_off_when_it_is_beside_the_object():
    """Catches a pusher that shoves the box away from the goal when it is not behind it."""
    assert act(ScriptedPusher(), (0.9, 0.6), (10.0, 0.6))[0] < 0


def test_it_lets_go_before_it_comes_round():
    """Catches a hand that drags the box along as it moves to its other side: both then circle the goal for ever."""
    # The hand touches the box near its corner: 0.23 m behind its centre and 0.2 m to the right of it.
    vx, vy, *_ = act(ScriptedPusher(), (1.13, 0.2), (10.0, 0.2))
    assert vx < 0
    assert vy < 0


def test_off_the_box_it_gets_behind_its_middle_before_it_closes_in():
    """Catches a hand that meets the same face at the same place again: 0.15 m aside is more than 0.35 of 0.25 m."""
    vx, vy, *_ = act(ScriptedPusher(), (1.45, 0.15), (10.0, 0.15))
    assert vy > vx > 0


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_it_steers_a_box_that_veers_off(side: float):
    """Catches a rudder the wrong way round: the hand has to move to the side that the box veers to."""
    straight = act(ScriptedPusher(), (1.15, 0.0), (10.0, 0.0))
    veering = act(ScriptedPusher(), (1.15, 0.08 * side), (10.0, 0.08 * side))
    assert (veering[1] - straight[1]) * side > 0.1


def test_the_hand_stops_at_the_goal():
    """Catches a pusher that drives the box over the goal."""
    vx, vy, wz, ax, ay, _ = act(ScriptedPusher(), (1.15, 0.0), (1.15, 0.01))
    # The base may turn about the hand: v + w x r + arm, r = (0.9, 0), with 0.8 m/s, 1 rad/s, 0.5 m/s at an action of 1.
    assert 0.8 * vx + 0.5 * ax == pytest.approx(0.0, abs=1e-6)
    assert 0.8 * vy + 0.9 * wz + 0.5 * ay == pytest.approx(0.0, abs=1e-6)


def test_actions_are_admissible_wherever_things_are():
    """Catches actions outside [-1, 1], a base faster than its limit, NaN, and rows that depend on others."""
    generator = torch.Generator().manual_seed(0)
    data = TensorDict({"observation": 5 * torch.randn(500, OBSERVATION_SIZE, generator=generator)}, [500])
    policy = ScriptedPusher()
    action = policy(data.clone())["action"]
    assert action.isfinite().all()
    assert (action.abs() <= 1.0).all()
    assert (action[:, :2].norm(dim=-1) <= 1.0 + 1e-5).all()
    torch.testing.assert_close(policy(data[7:8].clone())["action"], action[7:8])


def test_the_avoider_needs_no_detour_in_the_open():
    """Catches a planned route that bends without an obstacle."""
    goal = (8.1, 0.1)
    free, straight = act(ScriptedAvoider(), (1.1, 0.1), goal), act(ScriptedPusher(), (1.1, 0.1), goal)
    assert free == pytest.approx(straight, abs=0.2)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_avoider_steers_around_an_obstacle_on_its_way(side: float):
    """Catches a pusher that sees obstacles and drives on, or passes on the side that is longer."""
    obstacles = FREE.clone()
    obstacles[0, 2] = torch.tensor([3.2, -0.5 * side, 0.0, 1.0])
    around = act(ScriptedAvoider(), (1.1, 0.1 * side), (8.1, 0.1 * side), obstacles)
    assert around[2] * side > 0.05


def test_the_avoider_plans_anew_when_the_scene_changes():
    """Catches a kept route of another episode or of before an obstacle appeared."""
    obstacles = FREE.clone()
    obstacles[0, 0] = torch.tensor([3.2, -0.5, 0.0, 1.0])
    policy = ScriptedAvoider()
    scenes = [((1.1, 0.1), (8.1, 0.1), FREE), ((1.1, 0.1), (8.1, 0.1), obstacles), ((1.1, 0.1), (8.1, 3.1), FREE)]
    for scene in [*scenes, scenes[0]]:
        assert act(policy, *scene) == act(ScriptedAvoider(), *scene)


def test_near_the_goal_the_avoider_is_the_pusher():
    """Catches a last metre along cell centres, which would miss the tolerance."""
    near = ((1.15, 0.0), (1.9, 0.2))
    assert act(ScriptedAvoider(), *near) == pytest.approx(act(ScriptedPusher(), *near), abs=1e-5)


def act_bare(policy: ScriptedPusher, *args, **kwargs) -> list[float]:
    """Return the action of a base without an arm."""
    return act(policy, *args, reach=0.48, **kwargs)


def test_the_face_pushes_straight_at_a_goal_ahead():
    """Catches an action with an arm, and a push aside."""
    vx, vy, wz = act_bare(ScriptedPusher(BARE), (0.73, 0.0), (10.0, 0.0))
    assert vx > 0.5
    assert (vy, wz) == (0.0, 0.0)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_base_turns_about_the_object_that_it_pushes(side: float):
    """Catches a turn that lets the object slide along the face: its centre has to move straight ahead."""
    vx, vy, wz = act_bare(ScriptedPusher(BARE), (0.73, 0.0), (8.0, side * 3.0))
    assert wz * side > 0.2
    assert vx > 0.4
    # v + w x r across the face, r = (0.73, 0), with 0.8 m/s and 1 rad/s at an action of 1.
    assert 0.8 * vy + 0.73 * wz == pytest.approx(0.0, abs=1e-6)


def test_the_base_backs_off_an_object_that_slips_off_its_face():
    """Catches a corner of the chassis that pushes on: the object would turn away from it."""
    vx, vy, _ = act_bare(ScriptedPusher(BARE), (0.73, 0.35), (10.0, 0.35))
    assert vx < -0.5
    assert abs(vy) < 0.2


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_base_comes_round_an_object_beside_it(side: float):
    """Catches a chassis that drives sideways into the object: first it goes back, then behind it."""
    beside = act_bare(ScriptedPusher(BARE), (0.2, 1.0 * side), (10.0, 1.0 * side))
    assert beside[0] < -0.5
    assert beside[1] == pytest.approx(0.0, abs=1e-6)
    behind = act_bare(ScriptedPusher(BARE), (1.1, 0.8 * side), (10.0, 0.8 * side))
    assert behind[1] * side > 0.5


def test_actions_of_the_base_are_admissible_wherever_things_are():
    """Catches actions outside [-1, 1], a base faster than its limit, NaN, and rows that depend on others."""
    generator = torch.Generator().manual_seed(0)
    data = TensorDict({"observation": 5 * torch.randn(500, OBSERVATION_SIZE - 3, generator=generator)}, [500])
    action = ScriptedPusher(BARE)(data.clone())["action"]
    assert action.shape == (500, 3)
    assert action.isfinite().all()
    assert (action.abs() <= 1.0).all()
    assert (action[:, :2].norm(dim=-1) <= 1.0 + 1e-5).all()
    torch.testing.assert_close(ScriptedPusher(BARE)(data[7:8].clone())["action"], action[7:8])


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_avoider_without_an_arm_steers_around_an_obstacle(side: float):
    """Catches a route or a clearance that only the arm's robot keeps."""
    obstacles = FREE.clone()
    obstacles[0, 2] = torch.tensor([2.8, -0.5 * side, 0.0, 1.0])
    around = act_bare(ScriptedAvoider(BARE), (0.75, 0.05 * side), (8.1, 0.05 * side), obstacles)
    assert around[2] * side > 0.05
    ahead = FREE.clone()
    ahead[0, 0] = torch.tensor([1.1, 0.0, 0.0, 0.4])  # 0.9 m ahead: 0.22 m beyond the chassis' disc and its clearance
    free = act_bare(ScriptedAvoider(BARE), (5.0, 0.0), (12.0, 0.0))
    assert 0.0 <= act_bare(ScriptedAvoider(BARE), (5.0, 0.0), (12.0, 0.0), ahead)[0] < free[0]
