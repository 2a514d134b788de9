"""What happened in an episode, as arrays: what pictures are drawn from and numbers are read from."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from cura_torchrl import keys
from cura_torchrl.envs import geometry
from cura_torchrl.envs.mdp import scenarios
from cura_torchrl.envs.mdp.observations import OBSERVATION_SLICES
from cura_torchrl.envs.robots.ridgeback import CHASSIS_SIZE
from cura_torchrl.envs.robots.ridgeback_franka import HOME_TCP
from cura_torchrl.trainers.evaluation.episodes import Episode, play_episodes
from cura_torchrl.trainers.evaluation.measures import clearance

if TYPE_CHECKING:
    from collections.abc import Callable

    from tensordict import TensorDictBase
    from torchrl.envs import EnvBase

    from cura_torchrl.envs.config import ScenarioConfig
    from cura_torchrl.envs.simulation.interface import WorldState

_SEARCHED = 512
"""Scenarios of the stream among which scenes are looked for [1]."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """One frozen scenario, as far as pictures need it. World frame."""

    index: int
    """Index of the scenario in the evaluation stream [1]."""
    adversarial: bool
    """Whether obstacles appear on the object-to-goal line."""
    object_edge: float
    """Edge of the pushed cube [m]."""
    goal_pose: tuple[float, float, float]
    """Goal (x [m], y [m], yaw [rad])."""

    @property
    def kind(self) -> str:
        """Name of the scenario."""
        return "adversarial" if self.adversarial else "uniform"


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """An episode of T states, F of them with scan and map. World frame unless said otherwise."""

    label: str
    """Who played."""
    scene: Scene
    """What was played."""
    episode: Episode
    """How it ended."""
    period: float
    """Time from one state to the next [s]."""
    success_radius: float
    """Distance from object to goal that counts as success [m]."""
    resolution: float
    """Edge of a cell of the map [m]."""
    base_pose: NDArray[np.float32]
    """Base (x [m], y [m], yaw [rad]), shape ``[T, 3]``."""
    tcp: NDArray[np.float32]
    """TCP in the plane [m], shape ``[T, 2]``."""
    object_pose: NDArray[np.float32]
    """Object (x [m], y [m], yaw [rad]), shape ``[T, 3]``."""
    obstacles: NDArray[np.float32]
    """Obstacles (x [m], y [m], yaw [rad], edge [m]), edge 0 where none has appeared, shape ``[T, 6, 4]``."""
    arm_joints: NDArray[np.float32]
    """Joint positions of the arm [rad], shape ``[T, A]``."""
    object_position: NDArray[np.float32]
    """Centre of the object's cube [m], shape ``[T, 3]``."""
    object_quaternion: NDArray[np.float32]
    """Object's orientation, xyzw, shape ``[T, 4]``."""
    atoms: NDArray[np.float32]
    """The DCE's atoms of the collision possibility C, unsorted [1], shape ``[T, N]``."""
    risk: NDArray[np.float32]
    """R that the policy is charged for: the atoms' mean, unless its method has another one [1], shape ``[T]``."""
    uncertainty: NDArray[np.float32]
    """U that it is charged for: the atoms' variance, unless its method has another one [1], shape ``[T]``."""
    frame_steps: NDArray[np.int64]
    """States that have scan and map, shape ``[F]``; the last state is one of them."""
    scans: NDArray[np.float32]
    """LiDAR ranges [m], shape ``[F, R]``."""
    maps: NDArray[np.uint8]
    """Windows of the confidence map [1/255], base frame, shape ``[F, C, W, W]``."""

    @property
    def times(self) -> NDArray[np.floating]:
        """Time of each state [s], shape ``[T]``."""
        return np.arange(len(self.base_pose)) * self.period

    @cached_property
    def has_arm(self) -> bool:
        """Whether the TCP is a hand's, and not the centre of the chassis' front face."""
        reach = np.hypot(*(self.tcp - self.base_pose[:, :2]).T)
        return bool((reach > CHASSIS_SIZE[0] / 2 + scenarios.ARM_LEAST_REACH).any())

    @property
    def end_time(self) -> float:
        """Time of goal, collision or time-out [s]."""
        return self.episode.steps * self.period

    @property
    def goal_distance(self) -> NDArray[np.floating]:
        """Distance from object to goal [m], shape ``[T]``."""
        dx, dy = (self.object_pose[:, :2] - np.asarray(self.scene.goal_pose[:2], dtype=np.float64)).T
        return np.hypot(dx, dy)

    @property
    def final_distance(self) -> float:
        """Distance from object to goal in the last state [m]."""
        return float(self.goal_distance[-1])

    @cached_property
    def clearance(self) -> NDArray[np.float64]:
        """Distance from chassis, arm and object to the nearest obstacle [m], shape ``[T]``; infinite without one."""
        base, tcp, pushed = (torch.from_numpy(track).double() for track in (self.base_pose, self.tcp, self.object_pose))
        pose, half = scenarios.bodies(base, tcp, pushed, base.new_full((len(base),), self.scene.object_edge))
        return clearance(pose[:, None], half[:, None], torch.from_numpy(self.obstacles).double()).amin(1).numpy()

    @property
    def min_clearance(self) -> float:
        """Least clearance of the episode [m]; infinite where no obstacle appeared."""
        return float(self.clearance.min())

    @cached_property
    def appearances(self) -> NDArray[np.float64]:
        """Time at which each obstacle appeared [s], shape ``[6]``; NaN where it did not."""
        is_there = self.obstacles[..., 3] > 0
        return np.where(is_there.any(0), is_there.argmax(0) * self.period, np.nan)

    @property
    def outcome(self) -> str:
        """How the episode ended, in one word."""
        if self.episode.success[0]:
            return "success"
        return "collision" if self.episode.collision else "time-out"

    def object_in_base(self, step: int) -> tuple[float, float, float]:
        """Return the object's pose in the base frame.

        Args:
            step: Index of the state.

        Returns:
            (x [m], y [m], yaw [rad]).
        """
        base, pose = torch.from_numpy(self.base_pose[step]), torch.from_numpy(self.object_pose[step])
        x, y = geometry.to_frame(base, pose[:2]).tolist()
        return x, y, float(pose[2] - base[2])

    def describe(self) -> str:
        """Return how the episode ended, in words.

        Returns:
            One phrase with its time.
        """
        if self.outcome == "success":
            return f"goal reached after {self.end_time:.1f} s"
        if self.outcome == "collision":
            touched = zip(("base", "arm", "object"), self.episode.contact, strict=True)
            return f"collision of the {' and '.join(name for name, hit in touched if hit)} after {self.end_time:.1f} s"
        return f"time-out after {self.end_time:.0f} s, {self.final_distance:.1f} m from the goal"


