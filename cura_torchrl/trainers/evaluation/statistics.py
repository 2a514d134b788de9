"""Statistics of success rates and of the collision estimator: NumPy in, numbers out."""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import binomtest, rankdata, trim_mean

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import ArrayLike, NDArray

BOOTSTRAP = 10_000
"""Samples of a bootstrap [1]."""


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return Wilson's interval of a rate.

    Args:
        successes: Number of successes.
        trials: Number of trials; with none the interval is (0, 1).
        confidence: Confidence level [1].

    Returns:
        Lower and upper bound [1].

    Source:
        Wilson (1927), Probable inference, the law of succession, and statistical inference.

    Examples:
        >>> [round(bound, 4) for bound in wilson_interval(57, 60)]
        [0.863, 0.9829]
    """
    if trials == 0:
        return 0.0, 1.0
    interval = binomtest(successes, trials).proportion_ci(confidence_level=confidence, method="wilson")
    return float(interval.low), float(interval.high)


def paired_difference(first: ArrayLike, second: ArrayLike, confidence: float = 0.95) -> tuple[float, float, float]:
    """Return how much a rate rises from one set of trials to another set on the same subjects, with its interval.

    Args:
        first: Whether each trial succeeded, shape ``[M]``.
        second: The same for the other set, subject by subject, shape ``[M]``.
        confidence: Confidence level [1].

    Returns:
        Rate of the second less that of the first, lower and upper bound [1].

    Raises:
        ValueError: If the sets are empty or differ in size.

    Source:
        Newcombe (1998), "Improved confidence intervals for the difference between binomial proportions based on paired
        data", method 10: Wilson's bounds, joined with the correlation phi of the pairs.

    Examples:
        >>> [round(value, 3) for value in paired_difference([1, 1, 0, 0] * 25, [1, 1, 1, 0] * 25)]
        [0.25, 0.161, 0.333]
    """
    one, other = (np.asarray(trials, dtype=bool).ravel() for trials in (first, second))
    count = one.size
    if count == 0 or other.size != count:
        msg = f"the sets hold {one.size} and {other.size} trials; accepted: the same number, at least one"
        raise ValueError(msg)
    bounds = [wilson_interval(int(trials.sum()), count, confidence) for trials in (one, other)]
    (below_one, above_one), (below_other, above_other) = (
        (trials.mean() - low, high - trials.mean()) for trials, (low, high) in zip((one, other), bounds, strict=True)
    )
    phi, middle = _phi(one, other), float(other.mean() - one.mean())
    down = math.sqrt(below_other**2 - 2 * phi * below_other * above_one + above_one**2)
    up = math.sqrt(above_other**2 - 2 * phi * above_other * below_one + below_one**2)
    return middle, middle - down, middle + up


def _phi(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    """Return the correlation of paired outcomes, less where it is positive: Newcombe corrects it."""
    count, both = one.size, float((one & other).sum())
    neither, only_one, only_other = (
        float((~one & ~other).sum()),
        float((one & ~other).sum()),
        float((other & ~one).sum()),
    )
    product = float(one.sum()) * float(other.sum()) * (count - float(one.sum())) * (count - float(other.sum()))
    excess = both * neither - only_one * only_other
    return (max(excess - count / 2, 0.0) if excess > 0 else excess) / math.sqrt(product) if product > 0 else 0.0


def mcnemar(first: ArrayLike, second: ArrayLike) -> float:
    """Return how likely pairs differ as unevenly as these do, or more so, if both rates are the same.

    Args:
        first: Whether each trial succeeded, shape ``[M]``.
        second: The same for the other set, subject by subject, shape ``[M]``.

    Returns:
        Exact two-sided p [1]; 1 where no pair differs.

    Source:
        McNemar (1947); exact: the discordant pairs are a binomial sample of rate 1/2.

    Examples:
        >>> mcnemar([1] * 8 + [0] * 2, [0] * 8 + [1] * 2)
        0.109375
    """
    one, other = (np.asarray(trials, dtype=bool).ravel() for trials in (first, second))
    only_one, only_other = int((one & ~other).sum()), int((other & ~one).sum())
    if only_one + only_other == 0:
        return 1.0
    return float(binomtest(only_one, only_one + only_other, 0.5).pvalue)


def interquartile_mean(rates: ArrayLike) -> NDArray[np.float64]:
    """Return the mean of the middle half.

    Args:
        rates: Rates, shape ``[..., M]``; of fewer than four none is left out.

    Returns:
        Their interquartile mean, shape ``[...]``.

    Source:
        Agarwal et al. (2021), Deep reinforcement learning at the edge of the statistical precipice.

    Examples:
        >>> float(interquartile_mean([0.0, 0.4, 0.6, 1.0]))
        0.5
    """
    return np.asarray(trim_mean(np.asarray(rates, dtype=np.float64), 0.25, axis=-1))


def bootstrap_rates(
    cells: Sequence[Sequence[ArrayLike]], samples: int = BOOTSTRAP, seed: int = 0
) -> list[NDArray[np.float64]]:
    """Return success rates of scenes and training seeds that are drawn anew, with replacement.

    Scenes are drawn once for all cells and methods: the methods are paired, and scene i has the same goal, friction and
    times in every cell, so that cells are no independent samples. Seeds are drawn for each method apart, the same for
    all cells, for one policy plays them all; with one seed only scenes vary.

    Args:
        cells: For each cell, for each method, whether each trial succeeded, shape ``[S, M]``: S seeds, M scenes.
        samples: How often they are drawn, B [1].
        seed: Seed of the draw [1].

    Returns:
        For each method the rates [1], shape ``[B, S, C]``: C cells.

    Raises:
        ValueError: If cells differ in their number of scenes.

    Examples:
        >>> [rates.shape for rates in bootstrap_rates([[[[1, 0, 1]], [[1, 1, 1]]]], samples=5)]
        [(5, 1, 1), (5, 1, 1)]
    """
    rng = np.random.default_rng(seed)
    trials = [[np.atleast_2d(np.asarray(entry, dtype=np.float64)) for entry in cell] for cell in cells]
    drawn = [rng.integers(0, len(entry), (samples, len(entry))) for entry in trials[0]]
    count, *others = {entry.shape[1] for cell in trials for entry in cell}
    if others:
        msg = f"cells hold {sorted([count, *others])} scenes; accepted: the same scenes in all"
        raise ValueError(msg)
    weights = rng.multinomial(count, np.full(count, 1.0 / count), samples) / count
    methods = zip(*trials, strict=True)
    return [
        np.stack([np.take_along_axis(weights @ entry.T, seeds, 1) for entry in method], axis=-1)
        for seeds, method in zip(drawn, methods, strict=True)
    ]


def share_recovered(cells: Sequence[Sequence[ArrayLike]], confidence: float = 0.95) -> tuple[float, float, float]:
    """Return the share of a loss that a method wins back, with its bootstrap interval over seeds and scenes.

    Args:
        cells: For each cell, whether each trial succeeded without the loss, with it, and with the method, each of shape
            ``[S, M]``: S training seeds, M scenes. Cells have equal weight.
        confidence: Confidence level [1].

    Returns:
        (method - loss) / (no loss - loss), lower and upper bound [1]. NaN where nothing is lost; the bounds are NaN
        where so many samples have no loss that the interval has an end at infinity.

    Examples:
        >>> share_recovered([[[1] * 10, [1] * 2 + [0] * 8, [1] * 8 + [0] * 2]])[0]
        0.75
    """
    free, lossy, method = (np.mean([np.mean(np.asarray(cell[k])) for cell in cells]) for k in range(3))
    if free <= lossy:
        return math.nan, math.nan, math.nan
    share = float(round((method - lossy) / (free - lossy), 12))
    tail = (1.0 - confidence) / 2.0
    without, with_, won = (rates.mean((1, 2)) for rates in bootstrap_rates(cells))
    has_loss = without - with_ > 1e-12
    if has_loss.mean() <= 1.0 - tail:
        return share, math.nan, math.nan
    low, high = np.quantile((won - with_)[has_loss] / (without - with_)[has_loss], (tail, 1.0 - tail))
    return share, float(low), float(high)


def bootstrap_interval(
    statistic: Callable[[NDArray[np.int64]], float | NDArray[np.float64]], count: int, draws: int = 1000
) -> list[Any]:
    """Return the 95 % percentile interval of a statistic over resampled units.

    Args:
        statistic: From the indices of the units that were drawn, with repetition. Draws that give NaN are left out.
        count: Units, such as episodes or states.
        draws: Resamples.

    Returns:
        Lower and upper bound; for an array, of each entry.

    Examples:
        >>> bootstrap_interval(lambda pick: float(pick.mean()), 1, draws=10)
        [0.0, 0.0]
    """
    generator = np.random.default_rng(0)
    values = np.array([statistic(generator.integers(count, size=count)) for _ in range(draws)])
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "All-NaN", RuntimeWarning)
        bounds: list[Any] = np.nanquantile(values, (0.025, 0.975), axis=0).tolist()
    return bounds


def area_under_roc(scores: ArrayLike, labels: ArrayLike) -> float:
    """Return the probability that a positive sample scores higher than a negative one, ties counted half.

    Args:
        scores: Scores, shape ``[M]``.
        labels: Whether a sample is positive, shape ``[M]``.

    Returns:
        Area under the receiver operating characteristic [1]; NaN where there are no positives or no negatives.

    Source:
        Mann and Whitney (1947): AUROC = (sum of the positives' ranks - P (P + 1) / 2) / (P Q).

    Examples:
        >>> area_under_roc([0.1, 0.4, 0.35, 0.8], [0, 0, 1, 1])
        0.75
    """
    positive = np.asarray(labels, dtype=bool).ravel()
    num_positive = int(positive.sum())
    num_negative = positive.size - num_positive
    if num_positive == 0 or num_negative == 0:
        return math.nan
    ranks = rankdata(np.asarray(scores, dtype=np.float64).ravel())
    rank_sum = float(ranks[positive].sum()) - num_positive * (num_positive + 1) / 2
    return rank_sum / (num_positive * num_negative)


def correlation(first: ArrayLike, second: ArrayLike) -> float:
    """Return Pearson's correlation.

    Args:
        first: Samples, shape ``[M]``.
        second: Samples, shape ``[M]``.

    Returns:
        Correlation [1]; NaN where either does not vary.

    Examples:
        >>> correlation([1.0, 2.0, 3.0], [2.0, 4.0, 6.0])
        1.0
    """
    x = np.asarray(first, dtype=np.float64).ravel()
    y = np.asarray(second, dtype=np.float64).ravel()
    if x.std() == 0.0 or y.std() == 0.0:
        return math.nan
    return float(np.clip(np.mean((x - x.mean()) * (y - y.mean())) / (x.std() * y.std()), -1.0, 1.0))
