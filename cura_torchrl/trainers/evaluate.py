"""Play frozen scenarios with a fixed policy and count how they end."""

from __future__ import annotations

import dataclasses
import itertools
import sys
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp
from tqdm import tqdm

from cura_torchrl import keys
from cura_torchrl.envs.config import PushEnvConfig, RobotConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.robots import scripted
from cura_torchrl.trainers.config import EvaluateConfig
from cura_torchrl.trainers.episode_measures import EpisodeMeter, Measures
from cura_torchrl.trainers.evaluation_task import evaluation_task
from cura_torchrl.trainers.info import git_commit, versions
from cura_torchrl.trainers.loaded_policy import load_policy
from cura_torchrl.trainers.statistics import wilson_interval
from cura_torchrl.trainers.threads import one_thread
from cura_torchrl.trainers.worker_pool import count_one, in_processes

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tensordict import TensorDictBase
    from torchrl.envs import EnvBase

    from cura_torchrl.envs.config import Simulator


BATCHES: dict[Simulator, int] = {"bullet": 5, "planar": 20}
"""Scenes of a part for each of its worlds [1]. Towards a part's end worlds wait for the last ones, so that large parts
waste less; but one that is cut off is lost, and on PyBullet it takes longer."""


@dataclass(frozen=True, kw_only=True)
class Episode:
    """How one scenario was played."""

    index: int
    """Index of the scenario in its stream [1]."""
    success: tuple[bool, ...]
    """Goal reached before any collision, for each tolerance."""
    collision: bool
    """Ended in a collision before the goal was reached."""
    contact: tuple[bool, bool, bool]
    """Whether base, arm, object touched an obstacle in the collision."""
    tipped: bool
    """The object tipped over."""
    steps: int
    """Policy steps until goal, collision or time-out [1]."""
    measures: Measures | None = None
    """What was measured of it; None where nothing was."""


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


def evaluate(config: EvaluateConfig) -> dict[str, Any]:
    """Play the scenarios and return the counts.

    Args:
        config: Policy, scenarios and their number.

    Returns:
        JSON-compatible result; rates with Wilson's 95 % interval.

    Raises:
        CheckpointError: If the policy's checkpoint is missing or damaged.
    """  # noqa: DOC502 - raised by what this calls
    source = _source(config)
    episodes: list[Episode] = []
    with tqdm(total=config.episodes, unit="episode", file=sys.stderr) as bar:

        def keep(_: Part, played: list[Episode]) -> None:
            episodes.extend(played)
            bar.set_postfix_str(f"success {sum(entry.success[0] for entry in episodes) / len(episodes):.1%}")

        play_parts(parts_of(config), config.num_workers, keep=keep, tick=bar.update)
    return {**source, **summarise(episodes), **_settings(config)}


def summarise(episodes: list[Episode]) -> dict[str, Any]:
    """Return counts and rates.

    Args:
        episodes: What was played, at least one.

    Returns:
        Counts, success rates for the three tolerances, Wilson's interval of the headline, mean steps to the outcome;
        the outcomes by index of the scenario (s: success, c: collision, t: time-out), to pair them with other results.
    """
    count = len(episodes)
    successes = sum(episode.success[0] for episode in episodes)
    collisions = [episode for episode in episodes if episode.collision]
    low, high = wilson_interval(successes, count)
    return {
        "episodes": count,
        "successes": successes,
        "success_rate": successes / count,
        "wilson_low": low,
        "wilson_high": high,
        "collisions": len(collisions),
        "timeouts": count - successes - len(collisions),
        "success_rate_025": sum(episode.success[1] for episode in episodes) / count,
        "success_rate_010_10deg": sum(episode.success[2] for episode in episodes) / count,
        "mean_steps": sum(episode.steps for episode in episodes) / count,
        "outcomes": "".join(outcome_letter(episode) for episode in sorted(episodes, key=lambda episode: episode.index)),
        "tipped": sum(episode.tipped for episode in episodes),
        "collisions_by": {
            name: sum(episode.contact[index] for episode in collisions)
            for index, name in enumerate(("base", "arm", "object"))
        },
    }


def outcome_letter(episode: Episode) -> str:
    """Return how an episode ended.

    Args:
        episode: The episode.

    Returns:
        s for success, c for collision, t for time-out.
    """
    return "s" if episode.success[0] else "c" if episode.collision else "t"


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


def _ignore(*_: object) -> None:
    """Watch nothing."""


