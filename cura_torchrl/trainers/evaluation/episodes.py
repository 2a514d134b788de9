"""How frozen scenarios are played, each once, and how they end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from cura_torchrl import keys
from cura_torchrl.trainers.evaluation.measures import EpisodeMeter, Measures
from cura_torchrl.trainers.evaluation.statistics import wilson_interval

if TYPE_CHECKING:
    from collections.abc import Callable

    from tensordict import TensorDictBase
    from torchrl.envs import EnvBase

_ACTION_LEVELS = 2.0**20
"""Actions are rounded to multiples of one over this. Last bits of a policy's matrix products, which depend on batch and
processor, so do not reach the simulator, where contact makes ten times as much of them in every step."""


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

    A world whose episode is over takes the next scenario that waits; where none does it stands still.

    Args:
        env: N worlds.
        policy: Writes the action.
        indices: Scenarios to play, int64, shape ``[M]``, M at least 1.
        report: Called with every episode when it is over.
        watch: Called with what the environment emits, batch size ``[N]``, and with the rows that are new in it, bool,
            shape ``[N]``: after a step those that were being played until then, after a reset those that begin.
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
            action = (state[keys.ACTION] * _ACTION_LEVELS).round() / _ACTION_LEVELS
            state[keys.ACTION] = torch.where(playing.unsqueeze(-1) < 0, 0.0, action)
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
                watch(state, is_fresh)
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
