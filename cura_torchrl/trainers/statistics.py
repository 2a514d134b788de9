"""Statistics of success rates and of the collision estimator: NumPy in, numbers out."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import binomtest, rankdata

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


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
