"""The pushing environment: TorchRL's contract, and what begins, changes and ends an episode."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import pytest
import torch

from cura_torchrl.envs.config import LidarConfig, PushEnvConfig, RobotConfig, ScenarioConfig, TaskConfig
from cura_torchrl.envs.mdp.observations import OBSERVATION_SLICES
from cura_torchrl.envs.push import PushEnv
from tests.contracts.env import LIMIT, EnvContract, assert_same, draw_actions, play
from tests.worlds import place

if TYPE_CHECKING:
    from collections.abc import Iterator

PERIOD = 0.2
"""Time of a policy step [s]."""


def make_config(
    limit: int = LIMIT, *, lidar: LidarConfig | None = None, task: dict[str, Any] | None = None, **scenario: Any
) -> PushEnvConfig:
    """Return a config whose episodes last ``limit`` steps and whose obstacles appear within 2 s."""
    scene = ScenarioConfig(**({"obstacle_time": (0.0, 2.0)} | scenario))
    tasks = TaskConfig(scenario=scene, episode_time=limit * PERIOD, **(task or {}))
    return PushEnvConfig(task=tasks, lidar=lidar or LidarConfig())


class TestPushEnv(EnvContract):
    """What every environment keeps to."""

    def make_env(self, num_envs: int, *, limit: int = LIMIT, **kwargs: Any) -> PushEnv:
        """Return the environment on PyBullet."""
        return PushEnv(num_envs, make_config(limit), **kwargs)


class TestPlanarPushEnv(EnvContract):
    """The same on the planar simulator."""

    def make_env(self, num_envs: int, *, limit: int = LIMIT, **kwargs: Any) -> PushEnv:
        """Return the environment on tensors."""
        return PushEnv(num_envs, dataclasses.replace(make_config(limit), simulator="planar"), **kwargs)


BARE = {"robot": RobotConfig(model="ridgeback")}
"""Changes that take the arm away."""


class TestBasePushEnv(EnvContract):
    """The same without an arm, on PyBullet."""

    def make_env(self, num_envs: int, *, limit: int = LIMIT, **kwargs: Any) -> PushEnv:
        """Return the environment of the bare base on PyBullet."""
        return PushEnv(num_envs, dataclasses.replace(make_config(limit), **BARE), **kwargs)


class TestPlanarBasePushEnv(EnvContract):
    """The same without an arm, on the planar simulator."""

    def make_env(self, num_envs: int, *, limit: int = LIMIT, **kwargs: Any) -> PushEnv:
        """Return the environment of the bare base on tensors."""
        return PushEnv(num_envs, dataclasses.replace(make_config(limit), simulator="planar", **BARE), **kwargs)


@pytest.fixture
def make() -> Iterator[Any]:
    """Build environments that are closed after the test."""
    envs: list[PushEnv] = []

    def build(num_envs: int = 1, config: PushEnvConfig | None = None, **kwargs: Any) -> PushEnv:
        envs.append(PushEnv(num_envs, make_config() if config is None else config, **kwargs))
        return envs[-1]

    yield build
    for env in envs:
        env.close()


def steady(env: PushEnv, steps: int, *action: float) -> torch.Tensor:
    """Return one action for all rows and steps, shape ``[T, N, 6]``."""
    return torch.tensor(action).expand(steps, env.num_envs, len(action))


def obstructed(x: float, y: float, **overrides: Any) -> PushEnvConfig:
    """Return a config with one obstacle at (x, y), edge 0.4, from the first step on.

    The object (edge 0.5) stands straight at the origin, the robot straight behind it: TCP at x = -0.25 - 0.2 = -0.45,
    base at x = -0.45 - 0.9 = -1.35, its chassis from -1.83 to -0.87 and 0.3965 to each side.
    """
    zero = (0.0, 0.0)
    scene = {"object_edges": (0.5,), "object_y": zero, "object_yaw": zero, "start_gap": (0.2, 0.2)}
    scene |= {"start_lateral": zero, "start_yaw": zero, "kind": "uniform", "obstacle_time": zero}
    scene |= {"obstacle_x": (x, x), "obstacle_y": (y, y), "obstacle_edges": (0.4,), "obstacle_clearance": 0.05}
    return make_config(**({"limit": 12} | scene | overrides))


@pytest.mark.parametrize(
    ("place", "action", "expected"),
    [
        # Distances to the obstacle's circumscribed circle, radius 0.283.
        ((-2.4, 0.0), (-1.0, 0.0, 0.0), [True, False, False]),  # chassis' rear at -1.83: 0.29 m, backwards
        ((-0.35, 0.75), (0.0, 1.0, 0.0), [False, True, False]),  # ahead of the chassis, 0.37 m beside the hand
        ((0.75, 0.0), (1.0, 0.0, 0.0), [False, False, True]),  # 0.2 m before the object, which the hand pushes
    ],
)
def test_a_collision_terminates_and_tells_what_touched(make, place, action, expected):
    """Catches contacts with mixed-up bodies, a cost that is not 1, and a reward that is dropped in the last step."""
    env = make(1, obstructed(*place))
    root = env.reset(episodes=torch.tensor([2]))  # three obstacles, of which two find no room
    assert env.obstacles[0].sum() == 1
    data = play(env, steady(env, 10, *action, 0.0, 0.0, 0.0), root)[0]
    after = data["next"]
    step = int(after["terminated"].int().argmax())
    assert after["terminated"][step]
    assert after["contact"][step].tolist() == expected
    assert (after["cost"][: step + 1, 0] == torch.tensor([0.0] * step + [1.0])).all()
    assert after["done"][step]
    assert not after["truncated"][step]
    # The reward stays the sum of its terms: the paper has no penalty for a collision, the cost says it.
    assert after["reward_terms"][step, 0] > 0
    torch.testing.assert_close(after["reward"][step, 0], after["reward_terms"][step].sum())
    assert data["elapsed_steps"][step + 1] == 0
    assert not data["contact"][step + 1].any()


@pytest.mark.parametrize("simulator", ["bullet", "planar"])
@pytest.mark.parametrize(
    ("place", "action", "expected"),
    [
        # The base stands at x = -0.45 - 0.48 = -0.93: its chassis from -1.41 to the face at -0.45.
        ((-2.0, 0.0), (-1.0, 0.0, 0.0), [True, False, False]),  # 0.31 m behind the chassis, backwards
        ((-0.55, 0.85), (0.0, 1.0, 0.0), [True, False, False]),  # beside the face, where an arm's hand would be
        ((0.75, 0.0), (1.0, 0.0, 0.0), [False, False, True]),  # 0.2 m before the object, which the face pushes
    ],
)
def test_a_bare_base_tells_what_touched(make, simulator, place, action, expected):
    """Catches contacts of an arm that is not there, and a face that does not push."""
    env = make(1, dataclasses.replace(obstructed(*place), simulator=simulator, **BARE))
    root = env.reset(episodes=torch.tensor([2]))
    assert env.obstacles[0].sum() == 1
    after = play(env, steady(env, 10, *action), root)[0]["next"]
    step = int(after["terminated"].int().argmax())
    assert after["terminated"][step]
    assert after["contact"][step].tolist() == expected


@pytest.mark.parametrize("simulator", ["bullet", "planar"])
def test_without_an_arm_the_face_is_the_tcp(make, simulator):
    """Catches a start gap, an observation or a reward that is measured from elsewhere than the face's centre."""
    env = make(1, dataclasses.replace(obstructed(9.0, 3.0), simulator=simulator, **BARE))
    data = env.reset(episodes=torch.tensor([2]))
    torch.testing.assert_close(data["sensor_pose"], torch.tensor([[-0.93, 0.0, 0.0]]))
    seen = {name: data["observation"][0, part] for name, part in OBSERVATION_SLICES.items()}
    assert seen["tcp_position"].tolist() == pytest.approx([0.48, 0.0, 0.18])
    assert seen["hand_axes"].tolist() == [1.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    assert seen["previous_action"].shape == (3,)
    after = env.step(data.set("action", torch.tensor([[0.2, -0.1, 0.5]])))["next"]
    seen = {name: after["observation"][0, part] for name, part in OBSERVATION_SLICES.items()}
    vx, vy, wz = seen["base_velocity"].tolist()
    assert seen["tcp_velocity"].tolist() == pytest.approx([vx, vy + 0.48 * wz, 0.0], abs=1e-6)
    assert seen["previous_action"].tolist() == pytest.approx([0.2, -0.1, 0.5])
    x, y, yaw = after["sensor_pose"][0].double().tolist()
    face = torch.tensor([x + 0.48 * math.cos(yaw), y + 0.48 * math.sin(yaw), 0.18], dtype=torch.float64)
    # The object stands straight at the origin, its centre 0.25 m above the ground.
    point = env.scenario["surface_point"][0] + torch.tensor([0.0, 0.0, 0.25])
    expected = math.exp(-0.1 * (point - face).norm().item())
    assert after["reward_terms"][0, 3].item() == pytest.approx(expected, abs=1e-3)
    # The base was at rest: acceleration is velocity over 0.2 s.
    assert after["reward_terms"][0, 5].item() == pytest.approx(-0.1 * math.hypot(vx, vy, wz) / 0.2, rel=1e-4)


def test_the_time_limit_truncates_and_nothing_else_ends_an_episode(make):
    """Catches a limit that is off by one step, or that counts as a true end and forbids bootstrapping."""
    env = make(1, make_config(3, max_obstacles=0))
    after = play(env, steady(env, 6, *[0.0] * 6))[0]["next"]
    assert after["truncated"].flatten().tolist() == [False, False, True] * 2
    assert not after["terminated"].any()
    assert (after["cost"] == 0).all()


def test_an_episode_plays_on_after_success_and_is_then_truncated(make):
    """Catches success as a true end, which teaches a policy to loiter outside the goal, or without time to play on."""
    near = {"goal_x": (0.4, 0.4), "goal_y": (0.0, 0.0), "object_y": (0.0, 0.0), "max_obstacles": 0}
    env = make(1, make_config(20, task={"success_time": 2 * PERIOD}, **near))
    after = play(env, steady(env, 6, *[0.0] * 6))[0]["next"]
    # The goal is 0.4 m away: within the first tolerance of 0.5 m at once, never within 0.25 m. Reached in step 1, two
    # steps more are played.
    assert after["success"].tolist() == [[True, False, False]] * 6
    assert after["truncated"].flatten().tolist() == [False, False, True] * 2
    assert not after["terminated"].any()


def test_a_success_in_the_step_of_a_collision_does_not_count(make):
    """Catches success that is judged before contact."""
    env = make(1, obstructed(0.75, 0.0, goal_x=(0.0, 0.0), goal_y=(0.0, 0.0)))
    root = env.reset(episodes=torch.tensor([2]))
    # The object is at the goal from the start, and would succeed in the first step: make that the collision's.
    worlds, (_, pose, edge) = env._worlds, env.obstacles
    place(worlds, 0, 5, (0.3, 0.0, pose[0, 0, 2].item()), edge[0, 0].item())
    after = env.step(root.set("action", torch.zeros(1, 6)))["next"]
    assert after["contact"].tolist() == [[False, False, True]]
    assert not after["success"].any()


def test_the_curriculum_raises_k_with_the_frames_played(make):
    """Catches a K that stays, that counts steps of this process alone, or that reaches into a running episode."""
    env = make(2, make_config(2, task={"curriculum": ((0, 0), (30, 3), (60, 6))}), frames_per_step=10)
    seen = []
    data = env.reset()
    for action in steady(env, 8, *[0.0] * 6):
        seen.append((env.frames_done, env.max_obstacles, int(env.scenario["num_obstacles"].max())))
        data = env.step_and_maybe_reset(data.set("action", action))[1]
    assert [frames for frames, *_ in seen] == [0, 10, 20, 30, 40, 50, 60, 70]
    assert [most for _, most, _ in seen] == [0, 0, 0, 3, 3, 3, 6, 6]
    counts = [count for *_, count in seen]
    # Episodes start at 0, 20, 40 and 60 frames, with K of 0, 0, 3 and 6.
    assert counts[:4] == [0, 0, 0, 0]
    assert 0 < counts[4] == counts[5] <= 3
    assert make(1, make_config(task={"curriculum": ((100, 2),)})).max_obstacles == 0
    assert make(1, make_config(task={"curriculum": ((100, 2),)}), frames_done=100).max_obstacles == 2


def test_episodes_can_be_asked_for_and_the_sequence_goes_on_from_there(make):
    """Catches an evaluation that plays other scenes than it reports."""
    env = make(2, make_config(1))
    root = env.reset(episodes=torch.tensor([40, 7]))
    assert root["episode"].flatten().tolist() == [40, 7]
    data = play(env, steady(env, 3, *[0.0] * 6), root)
    assert data["episode"][..., 0].tolist() == [[40, 42, 44], [7, 9, 11]]
    single = make(1, make_config(1))
    assert_same(single.reset(episodes=torch.tensor([7]))[0], root[1])


def test_first_episode_and_stride_partition_the_scenes(make):
    """Catches workers that play the same scenes, or leave some out."""
    played = []
    for worker in (0, 1):
        env = make(2, make_config(1), first_episode=2 * worker, episode_stride=4)
        played.append(play(env, steady(env, 3, *[0.0] * 6))["episode"])
    assert sorted(torch.cat(played).flatten().tolist()) == list(range(12))


def test_a_seed_begins_a_worker_s_own_sequence_again(make):
    """Catches a seed after which the workers all play the scenes from 0 on, and ages that are spread only once."""
    env = make(2, make_config(10, task={"random_first_age": True}), first_episode=4, episode_stride=8)
    played = []
    for _ in range(2):
        env.set_seed(7)
        played.append(play(env, steady(env, 12, *[0.0] * 6)))
        assert played[-1]["episode"][:, 0].flatten().tolist() == [4, 5]
    assert_same(*played)


def test_first_episodes_may_start_at_spread_ages_of_the_time_limit(make):
    """Catches resets in lockstep, and an age that shortens later episodes or shows in the observed time."""
    env = make(4, make_config(10, task={"random_first_age": True}))
    data = play(env, steady(env, 18, *[0.0] * 6))
    after = data["next"]
    # Ages floor(10 frac(0.618 episode)) = 0, 6, 2, 8: the first episodes last 10, 4, 8 and 2 steps, later ones 10.
    firsts = [row.flatten().nonzero()[0].item() + 1 for row in after["truncated"]]
    assert firsts == [10, 4, 8, 2]
    assert [row.flatten().nonzero().flatten().tolist() for row in after["truncated"]][1:] == [[3, 13], [7, 17], [1, 11]]
    assert (data["elapsed_steps"][:, 0] == 0).all()


def test_privileged_observations_hold_the_true_obstacles(make):
    """Catches obstacles that are shown before they have appeared, and a key that is always there."""
    config = make_config(4, obstacle_time=(0.3, 0.3), task={"privileged": True})
    env = make(2, config, first_episode=2)
    data = play(env, steady(env, 3, *[0.0] * 6))
    mask, pose, edge = env.obstacles
    assert (data["next", "obstacles"][:, 0] == 0).all()  # 0.2 s
    assert mask.any(-1).all()
    torch.testing.assert_close(data["next", "obstacles"][:, 2, :, 3], (edge * mask).float())
    torch.testing.assert_close(data["next", "obstacles"][:, 2, :, :3], (pose * mask[..., None]).float())
    assert "obstacles" not in set(make(1).reset().keys())


def test_obstacles_appear_in_scan_and_worlds_at_once(make):
    """Catches an obstacle that is judged but not seen: the scan must show the world of the same moment."""
    env = make(1, obstructed(2.0, 2.0, obstacle_time=(0.3, 0.3), lidar=LidarConfig(noise=0.0, occlusion=False)))
    root = env.reset(episodes=torch.tensor([2]))
    data = play(env, steady(env, 3, *[0.0] * 6), root)[0]
    assert (data["scan"][0] == 10.0).all()
    assert (data["next", "scan"][0] == 10.0).all()  # 0.2 s
    # Its centre is (3.35, 2.0) from the base, sqrt(15.2225) = 3.902 m, its surface 0.2 to 0.283 m nearer.
    assert 3.902 - 0.284 <= data["next", "scan"][1].min().item() <= 3.902 - 0.199


def test_occlusion_is_a_property_of_the_rays_alone(make):
    """Catches a filter that changes the physics, and a scan that sees the object with occlusion off."""
    on, off = (make(1, make_config(max_obstacles=0, lidar=LidarConfig(occlusion=flag))) for flag in (True, False))
    actions = draw_actions(on, 3)
    one, other = play(on, actions), play(off, actions)
    assert (other["scan"] == 10.0).all()
    assert (one["scan"] < 2.0).any(-1).all()
    assert_same(one.exclude("scan", ("next", "scan")), other.exclude("scan", ("next", "scan")))


def test_bullet_does_not_write_to_stdout(make, capfd):
    """Catches Bullet's chatter in the JSON that a command prints."""
    env = make(1, make_config(2))
    env.rollout(4, break_when_any_done=False)
    env.close()
    assert capfd.readouterr().out == ""


def test_outputs_are_on_the_device_asked_for(make):
    """Catches tensordicts that the device argument does not reach."""
    data = make(1, device="cpu").rollout(1)
    assert data.device == torch.device("cpu")
    assert make(1).rollout(1).device is None


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (torch.zeros(2, 5), r"^action has shape \(2, 5\); accepted: \(2, 6\)$"),
        (torch.zeros(2, 7), r"^action has shape \(2, 7\); accepted: \(2, 6\)$"),
        (torch.tensor([[0.0] * 6, [float("nan")] * 6]), r"^action is not a number in rows \[1\]"),
    ],
)
def test_an_impossible_action_is_refused_before_anything_moves(make, action, message):
    """Catches a step of half a batch, after which worlds and counters disagree."""
    env, twin = make(2), make(2)
    root, other = env.reset(), twin.reset()
    with pytest.raises(ValueError, match=message):
        env.step(root.clone().set("action", action))
    good = torch.full((2, 6), 0.5)
    assert_same(*(each.step(data.set("action", good))["next"] for each, data in ((env, root), (twin, other))))


@pytest.mark.parametrize(
    "episodes", [torch.tensor([3]), torch.tensor([3, 4, 5]), torch.tensor([3.0, 4.0]), torch.tensor([3, -1])]
)
def test_impossible_episodes_are_refused_before_anything_is_reset(make, episodes):
    """Catches episodes that are broadcast, rounded or drawn from no scene, and a sequence that goes on from them."""
    env = make(2)
    env.reset()
    with pytest.raises(ValueError, match=r"^episodes are .*; accepted: 2 integers, 0 or more, one for each row$"):
        env.reset(episodes=episodes)
    assert env.reset()["episode"].flatten().tolist() == [2, 3]


def test_misuse_is_told_in_one_line(make):
    """Catches an empty batch, and a state that is read before there is one."""
    with pytest.raises(ValueError, match=r"^num_envs is 0; accepted: 1 or more$"):
        PushEnv(0)
    with pytest.raises(RuntimeError, match=r"^the environment has not been reset; accepted: reset\(\) before"):
        _ = make(1).world_state
