"""The numbers of the table of success rates, from outcomes alone."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cura_torchrl.trainers.evaluation.episodes import summarise
from cura_torchrl.trainers.evaluation.paper_table import PAPER_CELLS, paper_success
from cura_torchrl.trainers.evaluation.statistics import (
    bootstrap_rates,
    interquartile_mean,
    mcnemar,
    paired_difference,
    share_recovered,
    wilson_interval,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from cura_torchrl.trainers.evaluation.episodes import Episode
    from cura_torchrl.trainers.evaluation.measures import Measures

    Played = Mapping[str, Mapping[str, Sequence[Sequence[Episode]]]]

BASELINE = "push"
"""Whom the others are compared with."""
UNOCCLUDED = "push-no-occlusion"
"""Who plays without the loss by occlusion."""

_NAN = (math.nan, math.nan, math.nan)


@dataclass(frozen=True, kw_only=True)
class Result:
    """One method in one cell, or in all of them. Rates are means over training seeds; what is not known is NaN."""

    method: str
    """Name of the method."""
    cell: str
    """Name of the cell, or "all"."""
    seeds: int
    """Training seeds [1]."""
    scenes: int
    """Scenes that each of them played [1]."""
    success: float
    """Goal reached within 0.5 m before any collision [1]."""
    low: float
    """Lower bound of the 95 % interval [1]: Wilson's of the success; over all cells by bootstrap, with several seeds of
    the IQM."""
    high: float
    """Upper bound of it [1]."""
    iqm: float
    """Interquartile mean of the success over training seeds, and cells [1]; NaN with one seed."""
    paper: float
    """Success that the paper prints [1]."""
    success_025: float
    """Success within 0.25 m [1]."""
    success_010_10deg: float
    """Success within 0.10 m and 10 degrees [1]."""
    collisions: float
    """Episodes that ended in a collision [1]."""
    hit_base: float
    """Those in which the base touched an obstacle [1]."""
    hit_arm: float
    """Those in which the arm did [1]."""
    hit_object: float
    """Those in which the object did [1]."""
    timeouts: float
    """Episodes that ended by time-out [1]."""
    tipped: float
    """Episodes in which the object tipped over [1]."""
    steps: float
    """Policy steps until goal, collision or time-out, mean [1]."""
    clearance: float
    """Least clearance of an episode, median over those in which an obstacle appeared [m]."""
    goal_distance: float
    """Distance from object to goal at the end of an episode, median [m]."""
    yaw_error: float
    """Angle between object and goal at the end of an episode, modulo a quarter turn, median [rad]."""
    base_path: float
    """Length of the base's path until the outcome, mean [m]."""
    object_path: float
    """Length of the object's path until the outcome, mean [m]."""
    unseen: float
    """Share of the obstacles that no ray had hit at the outcome [1]."""
    delay: float
    """Time from an obstacle's appearance to the first ray that hits it, mean over those that are hit [s]."""
    difference: float
    """Success less that of the :func:`reference`, on the same scenes [1]."""
    difference_low: float
    """Lower bound of its 95 % interval [1]: Newcombe's; over all cells and with several seeds, by bootstrap."""
    difference_high: float
    """Upper bound of it [1]."""
    mcnemar_p: float
    """McNemar's exact p of the difference [1]; NaN over all cells and with several seeds, whose pairs share scenes."""
    share: float
    """Share of the loss by occlusion that is recovered [1]."""
    share_low: float
    """Lower bound of its 95 % bootstrap interval [1]."""
    share_high: float
    """Upper bound of it [1]."""
    collision_share: float
    """Share of the collisions added by occlusion that is avoided [1]."""
    collision_share_low: float
    """Lower bound of its 95 % bootstrap interval [1]."""
    collision_share_high: float
    """Upper bound of it [1]."""


def compare(played: Played) -> list[Result]:
    """Return the numbers of the table.

    Args:
        played: For each method and cell, for each training seed, how the scenes were played, in the same order.

    Returns:
        A result for each method and cell, and, with several cells, for each method over all.
    """
    cells = list(next(iter(played.values())))
    groups = {cell: [cell] for cell in cells} | ({"all": cells} if len(cells) > 1 else {})
    return [_result(played, method, name, group) for method in played for name, group in groups.items()]


def reference(methods: Iterable[str]) -> str:
    """Return the method that the others are compared with.

    Args:
        methods: Names of all methods of the table, in its order; at least one.

    Returns:
        The baseline; the first method in a table without it.

    Examples:
        >>> reference(["push-no-occlusion", "push"]), reference(["cura-ppo", "cura-cvar"])
        ('push', 'cura-ppo')
    """
    names = list(methods)
    return BASELINE if BASELINE in names else names[0]


