"""Draws as pure functions of (stream, seed, episode), and obstacles that appear with room around them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import torch

from cura_torchrl.envs import geometry
from cura_torchrl.envs.config import ScenarioConfig
from cura_torchrl.envs.mdp.scenarios import sample_scenarios, spawn_obstacles

if TYPE_CHECKING:
    from tensordict import TensorDict

CONFIG = ScenarioConfig()
REACH = 0.9
NUM_SCENES = 4000


def _sample(config: ScenarioConfig = CONFIG, episodes: Any = range(8), **overrides: Any) -> TensorDict:
    arguments = {"stream": "eval", "seed": 3, "max_obstacles": None, "tcp_reach": REACH} | overrides
    return sample_scenarios(config, episodes=torch.tensor(list(episodes), dtype=torch.int64), **arguments)


def _assert_same(first: TensorDict, second: TensorDict, but: tuple[str, ...] = ()) -> None:
    assert set(first.keys()) == set(second.keys())
    for key in first.keys():  # noqa: SIM118 - a TensorDict iterates over its rows
        if key not in but:
            assert torch.equal(first[key], second[key]), key


def test_draws_are_numpys_philox_in_the_documented_order():
    """Catches any reordering of the draws, which would silently change every frozen evaluation scene."""
    bits = np.random.Philox(key=np.array([3, 1], dtype=np.uint64), counter=[0, 5, 0, 0])
    u = np.random.Generator(bits).random(19 + 18 + 96)
    scenario = _sample(episodes=[5])[0]
    assert scenario["object_edge"].item() == (0.5, 0.75, 1.0)[int(u[0] * 3)]
    assert scenario["object_mass"].item() == pytest.approx(3 + 7 * u[1], rel=1e-15)
    assert scenario["floor_friction"].item() == pytest.approx(0.25 + 0.35 * u[2], rel=1e-15)
    assert scenario["object_pose"].tolist() == pytest.approx([0, -1 + 2 * u[6], -0.6 + 1.2 * u[7]], rel=1e-14)
    goal = [12 + 2 * u[8], -2 + 4 * u[9], -math.pi + 2 * math.pi * u[10]]
    assert scenario["goal_pose"].tolist() == pytest.approx(goal, rel=1e-14)
    assert scenario["robot_pose"][2].item() == pytest.approx(-0.3 + 0.6 * u[13], rel=1e-14)
    assert scenario["num_obstacles"].item() == int(u[14] * 7)
    assert scenario["adversarial"].item() == (u[15] < 0.5)
    assert scenario["obstacle_time"].tolist() == pytest.approx(list(15 * u[25:31]), rel=1e-14)
    # Places after 19 + 18 numbers: fallback by fallback, in each the six slots' pairs.
    place = u[37:].reshape(8, 6, 2)
    np.testing.assert_array_equal(scenario["obstacle_place"].numpy(), place.transpose(1, 0, 2))


def test_an_episode_is_the_same_scene_in_any_batch():
    """Catches draws that depend on the batch or on the order of resets, bit for bit."""
    whole = _sample(episodes=range(64))
    for i in (0, 17, 63):
        _assert_same(_sample(episodes=[i]), whole[i : i + 1])
    _assert_same(_sample(episodes=[40, 3, 3]), whole[torch.tensor([40, 3, 3])])


def test_streams_seeds_and_episodes_give_different_scenes():
    """Catches a key that leaves out one of the three: evaluation would share scenes with training."""
    scenes = [
        _sample(stream=stream, seed=seed, episodes=range(50))["obstacle_place"]
        for stream in ("train", "eval", "vae")
        for seed in (0, 1, 2**63)
    ]
    numbers = torch.stack(scenes).flatten()
    assert numbers.unique().numel() == numbers.numel()


def test_most_obstacles_scales_the_count_alone():
    """Catches a curriculum that changes the scenes and not only the number of obstacles."""
    six, three = (_sample(episodes=range(2000), max_obstacles=most) for most in (6, 3))
    _assert_same(six, three, but=("num_obstacles",))
    # floor(7 u) and floor(4 u) of the same u: each count of one maps to at most two of the other, in order.
    pairs = set(zip(six["num_obstacles"].tolist(), three["num_obstacles"].tolist(), strict=True))
    assert pairs == {(0, 0), (1, 0), (1, 1), (2, 1), (3, 1), (3, 2), (4, 2), (5, 2), (5, 3), (6, 3)}


def test_most_obstacles_may_differ_by_row_and_zero_means_none():
    """Catches a K that is read for the first row only."""
    most = torch.tensor([0, 6] * 500)
    count = _sample(episodes=range(1000), max_obstacles=most)["num_obstacles"]
    assert (count[::2] == 0).all()
    assert count[1::2].unique().tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert torch.equal(count[1::2], _sample(episodes=range(1, 1000, 2))["num_obstacles"])


def test_more_fallbacks_leave_every_other_draw_alone():
    """Catches a layout of the draws in which the number of fallbacks shifts the scenes."""
    few, many = (_sample(ScenarioConfig(num_fallbacks=count), range(20)) for count in (2, 8))
    _assert_same(few, many, but=("obstacle_place",))
    assert torch.equal(few["obstacle_place"], many["obstacle_place"][:, :, :2])


@pytest.mark.parametrize(("kind", "share"), [("uniform", 0.0), ("adversarial", 1.0), ("mixed", 0.5)])
def test_kind_sets_the_share_of_adversarial_scenes_alone(kind: Any, share: float):
    """Catches scenarios that differ in more than the obstacles' places."""
    scenario = _sample(ScenarioConfig(kind=kind), range(NUM_SCENES))
    # Standard error of a share of 4000: sqrt(0.25 / 4000) = 0.008; four of them.
    assert scenario["adversarial"].double().mean().item() == pytest.approx(share, abs=0.032)
    _assert_same(scenario, _sample(episodes=range(NUM_SCENES)), but=("adversarial",))


