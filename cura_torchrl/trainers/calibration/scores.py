"""Does a predicted distribution of the collision possibility come true? Atoms and outcomes in, numbers out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import spearmanr

from cura_torchrl.modules.functional import atom_mean, atom_quantile, atom_variance
from cura_torchrl.objectives import energy_distance
from cura_torchrl.trainers.evaluation.statistics import area_under_roc, bootstrap_interval, correlation
from cura_torchrl.trainers.training.diagnostics import COLLISION_HORIZON

if TYPE_CHECKING:
    from collections.abc import Callable

TAIL = 1e-2
"""How well the collision possibility has to be known [1]: states before a truncation that leaves more open are not
counted, and outcomes this near to an interval count as inside it."""
LEVELS = tuple(round(0.1 * number, 1) for number in range(1, 10))
"""Levels of the central intervals [1]."""
PROBABILITY_EDGES = (0.0, 0.01, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7, 0.9, 1.001)
"""Bins of the reliability diagram: finer where most predictions are [1]."""
STAKE = 0.02
"""Risk from which a state counts for the coverage [1]. Elsewhere, which is most of the time, the tail covers all. What
is chosen by the prediction alone leaves a calibrated prediction calibrated."""
_GRID = 0.001 * (np.arange(2001) - 499.5)
"""Where distribution functions are compared, in steps of 0.001 [1]; atoms beyond count as at its ends."""
_DRAWS = 400
"""Resamples of the episodes [1]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Predictions:
    """M states with what was predicted in them and what came of it."""

    atoms: NDArray[np.float32]
    """Predicted atoms of the collision possibility C, unsorted [1], shape ``[M, N]``."""
    possibility: NDArray[np.float64]
    """C as it came out [1], shape ``[M]``."""
    episode: NDArray[np.int64]
    """Episode that each state is of, shape ``[M]``."""
    gamma: float
    """Discount gamma_c of a step [1]."""


