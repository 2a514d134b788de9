"""Statistics of success rates and of the collision estimator: NumPy in, numbers out."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import binomtest, rankdata

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


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