def test_draws_fill_their_ranges():
    """Catches a range whose ends are swapped or scaled wrongly."""
    scenario = _sample(episodes=range(NUM_SCENES))
    edge = scenario["object_edge"].unsqueeze(-1)
    ranges = {
        "mass": (scenario["object_mass"], 3.0, 10.0),
        "friction": (scenario["floor_friction"], 0.25, 0.6),
        "com": (scenario["com_offset"] / edge, -0.1, 0.1),
        "object_y": (scenario["object_pose"][:, 1], -1.0, 1.0),
        "object_yaw": (scenario["object_pose"][:, 2], -0.6, 0.6),
        "goal_x": (scenario["goal_pose"][:, 0], 12.0, 14.0),
        "goal_y": (scenario["goal_pose"][:, 1], -2.0, 2.0),
        "goal_yaw": (scenario["goal_pose"][:, 2], -math.pi, math.pi),
        "robot_yaw": (scenario["robot_pose"][:, 2], -0.3, 0.3),
        "time": (scenario["obstacle_time"], 0.0, 15.0),
        "place": (scenario["obstacle_place"], 0.0, 1.0),
    }
    for name, (values, low, high) in ranges.items():
        width = high - low
        # The extreme of 4000 or more uniforms lies within 0.5 % of the range's end except once in e^20.
        assert low <= values.min() <= low + 0.005 * width, name
        assert high - 0.005 * width <= values.max() <= high, name
    assert (scenario["object_pose"][:, 0] == 0).all()
    for key, options in (("object_edge", (0.5, 0.75, 1.0)), ("obstacle_edge", (0.4, 0.6, 1.0))):
        values, counts = scenario[key].unique(return_counts=True)
        assert values.tolist() == list(options)
        # Equal thirds, within five standard errors: 5 sqrt(2/9 / 4000) = 0.037.
        torch.testing.assert_close(counts / scenario[key].numel(), torch.full((3,), 1 / 3), atol=0.037, rtol=0)


