"""Whether the same policies end the same scenes alike in two files of outcomes, such as those of two simulators."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cura_torchrl.trainers.evaluation.episodes import outcome_letter
from cura_torchrl.trainers.evaluation.statistics import bootstrap_interval

if TYPE_CHECKING:
    from collections.abc import Iterable

    from cura_torchrl.trainers.evaluation.episodes import Episode


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """How two sets of episodes of the same scenes compare."""

    scenes: int
    """Scenes that both have played [1]."""
    alike: float
    """Share of them that ended alike: success, collision or time-out [1]."""
    before: float
    """Success in the other set [1]."""
    success: float
    """Success in this set [1]."""
    low: float
    """Lower bound of the 95 % bootstrap interval of the difference of the successes, over scenes [1]."""
    high: float
    """Upper bound of it [1]."""


def agreement(pairs: Iterable[tuple[Episode, Episode]]) -> Agreement | None:
    """Return how episodes of the same scenes compare.

    Args:
        pairs: How scenes were played in the other set and in this one. Those of one index are drawn together for the
            interval, for a scene is alike in all cells, and all policies play it.

    Returns:
        The numbers; None where there are no pairs.
    """
    both = list(pairs)
    if not both:
        return None
    others, own = ([episode.success[0] for episode in side] for side in zip(*both, strict=True))
    scenes, of = np.unique([mine.index for _, mine in both], return_inverse=True)
    gained, played = np.bincount(of, np.subtract(own, others, dtype=float)), np.bincount(of)
    low, high = bootstrap_interval(lambda pick: float(gained[pick].sum() / played[pick].sum()), len(scenes))
    return Agreement(
        scenes=len(both),
        alike=sum(outcome_letter(other) == outcome_letter(mine) for other, mine in both) / len(both),
        before=sum(others) / len(both),
        success=sum(own) / len(both),
        low=low,
        high=high,
    )


def pair(others: Iterable[Episode], own: Iterable[Episode]) -> list[tuple[Episode, Episode]]:
    """Return the scenes that two sets have in common.

    Args:
        others: Episodes of one cell.
        own: Episodes of the same cell.

    Returns:
        How each scene was played in the first set and in the second.
    """
    known = {episode.index: episode for episode in others}
    return [(known[episode.index], episode) for episode in own if episode.index in known]