@torch.no_grad()
def play_episodes(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    indices: torch.Tensor,
    *,
    report: Callable[[Episode], object] = _ignore,
    watch: Callable[[TensorDictBase, torch.Tensor], object] = _ignore,
    meter: EpisodeMeter | None = None,
    exploration: ExplorationType = ExplorationType.DETERMINISTIC,
) -> list[Episode]:
    """Play scenarios, each once, with the policy's mean action unless said otherwise.

    A world whose episode is over takes the next scenario that waits; where none does it stands still, so that the
    policy's batch keeps its size, on which the last bits of its actions depend.

    Args:
        env: N worlds.
        policy: Writes the action.
        indices: Scenarios to play, int64, shape ``[M]``, M at least 1.
        report: Called with every episode when it is over.
        watch: Called with what the environment emits at the start and after every step, batch size ``[N]``, and with
            the rows that were being played until then, bool, shape ``[N]``.
        meter: Measures the episodes; it needs an environment with ``TaskConfig.privileged``.
        exploration: How the policy's distribution becomes an action.

    Returns:
        How they were played, in the order of ``indices``.
    """
    num_worlds, waiting = env.batch_size[0], iter(range(len(indices)))
    # Which of the scenarios each world plays, -1 for none.
    playing = torch.tensor([next(waiting, -1) for _ in range(num_worlds)])
    reached = torch.zeros(num_worlds, dtype=torch.int64)
    outcomes: dict[int, Episode] = {}
    measure = _ignore if meter is None else meter.watch
    with set_exploration_type(exploration):
        state = env.reset(episodes=indices[playing.clamp_min(0)])
        watch(state, playing >= 0)
        measure(state, playing >= 0)
        while len(outcomes) < len(indices):
            state = policy(state)
            state[keys.ACTION] = torch.where(playing.unsqueeze(-1) < 0, 0.0, state[keys.ACTION])
            after = env.step(state)["next"]
            watch(after, playing >= 0)
            measure(after, (playing >= 0) & (reached == 0))
            is_new = after[keys.SUCCESS][:, 0] & (reached == 0)
            reached = torch.where(is_new, after[keys.ELAPSED_STEPS].squeeze(-1), reached)
            has_ended = after["done"].squeeze(-1) & (playing >= 0)
            for row in has_ended.nonzero().flatten().tolist():
                number = int(playing[row])
                measures = None if meter is None else meter.measures(after, row)
                outcomes[number] = _episode(int(indices[number]), after[row], int(reached[row]), measures)
                report(outcomes[number])
                playing[row], reached[row] = next(waiting, -1), 0
            state = step_mdp(state)
            is_fresh = has_ended & (playing >= 0)
            if is_fresh.any():
                state = env.reset(state.set("_reset", is_fresh[:, None]), episodes=indices[playing.clamp_min(0)])
                measure(state, is_fresh)
    return [outcomes[number] for number in range(len(indices))]


def _episode(index: int, last: TensorDictBase, reached: int, measures: Measures | None) -> Episode:
    success = tuple(last[keys.SUCCESS].tolist())
    contact = tuple(last[keys.CONTACT].tolist())
    return Episode(
        index=index,
        success=success,
        collision=bool(last["terminated"]) and not success[0],
        contact=contact,
        tipped=bool(last[keys.TIPPED]),
        steps=reached or int(last[keys.ELAPSED_STEPS]),
        measures=measures,
    )


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
        WorkerError: If a process that plays has died.
    """  # noqa: DOC502 - raised by what this calls
    if num_workers > 1 and parts:
        in_processes(_play_in_worker, parts, num_workers, keep=keep, tick=tick)
        return
    for config, group in itertools.groupby(parts, key=lambda part: part.config):
        with one_thread(), closing(Player(config)) as player:
            for part in group:
                keep(part, player.play(part, lambda _: tick(1)))


def _play_in_worker(part: Part) -> list[Episode]:
    with one_thread():
        # The worlds are kept for the next part.
        return _worker_player(part.config).play(part, lambda _: count_one())


_players: dict[EvaluateConfig, Player] = {}
"""In a worker: the one that played last."""


def _worker_player(config: EvaluateConfig) -> Player:
    if config not in _players:
        while _players:
            _players.popitem()[1].close()  # worlds of PyBullet take 28 MB each until they are closed
        _players[config] = Player(config)
    return _players[config]


def _build(config: EvaluateConfig) -> tuple[EnvBase, Callable[[TensorDictBase], TensorDictBase]]:
    """Return the worlds and who plays in them."""
    if config.policy is None:
        loaded = load_policy(_path(config))
        return loaded.make_evaluation_env(config.chunk, config, simulator=config.simulator), loaded.policy
    base = PushEnvConfig(simulator=config.simulator, robot=RobotConfig(model=config.robot))
    env = PushEnv(config.chunk, dataclasses.replace(base, task=evaluation_task(base.task, config)), seed=config.seed)
    if config.policy == "random":
        return env, env.rand_action
    return env, (scripted.ScriptedPusher if config.policy == "scripted" else scripted.ScriptedAvoider)(base.robot)


def _path(config: EvaluateConfig) -> str | Path:
    return config.method if config.method is not None else Path(config.checkpoint or "")


def _source(config: EvaluateConfig) -> dict[str, Any]:
    """Return who plays; raises before any world is built."""
    if config.policy is not None:
        return {"method": config.policy, "robot": config.robot, "checkpoint": None, "trained_frames": 0}
    loaded = load_policy(_path(config))
    return {
        "method": loaded.config.method,
        "robot": loaded.config.env.robot.model,
        "checkpoint": loaded.path.as_posix(),
        "trained_frames": loaded.record["frames"],
        "trained_commit": loaded.record["commit"],
    }


def _settings(config: EvaluateConfig) -> dict[str, Any]:
    return {
        "scenario": config.scenario,
        "object_size": config.object_size,
        "max_obstacles": config.max_obstacles,
        "seed": config.seed,
        "chunk": config.chunk,
        "simulator": config.simulator,
        "commit": git_commit(),
        "versions": versions(),
    }