def test_surface_point_is_uniform_on_the_vertical_faces():
    """Catches points inside the cube, on its lid, or on one face only."""
    scenario = _sample(episodes=range(NUM_SCENES))
    point = scenario["surface_point"] / scenario["object_edge"].unsqueeze(-1)
    assert (point.abs() <= 0.5).all()
    on_face = torch.stack([point[:, axis] == sign * 0.5 for axis in (0, 1) for sign in (-1, 1)], -1)
    assert (on_face.sum(-1) == 1).all()
    # A quarter each, within five standard errors: 5 sqrt(3/16 / 4000) = 0.034.
    torch.testing.assert_close(on_face.double().mean(0), torch.full((4,), 0.25).double(), atol=0.034, rtol=0)
    assert point[:, 2].mean().abs() < 0.025  # 5 sqrt(1/12 / 4000) = 0.023


def _tcp(scenario: TensorDict, reach: float) -> torch.Tensor:
    pose = scenario["robot_pose"]
    return pose[:, :2] + reach * torch.stack((pose[:, 2].cos(), pose[:, 2].sin()), -1)


def test_robot_starts_with_its_tcp_behind_the_rear_face():
    """Catches a robot that starts in front of, beside or in the object, and a gap taken from the cube's centre."""
    scenario = _sample(episodes=range(NUM_SCENES))
    local = geometry.to_frame(scenario["object_pose"], _tcp(scenario, REACH))
    gap = -local[:, 0] - scenario["object_edge"] / 2
    # The object's yaw stays within 0.6 rad < pi/4, so its own -x face is the rear one. With this reach no chassis is
    # so near that the robot has to be moved back: 0.9 - 0.48 = 0.42 m of arm ahead of it.
    assert 0.2 - 1e-12 <= gap.min() < 0.21
    assert 0.59 < gap.max() <= 0.6 + 1e-12
    assert 0.49 < local[:, 1].abs().max() <= 0.5 + 1e-12


@pytest.mark.parametrize("reach", [0.48, 0.7, 0.9])
def test_chassis_never_touches_the_object_at_the_start(reach: float):
    """Catches a short reach (the base pushes with its own front) that puts a corner of the chassis into the object."""
    scenario = _sample(episodes=range(NUM_SCENES), tcp_reach=reach)
    object_half = (scenario["object_edge"] / 2).unsqueeze(-1).expand(-1, 2)
    chassis_half = torch.tensor([0.48, 0.3965], dtype=torch.float64)
    distance = geometry.rectangle_distance(scenario["robot_pose"], chassis_half, scenario["object_pose"], object_half)
    assert distance.min() >= 0.1 - 1e-12


@pytest.mark.parametrize(
    "overrides", [{"seed": -1}, {"seed": 2**63 + 1}, {"episodes": [-1]}, {"max_obstacles": 7}, {"max_obstacles": -1}]
)
def test_out_of_range_arguments_are_refused_in_one_line(overrides: dict[str, Any]):
    """Catches a negative index that wraps around to a scene of its own."""
    with pytest.raises(ValueError, match=r"^\w+ is .*; accepted: ") as error:
        _sample(**overrides)
    assert "\n" not in str(error.value)


