"""Play frozen scenarios with a fixed policy and count how they end."""

from __future__ import annotations

import dataclasses
import functools
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
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
from cura_torchrl.trainers.checkpoint import load_policy
from cura_torchrl.trainers.info import git_commit, versions
from cura_torchrl.trainers.statistics import wilson_interval
from cura_torchrl.trainers.threads import one_thread

if TYPE_CHECKING:
    from collections.abc import Callable

    from tensordict import TensorDictBase
    from torchrl.envs import EnvBase

    from cura_torchrl.envs.config import TaskConfig
    from cura_torchrl.trainers.config import EvaluateConfig


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

        def add(episode: Episode) -> None:
            episodes.append(episode)
            bar.update()
            bar.set_postfix_str(f"success {sum(played.success[0] for played in episodes) / len(episodes):.1%}")

        _play_all(config, add)
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
        self._config = config
        self._env, self._policy = _build(config)

    def close(self) -> None:
        """Close the worlds."""
        self._env.close()

    def play(self, part: int, report: Callable[[Episode], object]) -> None:
        """Play one part of the scenarios, each once.

        Args:
            part: Index of the part; how many there are depends on the configuration alone.
            report: Called with every episode when it is over.
        """
        first = part * part_size(self._config)
        last = min(first + part_size(self._config), self._config.episodes)
        torch.manual_seed(self._config.seed * 1_000_003 + part)  # random actions only; all else is deterministic
        play_episodes(self._env, self._policy, torch.arange(first, last), report=report)


@torch.no_grad()
def play_episodes(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    indices: torch.Tensor,
    *,
    report: Callable[[Episode], object] | None = None,
    watch: Callable[[TensorDictBase, torch.Tensor], object] | None = None,
) -> list[Episode]:
    """Play scenarios, each once, with the policy's mean action.

    A world whose episode is over takes the next scenario that waits; where none does it stands still, so that the
    policy's batch keeps its size, on which the last bits of its actions depend.

    Args:
        env: N worlds.
        policy: Writes the action.
        indices: Scenarios to play, int64, shape ``[M]``, M at least 1.
        report: Called with every episode when it is over.
        watch: Called with what the environment emits at the start and after every step, batch size ``[N]``, and with
            the rows that were being played until then, bool, shape ``[N]``.

    Returns:
        How they were played, in the order of ``indices``.
    """
    num_worlds, waiting = env.batch_size[0], iter(range(len(indices)))
    # Which of the scenarios each world plays, -1 for none.
    playing = torch.tensor([next(waiting, -1) for _ in range(num_worlds)])
    reached = torch.zeros(num_worlds, dtype=torch.int64)
    outcomes: dict[int, Episode] = {}
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        state = env.reset(episodes=indices[playing.clamp_min(0)])
        if watch is not None:
            watch(state, playing >= 0)
        while len(outcomes) < len(indices):
            state = policy(state)
            state[keys.ACTION] = torch.where(playing.unsqueeze(-1) < 0, 0.0, state[keys.ACTION])
            after = env.step(state)["next"]
            if watch is not None:
                watch(after, playing >= 0)
            is_new = after[keys.SUCCESS][:, 0] & (reached == 0)
            reached = torch.where(is_new, after[keys.ELAPSED_STEPS].squeeze(-1), reached)
            has_ended = after["done"].squeeze(-1) & (playing >= 0)
            for row in has_ended.nonzero().flatten().tolist():
                number = int(playing[row])
                outcomes[number] = _episode(int(indices[number]), after[row], int(reached[row]))
                if report is not None:
                    report(outcomes[number])
                playing[row], reached[row] = next(waiting, -1), 0
            state = step_mdp(state)
            is_fresh = has_ended & (playing >= 0)
            if is_fresh.any():
                state = env.reset(state.set("_reset", is_fresh[:, None]), episodes=indices[playing.clamp_min(0)])
    return [outcomes[number] for number in range(len(indices))]


def _episode(index: int, last: TensorDictBase, reached: int) -> Episode:
    success = tuple(last[keys.SUCCESS].tolist())
    contact = tuple(last[keys.CONTACT].tolist())
    return Episode(
        index=index,
        success=success,
        collision=bool(last["terminated"]) and not success[0],
        contact=contact,
        tipped=bool(last[keys.TIPPED]),
        steps=reached or int(last[keys.ELAPSED_STEPS]),
    )


def part_size(config: EvaluateConfig) -> int:
    """Return how many episodes a process plays at a time; fixed, so that results do not depend on their number.

    Args:
        config: Policy and scenarios.

    Returns:
        Episodes of a part [1]; the last one may have fewer.
    """
    return 5 * config.chunk


def _play_all(config: EvaluateConfig, report: Callable[[Episode], object]) -> None:
    parts = range(-(-config.episodes // part_size(config)))
    if config.num_workers == 1:
        with one_thread(), closing(Player(config)) as player:
            for part in parts:
                player.play(part, report)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(config.num_workers, len(parts)), mp_context=context) as pool:
        for played in pool.map(functools.partial(play_in_worker, config), parts):
            for episode in played:
                report(episode)


def play_in_worker(config: EvaluateConfig, part: int) -> list[Episode]:
    """Play one part of the scenarios, with worlds that this process keeps for the next part.

    Args:
        config: Policy and scenarios.
        part: Index of the part.

    Returns:
        How they were played, as they ended.
    """
    played: list[Episode] = []
    with one_thread():
        _worker_player(config).play(part, played.append)
    return played


@functools.lru_cache(maxsize=1)
def _worker_player(config: EvaluateConfig) -> Player:
    return Player(config)


def _build(config: EvaluateConfig) -> tuple[EnvBase, Callable[[TensorDictBase], TensorDictBase]]:
    """Return the worlds and who plays in them."""
    if config.policy is None:
        loaded = load_policy(_path(config))
        task = _task(loaded.config.env.task, config)
        env = loaded.make_env(config.chunk, task=task, simulator=config.simulator, seed=config.seed)
        return env, loaded.policy
    base = PushEnvConfig(simulator=config.simulator, robot=RobotConfig(model=config.robot))
    task = dataclasses.replace(_task(base.task, config), privileged=config.policy == "avoider")
    env = PushEnv(config.chunk, dataclasses.replace(base, task=task), seed=config.seed)
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


def _task(task: TaskConfig, config: EvaluateConfig) -> TaskConfig:
    scenario = dataclasses.replace(
        task.scenario, kind=config.scenario, object_edges=(config.object_size,), max_obstacles=config.max_obstacles
    )
    return dataclasses.replace(task, scenario=scenario, stream="eval", random_first_age=False, curriculum=())


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