def realised_possibility(
    steps_left: NDArray[np.int64], *, collided: bool, gamma: float, tail: float = TAIL
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the collision possibility that came out in states of one episode.

    A collision on the last of L steps left makes C = gamma^(L - 1). An episode that is cut off after them leaves it
    open between 0 and gamma^L, of a collision on the first step that was not played.

    Args:
        steps_left: Steps from each state to the end of the episode, the one taken there included [1], shape ``[T]``.
        collided: Whether the episode ended in a collision; it was cut off otherwise.
        gamma: Discount of a step [1].
        tail: How much of C may stay open [1].

    Returns:
        C [1], the lower end where it is open, and whether it is known to within the tail; shape ``[T]`` each.

    Examples:
        >>> value, is_known = realised_possibility(np.array([3, 2, 1]), collided=True, gamma=0.9)
        >>> value.round(2).tolist(), is_known.tolist()
        ([0.81, 0.9, 1.0], [True, True, True])
    """
    left = np.asarray(steps_left, dtype=np.float64)
    value: NDArray[np.float64] = np.power(gamma, left - 1.0) if collided else np.zeros(len(left))
    is_known: NDArray[np.bool_] = np.logical_or(collided, np.power(gamma, left) <= tail)
    return value, is_known


def crps(atoms: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
    """Return the continuous ranked probability score of atoms: the integral of (F(x) - [x >= value])^2.

    It is half the energy distance between the atoms and the value, E|X - y| - E|X - X'| / 2.

    Args:
        atoms: Atoms in any order, shape ``[M, N]``.
        value: What came out, shape ``[M]``.

    Returns:
        Score in the atoms' unit, 0 at best, shape ``[M]``.

    Source:
        Gneiting and Raftery (2007), "Strictly proper scoring rules, prediction, and estimation", eq. (21).

    Examples:
        >>> crps(torch.tensor([[0.0, 1.0]]), torch.tensor([0.0])).item()  # (1/2)^2 over a length of 1
        0.25
    """
    return 0.5 * energy_distance(atoms, value[:, None].to(atoms))


def measure(data: Predictions, draws: int = _DRAWS) -> dict[str, Any]:
    """Return how well predictions come true, each number with its 95 % interval over resampled episodes.

    Args:
        data: Predictions and outcomes.
        draws: Resamples of the episodes [1].

    Returns:
        JSON-compatible. ``numbers``: by name value, lower and upper bound. ``coverage``, over the states whose risk is
        at least :data:`STAKE`: for each level the share that
        the prediction itself promises, and value and bounds of the share that came out. ``reliability``: for each bin
        of predicted probability the number of states, its mean, and value and bounds of the share that collided.
    """
    episodes, owner = np.unique(data.episode, return_inverse=True)
    members = np.split(np.argsort(owner, kind="stable"), np.cumsum(np.bincount(owner))[:-1])
    columns = _columns(data)
    below = _below(data, owner, len(episodes))
    calls: dict[str, Callable[[NDArray[np.int64]], NDArray[np.float64]]] = {
        "numbers": lambda index: np.array(list(_numbers(columns, index).values())),
        "coverage": lambda index: _covered(columns, "inside", index),
        "reliability": lambda index: _reliability(columns, index)[2],
    }

    def statistics(pick: NDArray[np.int64]) -> NDArray[np.float64]:
        index = np.concatenate([members[episode] for episode in pick])
        return np.concatenate([*(call(index) for call in calls.values()), [_pooled_distance(below, pick)]])

    everything = np.arange(len(episodes))
    index = np.arange(len(owner))
    table = np.array([statistics(everything), *bootstrap_interval(statistics, len(episodes), draws)]).T.tolist()
    names, num_bins = list(_numbers(columns, index)), len(PROBABILITY_EDGES) - 1
    count, predicted, _ = _reliability(columns, index)
    first, second = len(names), len(names) + len(LEVELS)
    return {
        "states": len(owner),
        "states_at_stake": int((columns["risk"] >= STAKE).sum()),
        "episodes": len(episodes),
        "collisions_within": int(columns["label"].sum()),
        "numbers": {**dict(zip(names, table[:first], strict=True)), "pooled_energy_distance": table[-1]},
        "coverage": [
            {"level": level, "promised": float(promised), "came_out": row}
            for level, promised, row in zip(
                LEVELS, _covered(columns, "promised", index), table[first:second], strict=True
            )
        ],
        "reliability": [
            {"states": int(count[bin_]), "predicted": float(predicted[bin_]), "came_out": table[second + bin_]}
            for bin_ in range(num_bins)
        ],
    }


def _columns(data: Predictions) -> dict[str, NDArray[Any]]:
    """Return what every state contributes."""
    atoms, value = torch.from_numpy(data.atoms), torch.from_numpy(data.possibility)
    levels = torch.tensor(LEVELS, dtype=torch.float64)
    low, high = (atom_quantile(atoms, (1.0 + sign * levels) / 2.0) for sign in (-1.0, 1.0))
    near = value.to(atoms)[:, None]
    inside = (near >= low - TAIL) & (near <= high + TAIL)
    spread = atoms[:, :, None]
    promised = ((spread >= low[:, None] - TAIL) & (spread <= high[:, None] + TAIL)).float().mean(1)
    # A collision on the k-th step makes C = gamma^(k - 1): half-way to the next is the border of what comes within k.
    border = data.gamma ** (COLLISION_HORIZON - 0.5)
    probability = (atoms >= border).double().mean(-1)
    label = value >= border
    return {
        "risk": atom_mean(atoms).double().numpy(),
        "uncertainty": atom_variance(atoms).double().numpy(),
        "possibility": data.possibility,
        "crps": crps(atoms, value).double().numpy(),
        "probability": probability.numpy(),
        "label": label.double().numpy(),
        "width": (high - low)[:, LEVELS.index(0.8)].double().numpy(),
        "inside": inside.double().numpy(),
        "promised": promised.double().numpy(),
    }


def _numbers(columns: dict[str, NDArray[Any]], index: NDArray[np.int64]) -> dict[str, float]:
    """Return the numbers for some states, each as often as it is named."""
    risk, uncertainty, value, score, chance, label, width = (
        columns[name][index] for name in ("risk", "uncertainty", "possibility", "crps", "probability", "label", "width")
    )
    climate, base = _mean_difference(value) / 2.0, float(label.mean())
    brier, worst = float(np.square(chance - label).mean()), base * (1.0 - base)
    count, predicted, observed = _reliability(columns, index)
    gap = np.where(count > 0, count * np.abs(predicted - observed), 0.0).sum() / count.sum()
    varies = uncertainty.std() > 0 and risk.std() > 0
    return {
        "mean_risk": float(risk.mean()),
        "mean_possibility": float(value.mean()),
        "crps": float(score.mean()),
        "crps_skill": 1.0 - float(score.mean()) / climate if climate > 0 else np.nan,
        "collision_rate": base,
        "brier": brier,
        "brier_skill": 1.0 - brier / worst if worst > 0 else np.nan,
        "calibration_error": float(gap),
        "auroc": area_under_roc(risk, label),
        "width_80": float(width.mean()),
        "pearson_risk_uncertainty": correlation(risk, uncertainty),
        "spearman_risk_uncertainty": float(spearmanr(risk, uncertainty)[0]) if varies else np.nan,
    }


def _covered(columns: dict[str, NDArray[Any]], name: str, index: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the mean coverage of each level over the states at stake, NaN where there are none."""
    chosen = index[columns["risk"][index] >= STAKE]
    rows: NDArray[np.float64] = columns[name][chosen]
    return rows.mean(0) if len(rows) else np.full(len(LEVELS), np.nan)


def _reliability(columns: dict[str, NDArray[Any]], index: NDArray[np.int64]) -> tuple[NDArray[np.float64], ...]:
    """Return number of states, mean prediction and share that collided, for each bin; NaN where it is empty."""
    chance, label = columns["probability"][index], columns["label"][index]
    number = np.digitize(chance, PROBABILITY_EDGES) - 1
    bins = len(PROBABILITY_EDGES) - 1
    count = np.bincount(number, minlength=bins).astype(np.float64)
    filled = np.where(count > 0, count, np.nan)
    return count, np.bincount(number, chance, bins) / filled, np.bincount(number, label, bins) / filled


def _mean_difference(values: NDArray[np.float64]) -> float:
    """Return the mean of |x - x'| over all pairs, each with itself included."""
    count, ordered = len(values), np.sort(values)
    return float(2.0 * ((2.0 * np.arange(1, count + 1) - count - 1.0) * ordered).sum() / count**2)


def _below(data: Predictions, owner: NDArray[np.int64], count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return for each episode how many atoms, and how many outcomes, lie at or below the points of the grid."""
    found = []
    for values in (data.atoms.astype(np.float64), data.possibility[:, None]):
        number = np.searchsorted(_GRID, values.clip(_GRID[0], _GRID[-1]) - 1e-9)
        flat = (owner[:, None] * len(_GRID) + number).ravel()
        found.append(np.bincount(flat, minlength=count * len(_GRID)).reshape(count, -1).cumsum(-1).astype(np.float64))
    return found[0], found[1]


def _pooled_distance(below: tuple[NDArray[np.float64], NDArray[np.float64]], pick: NDArray[np.int64]) -> float:
    """Return the energy distance between all atoms together and all outcomes together."""
    predicted, came_out = (part[pick].sum(0) for part in below)
    gap = predicted / predicted[-1] - came_out / came_out[-1]
    return float(2.0 * np.square(gap).sum() * (_GRID[1] - _GRID[0]))