def _empty(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.zeros(count, 6, dtype=torch.bool), torch.full((count, 6, 3), torch.nan, dtype=torch.float64)


def _world(scenario: TensorDict, time: float, shift: float = 0.0) -> dict[str, torch.Tensor]:
    """Return the start of a scenario, the robot and the object moved ahead along x."""
    move = torch.tensor([shift, 0.0, 0.0], dtype=torch.float64)
    return {
        "time": torch.full((len(scenario),), time, dtype=torch.float64),
        "base_pose": scenario["robot_pose"] + move,
        "tcp_position": _tcp(scenario, REACH) + move[:2],
        "object_pose": scenario["object_pose"] + move,
    }


def _boundary_points(pose: np.ndarray, half: np.ndarray) -> np.ndarray:
    step = np.linspace(-1, 1, 21)
    one = np.ones_like(step)
    local = np.concatenate([np.stack(p, -1) for p in ((step, one), (step, -one), (one, step), (-one, step))]) * half
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    return local @ np.array([[cosine, sine], [-sine, cosine]]) + pose[:2]


def _place_at(scenario: TensorDict, place: torch.Tensor, count: int = 1) -> TensorDict:
    scenario = scenario.clone()
    scenario["adversarial"] = torch.zeros_like(scenario["adversarial"])
    scenario["num_obstacles"] = torch.full_like(scenario["num_obstacles"], count)
    scenario["obstacle_time"] = torch.zeros_like(scenario["obstacle_time"])
    scenario["obstacle_yaw"] = torch.zeros_like(scenario["obstacle_yaw"])
    scenario["obstacle_edge"] = torch.full_like(scenario["obstacle_edge"], 1.0)
    scenario["obstacle_place"] = place
    return scenario


def _uniform_of(x: float, y: float) -> tuple[float, float]:
    """Return the uniforms that put an obstacle at a place of the region x in [3, 11], y in [-3, 3]."""
    return (x - 3) / 8, (y + 3) / 6


def test_an_obstacle_takes_its_first_place_with_room():
    """Catches a last or a random choice among the places, and a clearance taken from centres in place of surfaces."""
    scenario = _sample(episodes=[0])
    places = torch.tensor([_uniform_of(5.0, 0.0), _uniform_of(8.0, 1.0)] + [_uniform_of(9.0, 1.0)] * 6).double()
    scenario = _place_at(scenario, places.expand(1, 6, 8, 2).clone())
    scenario["object_edge"] = torch.tensor([1.0], dtype=torch.float64)
    world = {
        "time": torch.tensor([0.0], dtype=torch.float64),
        "base_pose": torch.tensor([[0.0, 0.0, 0.0]], dtype=torch.float64),
        "tcp_position": torch.tensor([[0.9, 0.0]], dtype=torch.float64),
    }
    # Object's front face at x + 0.5, obstacle's rear face at 4.5: the gap is 4 - x. At x = 2.99 it is 1.01, at 3.01
    # it is 0.99 and the second place is taken.
    for object_x, expected in ((2.99, 5.0), (3.01, 8.0)):
        object_pose = torch.tensor([[object_x, 0.0, 0.0]], dtype=torch.float64)
        active, pose = spawn_obstacles(CONFIG, scenario, *_empty(1), object_pose=object_pose, **world)
        assert active.tolist() == [[True, False, False, False, False, False]]
        assert pose[0, 0, 0].item() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("base", "tcp", "is_free"),
    [
        # An obstacle of edge 1 at (5, 0): its rear face at x = 4.5, its sides at |y| = 0.5.
        ((3.01, 0.0, 0.0), (3.49, 0.0), True),  # chassis' front at 3.49: 1.01 m
        ((3.03, 0.0, 0.0), (3.51, 0.0), False),  # 0.99 m
        ((2.0, 0.0, 0.0), (3.49, 0.0), True),  # the arm's tip at 3.49
        ((2.0, 0.0, 0.0), (3.51, 0.0), False),
        ((5.0, 1.91, 0.0), (5.9, 1.91), True),  # chassis' side at 1.91 - 0.3965 = 1.5135
        ((5.0, 1.89, 0.0), (5.9, 1.89), False),  # 1.4935
    ],
)
def test_an_obstacle_keeps_clear_of_chassis_and_arm(base: tuple, tcp: tuple, is_free: bool):
    """Catches an obstacle that appears on the robot, the arm included."""
    scenario = _place_at(_sample(episodes=[0]), torch.tensor(_uniform_of(5.0, 0.0)).double().expand(1, 6, 8, 2).clone())
    active, _ = spawn_obstacles(
        CONFIG,
        scenario,
        *_empty(1),
        time=torch.tensor([0.0], dtype=torch.float64),
        base_pose=torch.tensor([base], dtype=torch.float64),
        tcp_position=torch.tensor([tcp], dtype=torch.float64),
        object_pose=torch.tensor([[-20.0, 0.0, 0.0]], dtype=torch.float64),
    )
    assert active[0, 0].item() == is_free