def choose_scenes(config: ScenarioConfig, *, seed: int, count: int) -> list[Scene]:
    """Return the first scenarios of the evaluation stream with at least one obstacle, half of each kind.

    The object's sizes take turns, so that each is there as often as the others.

    Args:
        config: Layout; its kind is "mixed".
        seed: Seed of the scenarios.
        count: Scenes of each kind [1].

    Returns:
        Scenes, first the adversarial ones.

    Raises:
        ValueError: If the stream's first scenarios do not hold as many.

    Examples:
        >>> from cura_torchrl.envs.config import ScenarioConfig
        >>> [scene.kind for scene in choose_scenes(ScenarioConfig(), seed=0, count=1)]
        ['adversarial', 'uniform']
    """
    drawn = _draw(config, seed, torch.arange(_SEARCHED))
    found: dict[tuple[bool, float], list[Scene]] = defaultdict(list)
    for index in (drawn["num_obstacles"] >= min(1, config.max_obstacles)).nonzero().flatten().tolist():
        scene = _scene(index, drawn[index])
        found[scene.adversarial, scene.object_edge].append(scene)
    chosen = []
    for adversarial in (True, False):
        for number in range(count):
            turn, edge = divmod(number, len(config.object_edges))
            same = found[adversarial, config.object_edges[edge]]
            if turn >= len(same):
                msg = f"number of scenes is {count}; accepted: what the first {_SEARCHED} scenarios hold of each kind"
                raise ValueError(msg)
            chosen.append(same[turn])
    return chosen


def find_scene(config: ScenarioConfig, *, seed: int, index: int | None = None) -> Scene:
    """Return a scenario of the evaluation stream.

    Args:
        config: Layout.
        seed: Seed of the scenarios.
        index: Index of the scenario in the stream [1]; None is the first one with the most obstacles.

    Returns:
        The scene.

    Examples:
        >>> from cura_torchrl.envs.config import ScenarioConfig
        >>> find_scene(ScenarioConfig(kind="uniform", object_edges=(0.75,)), seed=0, index=7).object_edge
        0.75
    """
    if index is not None:
        return _scene(index, _draw(config, seed, torch.tensor([index]))[0])
    drawn = _draw(config, seed, torch.arange(_SEARCHED))
    first = int((drawn["num_obstacles"] == drawn["num_obstacles"].max()).int().argmax())
    return _scene(first, drawn[first])


def _draw(config: ScenarioConfig, seed: int, episodes: torch.Tensor) -> TensorDictBase:
    return scenarios.sample_scenarios(
        config,
        stream="eval",
        seed=seed,
        episodes=episodes,
        max_obstacles=config.max_obstacles,
        tcp_reach=HOME_TCP[0],
    )


def _scene(index: int, row: TensorDictBase) -> Scene:
    x, y, yaw = row["goal_pose"].tolist()
    return Scene(
        index=index,
        adversarial=bool(row["adversarial"]),
        object_edge=float(row["object_edge"]),
        goal_pose=(x, y, yaw),
    )


