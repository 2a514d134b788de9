"""What is drawn and tabled is what happened."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from cura_torchrl.envs.config import MapConfig, PushEnvConfig, ScenarioConfig, TaskConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.robots.ridgeback_franka import HOME, HOME_TCP
from cura_torchrl.envs.robots.scripted import ScriptedPusher
from cura_torchrl.envs.simulation.interface import WorldState
from cura_torchrl.trainers.build import Networks, make_env
from cura_torchrl.trainers.methods import method
from cura_torchrl.trainers.pictures.recording import Recorder, Recording, choose_scenes, find_scene, record
from tests.recordings import make_episode, make_recording

SCENARIO = ScenarioConfig(max_obstacles=2)


@pytest.mark.parametrize("name", ["cura-ppo", "cura-cvar", "cura-perceptual"])
def test_risk_and_uncertainty_are_those_that_the_policy_is_charged_for(name: str) -> None:
    """Catches mean and variance of the atoms in pictures of a method whose costs are others."""
    (recording, _) = play(stride=2, name=name)
    atoms = recording.atoms.astype(np.float64)
    mean, variance = atoms.mean(1), ((atoms - atoms.mean(1, keepdims=True)) ** 2).mean(1)
    # The largest quarter of 50 atoms: 12 and half of the next.
    largest = -np.sort(-atoms.clip(0.0, 1.0), 1)
    tail = (largest[:, :12].sum(1) + 0.5 * largest[:, 12]) / 12.5
    np.testing.assert_allclose(recording.risk, tail if name == "cura-cvar" else mean, atol=1e-6)
    if name == "cura-perceptual":
        assert np.abs(recording.uncertainty - variance).max() > 1e-4
    else:
        np.testing.assert_allclose(recording.uncertainty, variance, atol=1e-6)


def test_appearance_is_the_time_of_the_first_state_with_the_obstacle() -> None:
    """Catches obstacles that are dated by slot or by the last state."""
    appearances = make_recording().appearances
    assert appearances[1] == pytest.approx(0.4)
    assert np.isnan(np.delete(appearances, 1)).all()


def test_clearance_is_from_the_nearest_of_chassis_arm_and_object() -> None:
    """Catches a body that is left out, or obstacles that count before they appear."""
    ahead = make_recording()
    assert ahead.clearance[:2].tolist() == [math.inf, math.inf]
    # Last state: object's front at 3 + 1.5 + 0.5 = 5.0 m, obstacle's face at 8 - 0.2 = 7.8 m.
    assert ahead.min_clearance == pytest.approx(2.8, abs=1e-5)
    aside = np.zeros((7, 6, 4), dtype=np.float32)
    # Last state: arm from x = 3.48 to 3.9 m, 0.15 m to each side; obstacle's near corner at (4.2, 0.1).
    aside[:, 0] = (4.4, 0.3, 0.0, 0.4)
    far = make_recording().object_pose + np.array([20.0, 0.0, 0.0], dtype=np.float32)
    assert make_recording(obstacles=aside, object_pose=far).clearance[-1] == pytest.approx(0.3, abs=1e-5)
    behind = np.zeros((7, 6, 4), dtype=np.float32)
    # Chassis' rear at 3 - 0.48 = 2.52 m in the last state; obstacle's face at 2.0 m.
    behind[:, 0] = (1.8, 0.0, 0.0, 0.4)
    assert make_recording(obstacles=behind).clearance[-1] == pytest.approx(0.52, abs=1e-5)


def test_without_an_arm_the_clearance_is_that_of_the_chassis() -> None:
    """Catches a strip for an arm that is not there, which would stick out of the front face by its half width."""
    along, zero = 0.5 * np.arange(7), np.zeros(7)
    face = np.stack([along + 0.48, zero], -1).astype(np.float32)
    obstacles = np.zeros((7, 6, 4), dtype=np.float32)
    # Chassis' front at 3 + 0.48 = 3.48 m in the last state; obstacle's face at 3.9 m.
    obstacles[:, 0] = (4.1, 0.0, 0.0, 0.4)
    far = make_recording().object_pose + np.array([20.0, 0.0, 0.0], dtype=np.float32)
    recording = make_recording(tcp=face, obstacles=obstacles, object_pose=far)
    assert recording.clearance[-1] == pytest.approx(0.42, abs=1e-5)
    assert (recording.has_arm, make_recording().has_arm) == (False, True)


def test_final_distance_is_that_of_the_last_state() -> None:
    """Catches the distance of the first state, or of the robot."""
    # Object at (4.5, 0), goal at (12, 1): sqrt(7.5^2 + 1).
    assert make_recording().final_distance == pytest.approx(math.sqrt(57.25))


@pytest.mark.parametrize(
    ("outcome", "words"),
    [
        ("success", "goal reached after 1.2 s"),
        ("collision", "collision of the object after 1.2 s"),
        ("time-out", "time-out after 1 s, 7.6 m from the goal"),
    ],
)
def test_outcome_is_said_in_words(outcome: str, words: str) -> None:
    """Catches an outcome that is named wrongly: 6 steps of 0.2 s are 1.2 s."""
    recording = make_recording(outcome=outcome)
    assert recording.outcome == outcome
    assert recording.describe() == words


def test_object_in_base_turns_with_the_base() -> None:
    """Catches a pose that is only shifted: a base that looks along y has what lies at +x on its right."""
    base = np.tile(np.array([1.0, 2.0, math.pi / 2], dtype=np.float32), (7, 1))
    pose = np.tile(np.array([4.0, 2.0, 0.0], dtype=np.float32), (7, 1))
    local = make_recording(base_pose=base, object_pose=pose).object_in_base(0)
    assert local == pytest.approx((0.0, -3.0, -math.pi / 2), abs=1e-6)


def test_scenes_are_half_of_each_kind_with_sizes_in_turn_and_obstacles() -> None:
    """Catches a choice that favours a kind or a size, or that shows scenes with nothing to avoid."""
    scenes = choose_scenes(SCENARIO, seed=3, count=4)
    assert [scene.adversarial for scene in scenes] == [True] * 4 + [False] * 4
    assert [scene.object_edge for scene in scenes] == [0.5, 0.75, 1.0, 0.5] * 2
    assert len({scene.index for scene in scenes}) == 8
    assert choose_scenes(SCENARIO, seed=3, count=2)[:2] == scenes[:2]
    env = PushEnv(8, PushEnvConfig(task=TaskConfig(scenario=SCENARIO, stream="eval")), seed=3)
    env.reset(episodes=torch.tensor([scene.index for scene in scenes]))
    try:
        played = env.scenario
        assert (played["num_obstacles"] >= 1).all()
        assert played["adversarial"].tolist() == [scene.adversarial for scene in scenes]
        assert played["object_edge"].tolist() == [scene.object_edge for scene in scenes]
        assert played["goal_pose"].tolist() == [list(scene.goal_pose) for scene in scenes]
    finally:
        env.close()


def test_one_scene_is_that_of_its_index() -> None:
    """Catches another stream, seed or index than that which evaluate plays."""
    chosen = choose_scenes(SCENARIO, seed=3, count=1)[0]
    assert find_scene(SCENARIO, seed=3, index=chosen.index) == chosen


def test_more_scenes_than_there_are_are_refused() -> None:
    """Catches a silent shortage: the summary would then be of fewer scenes than asked for."""
    with pytest.raises(ValueError, match="number of scenes is 200; accepted"):
        choose_scenes(SCENARIO, seed=0, count=200)


def state(step: int, *, done: tuple[bool, bool] = (False, False)) -> TensorDict:
    """What two worlds emit: the second base stands 10 m aside; the scan is 1 m longer with every step."""
    base = torch.tensor([[0.1 * step, 0.0, 0.0], [0.1 * step, 10.0, 0.0]])
    observation = torch.zeros(2, 33)
    observation[:, 0] = 0.9
    return TensorDict(
        {
            "observation": observation,
            "latent": torch.zeros(2, 32),
            "sensor_pose": base,
            "object_pose": base,
            "obstacles": torch.zeros(2, 6, 4),
            "confidence_map": torch.full((2, 2, 4, 4), 0.5),
            "scan": torch.full((2, 8), 1.0 + step),
            "done": torch.tensor(done)[:, None],
        },
        [2],
    )


def worlds(step: int) -> WorldState:
    """Where the two worlds' bodies are: joints and heights grow with every step."""
    two = torch.ones(2, 1, dtype=torch.float64)
    return WorldState(
        base_pose=torch.zeros(2, 3),
        base_velocity=torch.zeros(2, 3),
        joint_position=step * two.expand(2, 7),
        joint_velocity=torch.zeros(2, 7),
        object_position=10 * step * two.expand(2, 3),
        object_quaternion=torch.tensor([[0.0, 0.0, 0.0, 1.0]] * 2),
        object_velocity=torch.zeros(2, 3),
        object_angular_velocity=torch.zeros(2, 3),
        contact=torch.zeros(2, 3, dtype=torch.bool),
    )