def test_obstacles_of_one_call_keep_clear_of_each_other():
    """Catches a check against the obstacles before the call only."""
    # Circumscribed circles of two cubes of edge 1: 2 * 0.7071 + 0.1 = 1.5142 m between centres.
    for distance, both in ((1.52, True), (1.51, False)):
        places = torch.zeros(1, 6, 8, 2, dtype=torch.float64)
        places[0, 0] = torch.tensor(_uniform_of(6.0, 0.0))
        places[0, 1] = torch.tensor(_uniform_of(6.0 + distance, 0.0))
        scenario = _place_at(_sample(episodes=[0]), places, count=2)
        active, _ = spawn_obstacles(CONFIG, scenario, *_empty(1), **_world(scenario, 0.0))
        assert active[0, :2].tolist() == [True, both]


def test_obstacles_appear_at_their_time_and_stay():
    """Catches obstacles that come early, more of them than the scene has, or ones that move once they are there."""
    scenario = _sample(ScenarioConfig(kind="uniform"), range(500))
    active, pose = _empty(500)
    for step in range(0, 80, 4):
        time = 0.2 * step
        before_active, before_pose = active.clone(), pose.clone()
        active, pose = spawn_obstacles(CONFIG, scenario, before_active, before_pose, **_world(scenario, time))
        assert (scenario["obstacle_time"][active] <= time).all()
        assert (active | ~before_active).all()
        assert torch.equal(pose[before_active], before_pose[before_active])
    assert (active.sum(-1) <= scenario["num_obstacles"]).all()
    slot = torch.arange(6)
    assert not (active & (slot >= scenario["num_obstacles"].unsqueeze(-1))).any()
    # With eight fallbacks in 48 square metres nearly every obstacle finds room.
    assert active.sum() >= 0.97 * scenario["num_obstacles"].sum()
    assert pose[active].isfinite().all()
    assert torch.equal(pose[..., 2][active], scenario["obstacle_yaw"][active])


def test_inputs_are_not_mutated():
    """Catches an environment whose previous state changes under its feet."""
    scenario = _sample(episodes=range(20))
    active, pose = _empty(20)
    spawn_obstacles(CONFIG, scenario, active, pose, **_world(scenario, 15.0))
    assert not active.any()
    assert pose.isnan().all()
    idle_active, idle_pose = spawn_obstacles(CONFIG, scenario, active, pose, **_world(scenario, -1.0))
    assert idle_active.data_ptr() != active.data_ptr()
    assert idle_pose.data_ptr() != pose.data_ptr()


def test_an_obstacle_waits_until_there_is_room():
    """Catches an obstacle that is dropped, or forced into the robot, when all its places are taken."""
    scenario = _place_at(_sample(episodes=[0]), torch.tensor(_uniform_of(5.0, 0.0)).double().expand(1, 6, 8, 2).clone())
    world = _world(scenario, 3.0)
    near = torch.tensor([[5.0, 0.0, 0.0]], dtype=torch.float64)
    active, pose = spawn_obstacles(CONFIG, scenario, *_empty(1), **(world | {"object_pose": near}))
    assert not active.any()
    active, pose = spawn_obstacles(CONFIG, scenario, active, pose, **world)
    assert active[0, 0]
    torch.testing.assert_close(pose[0, 0], torch.tensor([5.0, 0.0, 0.0], dtype=torch.float64))


