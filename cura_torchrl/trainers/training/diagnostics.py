"""What a rollout says: outcomes of recent episodes, reward by term, and how good the collision estimator is."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from cura_torchrl import keys
from cura_torchrl.envs.mdp.observations import OBSERVATION_SLICES
from cura_torchrl.envs.mdp.rewards import REWARD_TERM_NAMES
from cura_torchrl.trainers.evaluation.statistics import area_under_roc

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from tensordict import TensorDictBase

COLLISION_HORIZON = 10
"""Policy steps within which a collision counts as what the risk foretold [1]; 1 / (1 - gamma_c) at the paper's 0.9."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How an episode ended."""

    success: bool
    """The object reached the goal, headline tolerance, before any collision."""
    collision: bool
    """Robot or object touched an obstacle before the goal was reached."""
    steps: int
    """Policy steps [1]."""
    object_size: float
    """Edge of the pushed object [m]."""


class RecentEpisodes:
    """Outcomes of the episodes that ended last.

    Args:
        capacity: Episodes to remember [1].

    Examples:
        >>> recent = RecentEpisodes(capacity=2)
        >>> recent.extend([Outcome(success=True, collision=False, steps=80, object_size=0.5)])
        >>> recent.rates()["success"]
        1.0
    """

    def __init__(self, capacity: int) -> None:
        self._outcomes: deque[Outcome] = deque(maxlen=capacity)

    def extend(self, outcomes: list[Outcome]) -> None:
        """Add episodes, forgetting the oldest.

        Args:
            outcomes: Episodes in the order in which they ended.
        """
        self._outcomes.extend(outcomes)

    def rates(self) -> dict[str, float]:
        """Return rates over the remembered episodes.

        Returns:
            Success, collision and time-out rate [1], mean length [policy steps], number of episodes, and the success
            rate for each edge of the object; NaN where there are none.
        """
        outcomes = list(self._outcomes)
        result = {
            "success": _mean([episode.success for episode in outcomes]),
            "collision": _mean([episode.collision for episode in outcomes]),
            "timeout": _mean([not episode.success and not episode.collision for episode in outcomes]),
            "episode_steps": _mean([episode.steps for episode in outcomes]),
            "episodes": float(len(outcomes)),
        }
        for edge in sorted({episode.object_size for episode in outcomes}):
            result[f"success_{edge:.2f}m"] = _mean(
                [episode.success for episode in outcomes if episode.object_size == edge]
            )
        return result


def finished_episodes(batch: TensorDictBase) -> list[Outcome]:
    """Return how the episodes ended that ended in a rollout.

    Args:
        batch: Rollout, shape ``[N, T]``, with the environment's keys under "next".

    Returns:
        Outcomes by time, then by environment.
    """
    after = batch["next"]
    time, row = (after["done"].squeeze(-1).mT).nonzero(as_tuple=True)
    ended = after[row, time].select(keys.SUCCESS, "terminated", keys.ELAPSED_STEPS, keys.OBJECT_SIZE)
    success = ended[keys.SUCCESS][:, 0].tolist()
    terminated = ended["terminated"].squeeze(-1).tolist()
    steps = ended[keys.ELAPSED_STEPS].squeeze(-1).tolist()
    edges = ended[keys.OBJECT_SIZE][:, 0].tolist()
    return [
        Outcome(success=s, collision=c and not s, steps=n, object_size=round(e, 3))
        for s, c, n, e in zip(success, terminated, steps, edges, strict=True)
    ]


def rollout_statistics(batch: TensorDictBase) -> dict[str, float]:
    """Return the mean reward by term and the mean speed of the object.

    Args:
        batch: Rollout, shape ``[N, T]``.

    Returns:
        ``reward``, ``reward/<term>`` per policy step, and ``object_speed`` [m/s].
    """
    after = batch["next"]
    terms = after[keys.REWARD_TERMS].flatten(0, -2).mean(0).tolist()
    result = {f"reward/{name}": value for name, value in zip(REWARD_TERM_NAMES, terms, strict=True)}
    result["reward"] = after[keys.REWARD].mean().item()
    velocity = after[keys.OBSERVATION][..., OBSERVATION_SLICES["object_velocity"]]
    result["object_speed"] = velocity.norm(dim=-1).mean().item()
    return result


def risk_auroc(batch: TensorDictBase) -> float:
    """Return how well the estimator's risk foretells a collision within :data:`COLLISION_HORIZON`.

    Args:
        batch: Rollout with the ``risk`` of the estimator that was in place, shape ``[N, T]``.

    Returns:
        Area under the receiver operating characteristic [1]; NaN where all steps, or none, come before a collision.
    """
    terminated = batch["next", "terminated"].squeeze(-1).cpu().numpy()
    done = batch["next", "done"].squeeze(-1).cpu().numpy()
    label, is_known = collision_within(terminated, done, COLLISION_HORIZON)
    return area_under_roc(batch[keys.RISK].squeeze(-1).cpu().numpy()[is_known], label[is_known])


def collision_within(
    terminated: NDArray[np.bool_], done: NDArray[np.bool_], horizon: int
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return whether a collision follows within some steps, and whether the rollout is long enough to tell.

    Args:
        terminated: Whether a step ended in a collision, shape ``[N, T]``.
        done: Whether a step ended the episode, shape ``[N, T]``.
        horizon: Steps to look ahead, the present one included [1].

    Returns:
        The label and whether it is known, each of shape ``[N, T]``.

    Examples:
        >>> hit = np.array([[False, False, True, False]])
        >>> label, is_known = collision_within(hit, hit, 2)
        >>> label.tolist(), is_known.tolist()
        ([[False, True, True, False]], [[True, True, True, False]])
    """
    steps_to_end = np.full(terminated.shape[0], np.inf)
    ends_in_collision = np.zeros(terminated.shape[0], dtype=bool)
    distance = np.empty(terminated.shape)
    collision = np.empty(terminated.shape, dtype=bool)
    num_steps = terminated.shape[1]
    for step in reversed(range(num_steps)):
        steps_to_end = np.where(done[:, step], 1.0, steps_to_end + 1.0)
        ends_in_collision = np.where(done[:, step], terminated[:, step], ends_in_collision)
        distance[:, step], collision[:, step] = steps_to_end, ends_in_collision
    steps_left = num_steps - np.arange(num_steps)
    is_known = np.isfinite(distance) | (steps_left >= horizon)
    return collision & (distance <= horizon), is_known


def explained_variance(batch: TensorDictBase) -> float:
    """Return the share of the value target's variance that the critic explains.

    Args:
        batch: Rollout with ``state_value`` and ``value_target``.

    Returns:
        1 minus the ratio of the residual's variance to the target's [1]; NaN where the target does not vary.
    """
    target = batch[keys.VALUE_TARGET].double()
    variance = target.var().item()
    return 1.0 - (target - batch[keys.STATE_VALUE].double()).var().item() / variance if variance > 0 else math.nan


def find_non_finite(data: TensorDictBase) -> str | None:
    """Return the first key that holds a NaN or an infinity.

    Args:
        data: Any tensordict.

    Returns:
        The key, nested keys joined with dots; None if all is finite.

    Examples:
        >>> from tensordict import TensorDict
        >>> find_non_finite(TensorDict({"reward": torch.tensor([1.0, float("nan")])}, [2]))
        'reward'
    """
    for key, value in data.items(include_nested=True, leaves_only=True):
        if value.is_floating_point() and not torch.isfinite(value).all():
            return key if isinstance(key, str) else ".".join(key)
    return None


def _mean(values: list[bool] | list[int]) -> float:
    return float(np.mean(values)) if values else math.nan