def estimate(seen: TensorDict) -> TensorDict:
    """Two atoms made of the observation."""
    atoms = seen["observation"][:, :2]
    moments = {"risk": atoms.mean(1, keepdim=True), "uncertainty": atoms.var(1, correction=0, keepdim=True)}
    return seen.update({"collision_atoms": atoms, **moments})


def test_a_recording_ends_with_its_episode_and_keeps_its_last_frame() -> None:
    """Catches rows that go on while others play, and a last state without picture."""
    recorder = Recorder(estimate, 2, stride=3)
    over = torch.tensor([True, False])
    recorder(state(0), torch.tensor([True, True]), worlds(0))
    recorder(state(1), torch.tensor([True, True]), worlds(1))
    recorder(state(2, done=(False, True)), torch.tensor([True, True]), worlds(2))
    for step in (3, 4):
        recorder(state(step, done=(step == 4, False)), over, worlds(step))
    env = make_env(method("push").replace(perception="none"), 1, keep_map=True)
    try:
        first, second = recorder.recordings(
            [make_episode(index=1), make_episode(index=2)], [make_recording().scene] * 2, label="x", env=env
        )
    finally:
        env.close()
    assert first.frame_steps.tolist() == [0, 3, 4]
    assert second.frame_steps.tolist() == [0, 2]
    assert len(first.base_pose) == len(first.atoms) == 5
    assert len(second.base_pose) == len(second.atoms) == 3
    assert second.scans[:, 0].tolist() == [1.0, 3.0]
    assert first.arm_joints[:, 6].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert second.object_position[:, 2].tolist() == [0.0, 10.0, 20.0]
    assert second.tcp.tolist() == pytest.approx(np.array([[0.9, 10.0], [1.0, 10.0], [1.1, 10.0]]))
    assert (first.maps == 128).all()


