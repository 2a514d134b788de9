"""Parts of an evaluation: what a process plays at a time, always the same scenes in the same rows."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from cura_torchrl.envs.config import PushEnvConfig, RobotConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.robots import scripted
from cura_torchrl.trainers.config import EvaluateConfig
from cura_torchrl.trainers.evaluation.episodes import Episode, play_episodes
from cura_torchrl.trainers.evaluation.measures import EpisodeMeter
from cura_torchrl.trainers.evaluation.task import evaluation_task
from cura_torchrl.trainers.loaded_policy import load_policy
from cura_torchrl.trainers.threads import one_thread
from cura_torchrl.trainers.worker_pool import WorkerPool, count_one

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tensordict import TensorDictBase
    from torchrl.envs import EnvBase

    from cura_torchrl.envs.config import Simulator


BATCHES: dict[Simulator, int] = {"bullet": 5, "planar": 20}
"""Scenes of a part for each of its worlds [1]. Towards a part's end worlds wait for the last ones, so that large parts
waste less; but one that is cut off is lost, and on PyBullet it takes longer."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """What one process plays at a time: always the same scenes in the same rows, so that results are the same too."""

    config: EvaluateConfig
    """Policy and scenarios."""
    index: int
    """Index of the part [1]; how many there are depends on the configuration alone."""

    @property
    def indices(self) -> range:
        """Scenarios of the part."""
        first = self.index * part_size(self.config)
        return range(first, min(first + part_size(self.config), self.config.episodes))


class Player:
    """A policy and the worlds that it plays in.

    Args:
        config: Policy and scenarios.
    """

    def __init__(self, config: EvaluateConfig) -> None:
        self._env, self._policy = _build(config)

    def close(self) -> None:
        """Close the worlds."""
        self._env.close()

    def play(self, part: Part, report: Callable[[Episode], object]) -> list[Episode]:
        """Play one part of the scenarios, each once.

        Args:
            part: Which part.
            report: Called with every episode when it is over.

        Returns:
            How they were played, by index.
        """
        config = self._env.config
        # Random actions only; all else is deterministic.
        torch.manual_seed(part.config.seed * 1_000_003 + part.index)
        meter = EpisodeMeter(period=config.task.policy_period, max_range=config.lidar.max_range)
        return play_episodes(self._env, self._policy, torch.tensor(part.indices), report=report, meter=meter)


def part_size(config: EvaluateConfig) -> int:
    """Return how many episodes a process plays at a time; fixed, so that results do not depend on their number.

    Args:
        config: Policy and scenarios.

    Returns:
        Episodes of a part [1]; the last one may have fewer.
    """
    return BATCHES[config.simulator] * config.chunk


def parts_of(config: EvaluateConfig) -> list[Part]:
    """Return the parts of the scenarios.

    Args:
        config: Policy and scenarios.

    Returns:
        The parts, by index.
    """
    return [Part(config=config, index=index) for index in range(-(-config.episodes // part_size(config)))]


def play_parts(
    parts: Sequence[Part],
    num_workers: int,
    *,
    keep: Callable[[Part, list[Episode]], object],
    tick: Callable[[int], object],
) -> None:
    """Play parts, here or in processes; results do not depend on which.

    Args:
        parts: What to play; those of one configuration follow each other.
        num_workers: Processes that play [1]; with one, it is this process.
        keep: Called with each part when it is over, and with its episodes by index.
        tick: Called with the number of episodes that were over since it was called last [1].

    Raises:
        WorkerError: If a process that plays dies.
    """  # noqa: DOC502 - raised by what this calls
    with WorkerPool(num_workers) as pool:
        try:
            pool.run(_play, parts, keep=keep, tick=tick)
        finally:
            _close_players()


def _play(part: Part) -> list[Episode]:
    with one_thread():
        return _player(part.config).play(part, lambda _: count_one())


_players: dict[EvaluateConfig, Player] = {}
"""The one that played last in this process: its worlds are kept for the next part."""


def _player(config: EvaluateConfig) -> Player:
    if config not in _players:
        _close_players()
        _players[config] = Player(config)
    return _players[config]


def _close_players() -> None:
    while _players:
        _players.popitem()[1].close()  # worlds of PyBullet take 28 MB each until they are closed


def _build(config: EvaluateConfig) -> tuple[EnvBase, Callable[[TensorDictBase], TensorDictBase]]:
    """Return the worlds and who plays in them."""
    if config.policy is None:
        loaded = load_policy(config.source).double()
        return loaded.make_evaluation_env(config.chunk, config, simulator=config.simulator), loaded.policy
    base = PushEnvConfig(simulator=config.simulator, robot=RobotConfig(model=config.robot))
    env = PushEnv(config.chunk, dataclasses.replace(base, task=evaluation_task(base.task, config)), seed=config.seed)
    if config.policy == "random":
        return env, env.rand_action
    return env, (scripted.ScriptedPusher if config.policy == "scripted" else scripted.ScriptedAvoider)(base.robot)
