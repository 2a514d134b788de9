"""Statistics against numbers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cura_torchrl.trainers.statistics import area_under_roc, correlation, wilson_interval


def test_wilson_interval_is_the_closed_form() -> None:
    """Catches another interval (Wald's would be 0.552 to 1.048)."""
    # 8 of 10, z = 1.959964, z^2 = 3.841459: centre (0.8 + 0.192073) / 1.384146 = 0.716740,
    # half width 1.959964 sqrt(0.016 + 0.009604) / 1.384146 = 0.226577
    assert wilson_interval(8, 10) == pytest.approx((0.490162, 0.943318), abs=1e-6)


def test_wilson_interval_stays_within_0_and_1() -> None:
    """Catches bounds that no rate can have."""
    assert wilson_interval(0, 20)[0] == pytest.approx(0.0, abs=1e-12)
    assert wilson_interval(20, 20)[1] == pytest.approx(1.0, abs=1e-12)
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_auroc_counts_pairs_and_ties_half() -> None:
    """Catches ranks that break ties by position, which turns a constant score into a perfect or useless one."""
    generator = np.random.default_rng(0)
    scores = generator.integers(0, 5, 200) / 4.0
    labels = generator.random(200) < 0.3
    pairs = scores[labels][:, None] - scores[~labels][None]
    assert area_under_roc(scores, labels) == pytest.approx(((pairs > 0) + 0.5 * (pairs == 0)).mean(), abs=1e-12)
    assert area_under_roc(np.zeros(10), np.arange(10) < 3) == 0.5


def test_auroc_without_a_class_is_not_a_number() -> None:
    """Catches a perfect score reported for a rollout without collisions."""
    assert math.isnan(area_under_roc([0.1, 0.2], [0, 0]))


def test_correlation_is_pearson_s() -> None:
    """Catches a missing mean or a sample deviation beside a population covariance."""
    # x - mean = (-1, 0, 1), y - mean = (-1, 1, 0): covariance 1/3, both deviations sqrt(2/3)
    assert correlation([1, 2, 3], [0, 2, 1]) == pytest.approx(0.5, abs=1e-12)
    assert math.isnan(correlation([1, 1, 1], [0, 2, 1]))