class Recorder:
    """Watches N worlds and keeps what is drawn later.

    Args:
        estimator: The DCE; writes atoms, risk and uncertainty.
        num_worlds: Worlds N.
        stride: Every how many states scan and map are kept [1].
    """

    def __init__(self, estimator: Callable[[TensorDictBase], TensorDictBase], num_worlds: int, *, stride: int) -> None:
        self._estimator = estimator
        self._stride = stride
        self._tracks: dict[str, list[NDArray[np.float32]]] = defaultdict(list)
        self._lengths = torch.zeros(num_worlds, dtype=torch.int64)
        self._frames: list[list[tuple[int, NDArray[np.float32], NDArray[np.uint8]]]] = [[] for _ in range(num_worlds)]

    def __call__(self, state: TensorDictBase, is_playing: torch.Tensor, worlds: WorldState) -> None:
        """Keep one state.

        Args:
            state: What the environment emitted, with the map and the true obstacles; not changed.
            is_playing: Rows that were being played until then, bool, shape ``[N]``.
            worlds: Where joints and bodies are.
        """
        predicted = self._estimator(state.select(keys.OBSERVATION, keys.LATENT))
        reach = state[keys.OBSERVATION][..., OBSERVATION_SLICES["tcp_position"]][..., :2]
        base = state[keys.SENSOR_POSE]
        values = {
            "base_pose": base,
            "tcp": geometry.from_frame(base, reach),
            "object_pose": state[keys.OBJECT_POSE],
            "obstacles": state[keys.OBSTACLES],
            "arm_joints": worlds.joint_position,
            "object_position": worlds.object_position,
            "object_quaternion": worlds.object_quaternion,
            "atoms": predicted[keys.COLLISION_ATOMS],
            "risk": predicted[keys.RISK].squeeze(-1),
            "uncertainty": predicted[keys.UNCERTAINTY].squeeze(-1),
        }
        for name, value in values.items():
            self._tracks[name].append(value.numpy().astype(np.float32))
        step = len(self._tracks["tcp"]) - 1
        is_frame = is_playing & (state["done"].squeeze(-1) | (step % self._stride == 0))
        for row in is_frame.nonzero().flatten().tolist():
            window = (state[keys.CONFIDENCE_MAP][row] * 255.0).round().to(torch.uint8)
            self._frames[row].append((step, state[keys.SCAN][row].numpy().copy(), window.numpy()))
        self._lengths += is_playing

    def recordings(self, episodes: list[Episode], scenes: list[Scene], *, label: str, env: EnvBase) -> list[Recording]:
        """Return what was watched.

        Args:
            episodes: How it ended, M of them, at most N.
            scenes: What was played in the first M worlds.
            label: Who played.
            env: The worlds, with their map.

        Returns:
            M recordings.
        """
        task, resolution = env.base_env.config.task, env.transform[0].config.resolution
        tracks = {name: np.stack(values, 1) for name, values in self._tracks.items()}
        result = []
        for row, (episode, scene, frames) in enumerate(zip(episodes, scenes, self._frames[: len(scenes)], strict=True)):
            steps, scans, maps = (np.stack(part) for part in zip(*frames, strict=True))
            result.append(
                Recording(
                    label=label,
                    scene=scene,
                    episode=episode,
                    period=task.policy_period,
                    success_radius=task.tolerances[0],
                    resolution=resolution,
                    **{name: value[row, : self._lengths[row]] for name, value in tracks.items()},
                    frame_steps=steps,
                    scans=scans,
                    maps=maps,
                )
            )
        return result


def record(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    estimator: Callable[[TensorDictBase], TensorDictBase],
    scenes: list[Scene],
    *,
    label: str,
    stride: int,
    watch: Callable[[torch.Tensor], object] | None = None,
) -> list[Recording]:
    """Play scenes side by side and record them.

    Args:
        env: At least one world a scene; worlds beyond that stand still. Its map stays in the tensordict, and the true
            obstacles are in it (``TaskConfig.privileged``).
        policy: Writes the action.
        estimator: The DCE.
        scenes: What to play.
        label: Who plays.
        stride: Every how many states scan and map are kept [1].
        watch: Called after every step with the rows that were being played until then, bool, shape ``[N]``.

    Returns:
        One recording a scene.
    """
    recorder = Recorder(estimator, env.batch_size[0], stride=stride)

    def look(state: TensorDictBase, is_playing: torch.Tensor) -> None:
        recorder(state, is_playing, env.base_env.world_state)
        if watch is not None:
            watch(is_playing)

    episodes = play_episodes(env, policy, torch.tensor([scene.index for scene in scenes]), watch=look)
    return recorder.recordings(episodes, scenes, label=label, env=env)