def _result(played: Played, method: str, name: str, group: list[str]) -> Result:
    runs = [run for cell in group for run in played[method][cell]]
    episodes = [episode for run in runs for episode in run]
    counts = summarise(episodes)
    is_printed = name != "all" or set(group) == set(PAPER_CELLS)
    printed = paper_success(method, name) if is_printed else None
    count, seeds = counts["episodes"], len(played[method][group[0]])
    hits = {f"hit_{name}": number / count for name, number in counts["collisions_by"].items()}
    iqm, low, high = _interval([_trials(played[method][cell]) for cell in group])
    difference, p = _difference(played, method, group)
    return Result(
        method=method,
        cell=name,
        seeds=seeds,
        scenes=count // seeds,
        success=counts["success_rate"],
        low=low,
        high=high,
        iqm=iqm,
        paper=math.nan if printed is None else printed,
        success_025=counts["success_rate_025"],
        success_010_10deg=counts["success_rate_010_10deg"],
        collisions=counts["collisions"] / count,
        **hits,
        timeouts=counts["timeouts"] / count,
        tipped=counts["tipped"] / count,
        steps=counts["mean_steps"],
        **_measures([episode.measures for episode in episodes if episode.measures is not None]),
        **_bounded("difference", difference),
        mcnemar_p=p,
        **_bounded("share", _share(played, method, group, _succeeds)),
        **_bounded("collision_share", _share(played, method, group, _avoids)),
    )


def _bounded(name: str, numbers: tuple[float, float, float]) -> dict[str, float]:
    """Return a number and its bounds by the names of the result's fields."""
    return dict(zip((name, f"{name}_low", f"{name}_high"), numbers, strict=True))


def _measures(found: list[Measures]) -> dict[str, float]:
    """Return what is told of the measures, by the names of the result's fields."""

    def middle(values: Iterable[float | None], of: Callable[[list[float]], float]) -> float:
        known = [value for value in values if value is not None]
        return float(of(known)) if known else math.nan

    appeared, unseen = sum(entry.obstacles for entry in found), sum(entry.obstacles_unseen for entry in found)
    waited = sum((entry.mean_delay or 0.0) * (entry.obstacles - entry.obstacles_unseen) for entry in found)
    return {
        "clearance": middle((entry.min_clearance for entry in found), statistics.median),
        "goal_distance": middle((entry.goal_distance for entry in found), statistics.median),
        "yaw_error": middle((entry.yaw_error for entry in found), statistics.median),
        "base_path": middle((entry.base_path for entry in found), statistics.fmean),
        "object_path": middle((entry.object_path for entry in found), statistics.fmean),
        "unseen": unseen / appeared if appeared else math.nan,
        "delay": waited / (appeared - unseen) if appeared > unseen else math.nan,
    }


def _succeeds(episode: Episode) -> bool:
    return episode.success[0]


def _avoids(episode: Episode) -> bool:
    return not episode.collision


def _trials(runs: Sequence[Sequence[Episode]], holds: Callable[[Episode], bool] = _succeeds) -> NDArray[np.bool_]:
    """Return what holds of the scenes, shape ``[S, M]``: S training seeds, M scenes."""
    return np.array([[holds(episode) for episode in run] for run in runs], dtype=bool)


def _interval(trials: list[NDArray[np.bool_]]) -> tuple[float, float, float]:
    """Return the interquartile mean, NaN with one seed, and the interval of the success."""
    has_seeds = len(trials[0]) > 1
    if len(trials) == 1 and not has_seeds:
        return math.nan, *wilson_interval(int(trials[0].sum()), trials[0].size)
    (drawn,) = bootstrap_rates([[cell] for cell in trials])
    rates = drawn.reshape(len(drawn), -1)
    low, high = np.quantile(interquartile_mean(rates) if has_seeds else rates.mean(-1), (0.025, 0.975))
    middle = interquartile_mean(np.concatenate([cell.mean(axis=1) for cell in trials])) if has_seeds else math.nan
    return float(middle), float(low), float(high)


def _difference(played: Played, method: str, group: list[str]) -> tuple[tuple[float, float, float], float]:
    """Return the difference from the reference with its interval, and McNemar's p."""
    against = reference(played)
    if method == against:
        return _NAN, math.nan
    pairs = [[_trials(played[who][cell]) for who in (against, method)] for cell in group]
    if len(pairs) == 1 and len(pairs[0][0]) == 1:
        one, other = pairs[0]
        return paired_difference(one, other), mcnemar(one, other)
    one, other = (rates.mean((1, 2)) for rates in bootstrap_rates(pairs))
    low, high = np.quantile(other - one, (0.025, 0.975))
    middle = np.mean([pair[1].mean() - pair[0].mean() for pair in pairs])
    return (float(middle), float(low), float(high)), math.nan


def _share(
    played: Played, method: str, group: list[str], holds: Callable[[Episode], bool]
) -> tuple[float, float, float]:
    needed = (UNOCCLUDED, BASELINE)
    if method in needed or not set(needed) <= set(played):
        return _NAN
    return share_recovered([[_trials(played[who][cell], holds) for who in (*needed, method)] for cell in group])