def play(stride: int, name: str = "push") -> list[Recording]:
    """Play two scenes for 1 s with the scripted pusher and an untrained estimator."""
    torch.manual_seed(0)
    task = TaskConfig(scenario=SCENARIO, stream="eval", episode_time=1.0, privileged=True)
    config = method(name).replace(perception="none", env=PushEnvConfig(task=task), map=MapConfig(extent_x=(-4.0, 4.0)))
    env = make_env(config, 2, keep_map=True, seed=0)
    try:
        scenes = choose_scenes(SCENARIO, seed=0, count=1)
        estimator = Networks(config).collision_network
        return record(env, ScriptedPusher(), estimator, scenes, label="Scripted", stride=stride)
    finally:
        env.close()


def test_recording_holds_what_the_environment_played() -> None:
    """Catches arrays of the wrong scene, frame or time; two runs are bitwise the same."""
    first, second = play(stride=2), play(stride=2)
    for one, other in zip(first, second, strict=True):
        for item in dataclasses.fields(one):
            assert np.array_equal(getattr(one, item.name), getattr(other, item.name)), item.name
        assert len(one.base_pose) == 6  # 1 s at 5 Hz, and the start
        assert one.frame_steps.tolist() == [0, 2, 4, 5]
        assert one.maps.shape == (4, 2, 100, 100)
        assert one.atoms.shape == (6, 50)
        assert one.episode.index == one.scene.index
        assert one.period == 0.2
        assert one.arm_joints[0] == pytest.approx(HOME, abs=1e-5)
        # The cube stands on the floor, where the planar pose says.
        assert one.object_position[:, 2] == pytest.approx(np.full(6, one.scene.object_edge / 2), abs=0.01)
        assert one.object_position[:, :2].tolist() == one.object_pose[:, :2].tolist()
        assert np.linalg.norm(one.object_quaternion, axis=1) == pytest.approx(np.ones(6), abs=1e-5)
        reach = np.linalg.norm(one.tcp[0] - one.base_pose[0, :2])
        assert reach == pytest.approx(HOME_TCP[0], abs=5e-3)
        # The start has the object at x = 0 and the goal 12 to 14 m ahead.
        assert one.goal_distance[0] == pytest.approx(math.hypot(*(one.object_pose[0, :2] - one.scene.goal_pose[:2])))
        assert 11.0 < one.goal_distance[0] < 15.0