def test_adversarial_obstacles_lie_on_the_line_from_the_object_now_to_the_goal():
    """Catches a line from the start in place of the present, and places outside the region."""
    scenario = _sample(ScenarioConfig(kind="adversarial"), range(NUM_SCENES))
    world = _world(scenario, 15.0, shift=2.5)
    world["object_pose"] = world["object_pose"] + torch.tensor([0.0, 2.0, 0.0], dtype=torch.float64)
    active, pose = spawn_obstacles(CONFIG, scenario, *_empty(NUM_SCENES), **world)
    start, goal = world["object_pose"][:, None, :2].numpy(), scenario["goal_pose"][:, None, :2].numpy()
    line, offset = goal - start, pose[..., :2].numpy() - start
    length = np.linalg.norm(line, axis=-1)
    lateral = ((line[..., 0] * offset[..., 1] - line[..., 1] * offset[..., 0]) / length)[active.numpy()]
    along = ((line * offset).sum(-1) / length**2)[active.numpy()]
    assert len(lateral) > 5000
    assert 0.29 < np.abs(lateral).max() <= 0.3 + 1e-12
    assert abs(lateral.mean()) < 0.02
    assert 0 <= along.min() <= along.max() <= 1
    x = pose[..., 0][active]
    assert 3 <= x.min() <= x.max() <= 11


def test_uniform_obstacles_fill_the_region():
    """Catches places that are confined to a part of the region."""
    scenario = _sample(ScenarioConfig(kind="uniform"), range(NUM_SCENES))
    active, pose = spawn_obstacles(CONFIG, scenario, *_empty(NUM_SCENES), **_world(scenario, 15.0, shift=-5.0))
    x, y = pose[active][:, 0], pose[active][:, 1]
    assert 3 <= x.min() < 3.05
    assert 10.95 < x.max() <= 11
    assert -3 <= y.min() < -2.95
    assert 2.95 < y.max() <= 3


@pytest.mark.parametrize("shift", [0.0, 3.0, 7.0])
def test_clearance_is_never_violated_over_thousands_of_scenes(shift: float):
    """Catches an obstacle in reach of robot or object when it appears, measured on sampled boundaries."""
    scenario = _sample(episodes=range(NUM_SCENES // 4))
    world = _world(scenario, 15.0, shift)
    active, pose = spawn_obstacles(CONFIG, scenario, *_empty(len(scenario)), **world)
    edge = scenario["obstacle_edge"].numpy()
    for row in range(len(scenario)):
        slots = active[row].nonzero()[:, 0].tolist()
        object_half = np.full(2, scenario["object_edge"][row].item() / 2)
        base, tcp = world["base_pose"][row].numpy(), world["tcp_position"][row].numpy()
        front = base[:2] + 0.48 * np.array([np.cos(base[2]), np.sin(base[2])])
        surface = np.concatenate(
            [
                _boundary_points(world["object_pose"][row].numpy(), object_half),
                _boundary_points(base, np.array([0.48, 0.3965])),
                front + np.linspace(0, 1, 11)[:, None] * (tcp - front),
            ]
        )
        for slot in slots:
            boundary = _boundary_points(pose[row, slot].numpy(), np.full(2, edge[row, slot] / 2))
            assert np.linalg.norm(surface[:, None] - boundary[None], axis=-1).min() >= 1.0
            for other in slots:
                needed = (edge[row, slot] + edge[row, other]) * math.sqrt(0.5) + 0.1
                apart = np.linalg.norm((pose[row, slot] - pose[row, other]).numpy()[:2])
                assert other == slot or apart >= needed - 1e-12


def test_spawning_is_bitwise_independent_of_the_batch():
    """Catches places that depend on the other worlds of the batch."""
    scenario = _sample(episodes=range(64))
    world = _world(scenario, 8.0, shift=1.0)
    active, pose = spawn_obstacles(CONFIG, scenario, *_empty(64), **world)
    assert active.any()
    for i in range(64):
        rows = slice(i, i + 1)
        one_active, one_pose = spawn_obstacles(
            CONFIG, scenario[rows], *_empty(1), **{key: value[rows] for key, value in world.items()}
        )
        assert torch.equal(one_active[0], active[i])
        assert torch.equal(one_pose[0].nan_to_num(), pose[i].nan_to_num())
