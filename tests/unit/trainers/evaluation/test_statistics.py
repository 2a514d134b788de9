"""Statistics against numbers worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cura_torchrl.trainers.evaluation.statistics import (
    area_under_roc,
    bootstrap_rates,
    correlation,
    interquartile_mean,
    mcnemar,
    paired_difference,
    share_recovered,
    wilson_interval,
)


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


def trials(both: int, first: int, second: int, neither: int) -> tuple[list[int], list[int]]:
    """Two sets of outcomes with these numbers of pairs."""
    return [1] * (both + first) + [0] * (second + neither), [1] * both + [0] * first + [1] * second + [0] * neither


def test_pairs_without_correlation_have_the_interval_of_independent_rates() -> None:
    """Catches bounds that are joined the wrong way round.

    40 of 50 after 30 of 50, phi = 0 (24 * 4 = 16 * 6). Wilson: 30 of 50 is 0.4618 to 0.7239, 40 of 50 is 0.6696 to
    0.8876; so 0.2 - sqrt(0.1304^2 + 0.1239^2) and 0.2 + sqrt(0.0876^2 + 0.1382^2).
    """
    one, other = trials(24, 6, 16, 4)
    assert paired_difference(one, other) == pytest.approx((0.2, 0.0201, 0.3636), abs=2e-4)


def test_pairs_that_agree_narrow_the_interval_by_newcombes_phi() -> None:
    """Catches the same data taken as independent.

    43 pairs agree in success, 3 and 4 differ, 50 in neither: phi = (43 * 50 - 3 * 4 - 50) / sqrt(46 * 47 * 54 * 53)
    = 0.8393; Wilson: 46 of 100 is 0.3656 to 0.5574, 47 of 100 is 0.3751 to 0.5671.
    """
    one, other = trials(43, 3, 4, 50)
    down = math.sqrt(0.0949**2 - 2 * 0.8393 * 0.0949 * 0.0974 + 0.0974**2)
    up = math.sqrt(0.0971**2 - 2 * 0.8393 * 0.0971 * 0.0944 + 0.0944**2)
    assert paired_difference(one, other) == pytest.approx((0.01, 0.01 - down, 0.01 + up), abs=3e-4)


def test_mcnemars_p_is_the_exact_binomial_one() -> None:
    """Catches pairs that agree and are counted, and a p of one side: 2 (C(10, 0) + C(10, 1) + C(10, 2)) / 2^10."""
    assert mcnemar(*trials(30, 8, 2, 60)) == pytest.approx(0.109375, abs=1e-12)
    assert mcnemar(*trials(30, 2, 8, 60)) == pytest.approx(0.109375, abs=1e-12)
    assert mcnemar(*trials(5, 0, 0, 5)) == 1.0


def test_interquartile_mean_leaves_a_quarter_out_at_each_end() -> None:
    """Catches a mean that an outlier moves, and an axis that is mistaken."""
    rates = [[0.0, 0.5, 0.6, 1.0], [1.0, 0.2, 0.4, 0.0]]
    assert interquartile_mean(rates) == pytest.approx([0.55, 0.3])
    assert float(interquartile_mean([0.0, 0.3, 0.9])) == pytest.approx(0.4)


def test_drawn_scenes_are_the_same_for_all_methods_and_drawn_seeds_are_not() -> None:
    """Catches pairs that are torn apart, which widens every interval of a difference."""
    one = np.arange(40) % 2 == 0
    first, same, opposite = bootstrap_rates([[[one], [one], [~one]]], samples=200)
    assert np.array_equal(first, same)
    assert np.allclose(first + opposite, 1.0)
    # A rate of 1/2 in 40 scenes: standard deviation sqrt(0.25 / 40) = 0.079
    assert first.std() == pytest.approx(0.079, abs=0.015)
    both = bootstrap_rates([[[one]], [[one]]], samples=200)[0].mean((1, 2))
    assert both.std() == pytest.approx(0.079, abs=0.015)  # the same scenes in a second cell tell nothing new
    with pytest.raises(ValueError, match=r"cells hold \[2, 3\] scenes; accepted: the same scenes in all"):
        bootstrap_rates([[[[0, 1]]], [[[0, 1, 1]]]])
    seeds = np.array([[1] * 9, [0] * 9])
    left, right = bootstrap_rates([[seeds, seeds], [seeds, seeds]], samples=200)
    assert np.allclose(left[:, :, 0], left[:, :, 1])  # one policy plays all cells
    assert not np.allclose(left, right)


def test_share_of_a_loss_over_cells_is_that_of_the_mean_rates() -> None:
    """Catches a mean of the cells' shares: here 1 and 0, where (0.8 - 0.6) / (0.9 - 0.6) is right."""
    high, none = [[1] * 10, [1] * 6 + [0] * 4, [1] * 10], [[1] * 8 + [0] * 2, [1] * 6 + [0] * 4, [1] * 6 + [0] * 4]
    share, low, upper = share_recovered([high, none])
    assert share == pytest.approx(2 / 3)
    assert low < share < upper
    assert math.isnan(share_recovered([[[1, 0], [1, 1], [1, 1]]])[0])


def test_pairs_that_do_not_vary_and_sets_of_other_sizes() -> None:
    """Catches a division by zero, and scenes that are paired with others."""
    assert paired_difference([1] * 9, [1] * 9)[0] == 0.0
    with pytest.raises(ValueError, match="9 and 8 trials; accepted: the same number"):
        paired_difference([1] * 9, [1] * 8)


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
