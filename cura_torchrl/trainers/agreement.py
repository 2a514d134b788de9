"""Whether the same policies end the same scenes alike in two files of outcomes, such as those of two simulators."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from cura_torchrl.trainers.evaluate import outcome_letter
from cura_torchrl.trainers.statistics import paired_difference

if TYPE_CHECKING:
    from collections.abc import Iterable

    from cura_torchrl.trainers.evaluate import Episode


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
    """Lower bound of the 95 % interval of the difference of the successes, Newcombe's for pairs [1]."""
    high: float
    """Upper bound of it [1]."""


def agreement(pairs: Iterable[tuple[Episode, Episode]]) -> Agreement | None:
    """Return how episodes of the same scenes compare.

    Args:
        pairs: For each scene, how it was played in the other set and in this one.

    Returns:
        The numbers; None where there are no pairs.
    """
    both = list(pairs)
    if not both:
        return None
    others, own = ([episode.success[0] for episode in side] for side in zip(*both, strict=True))
    _, low, high = paired_difference(others, own)
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
