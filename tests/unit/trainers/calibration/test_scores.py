"""Predictions are compared with outcomes by textbook scores, over the states whose outcome is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from cura_torchrl.trainers.calibration.scores import (
    LEVELS,
    PROBABILITY_EDGES,
    Predictions,
    crps,
    measure,
    realised_possibility,
)

GAMMA = 0.9


def test_the_possibility_of_a_collision_is_the_discount_of_the_steps_until_it():
    """Catches a discount that starts at the collision's own step: 1, 0.9, 0.81 backwards."""
    value, is_known = realised_possibility(np.array([4, 3, 2, 1]), collided=True, gamma=GAMMA)
    assert value.tolist() == pytest.approx([0.729, 0.81, 0.9, 1.0])
    assert is_known.all()


def test_states_before_a_cut_count_only_where_a_later_collision_would_hardly_matter():
    """Catches a tail that is cut one step off: 0.9^43 = 0.0108 and 0.9^44 = 0.0097 about 0.01."""
    value, is_known = realised_possibility(np.array([45, 44, 43, 1]), collided=False, gamma=GAMMA)
    assert value.tolist() == [0.0] * 4
    assert is_known.tolist() == [True, True, False, False]


def test_crps_is_the_integral_of_the_squared_difference_of_the_distribution_functions():
    """Catches a factor of two: compared with a fine Riemann sum."""
    rng = np.random.default_rng(0)
    atoms, values = rng.random((4, 50)), rng.random(4)
    x = np.linspace(-0.5, 1.5, 400_001)
    below = (atoms[:, :, None] <= x[None, None, ::10]).mean(1)
    expected = np.square(below - (x[::10] >= values[:, None])).sum(-1) * (x[10] - x[0])
    assert crps(torch.from_numpy(atoms), torch.from_numpy(values)).tolist() == pytest.approx(expected, abs=2e-4)


def test_crps_of_normal_atoms_is_the_closed_form():
    """Catches a score that is not that of the literature: sigma (z (2 Phi - 1) + 2 phi - 1 / sqrt(pi))."""
    levels = (torch.arange(4000, dtype=torch.float64) + 0.5) / 4000
    atoms, z = torch.special.ndtri(levels), 0.7
    phi, cdf = math.exp(-z * z / 2) / math.sqrt(2 * math.pi), 0.5 * (1 + math.erf(z / math.sqrt(2)))
    expected = z * (2 * cdf - 1) + 2 * phi - 1 / math.sqrt(math.pi)
    assert crps(atoms[None], torch.tensor([z])).item() == pytest.approx(expected, abs=1e-3)


def _calibrated(episodes: int = 400, size: int = 10, shift: float = 0.0) -> Predictions:
    """Return predictions uniform on [a, a + 0.4] whose outcomes are so too, but for a shift."""
    rng = np.random.default_rng(1)
    count = episodes * size
    start = rng.random(count) * 0.6
    atoms = start[:, None] + 0.4 * (np.arange(50) + 0.5) / 50
    rng.permuted(atoms, axis=1, out=atoms)
    return Predictions(
        atoms=atoms.astype(np.float32),
        possibility=start + 0.4 * rng.random(count) + shift,
        episode=np.repeat(np.arange(episodes), size),
        gamma=GAMMA,
    )


def test_intervals_of_a_calibrated_prediction_hold_what_they_promise():
    """Catches quantiles of unsorted atoms, and a promise that is not that of the widened interval."""
    found = measure(_calibrated(), draws=50)
    assert [row["level"] for row in found["coverage"]] == list(LEVELS)
    for row in found["coverage"]:
        value, low, high = row["came_out"]
        # 0.01 more on both sides of an interval within a width of 0.4.
        assert value == pytest.approx(min(row["level"] + 0.05, 1.0), abs=0.03)
        assert row["promised"] == pytest.approx(row["level"] + 0.05, abs=0.025)
        assert low <= value <= high
    assert found["numbers"]["width_80"][0] == pytest.approx(0.32, abs=0.01)
    shifted = measure(_calibrated(shift=0.3), draws=5)
    assert shifted["coverage"][4]["came_out"][0] < 0.2
    assert shifted["numbers"]["pooled_energy_distance"][0] > 20 * found["numbers"]["pooled_energy_distance"][0]


def test_the_reliability_diagram_finds_known_probabilities():
    """Catches bins that mix, a border of what is within 2 s that is off, and a Brier score of something else."""
    rng = np.random.default_rng(2)
    chance = rng.choice([0.0, 0.2, 0.6, 1.0], 20_000)
    hits = rng.random(20_000) < chance
    atoms = np.where(np.arange(50) < np.round(50 * chance)[:, None], GAMMA**9, GAMMA**10)  # on the 10th, 11th step
    data = Predictions(
        atoms=atoms.astype(np.float32),
        possibility=np.where(hits, GAMMA**9, GAMMA**10),
        episode=np.arange(20_000) // 20,
        gamma=GAMMA,
    )
    found = measure(data, draws=20)
    filled = [row for row in found["reliability"] if row["states"]]
    assert len(found["reliability"]) == len(PROBABILITY_EDGES) - 1
    assert [row["predicted"] for row in filled] == pytest.approx([0.0, 0.2, 0.6, 1.0])
    assert [row["came_out"][0] for row in filled] == pytest.approx([0.0, 0.2, 0.6, 1.0], abs=0.02)
    assert found["numbers"]["brier"][0] == pytest.approx((0.16 + 0.24) / 4, abs=0.005)
    assert found["numbers"]["collision_rate"][0] == pytest.approx(0.45, abs=0.01)
    assert found["numbers"]["calibration_error"][0] < 0.01
    # P(positive scores higher) + P(tie) / 2, of the shares 0, 1/9, 1/3, 5/9 and 5/11, 4/11, 2/11, 0.
    up, down = np.array([0, 0.2, 0.6, 1]) / 1.8, np.array([1, 0.8, 0.4, 0]) / 2.2
    expected = sum(up[i] * (down[:i].sum() + down[i] / 2) for i in range(4))
    assert found["numbers"]["auroc"][0] == pytest.approx(expected, abs=0.01)


def test_intervals_are_over_episodes_and_not_over_states():
    """Catches a bootstrap of states, whose interval shrinks when every state is there 30 times."""
    rng = np.random.default_rng(3)
    value = rng.random(30)
    width = []
    for times in (1, 30):
        data = Predictions(
            atoms=np.full((30 * times, 50), 0.5, dtype=np.float32),
            possibility=np.repeat(value, times),
            episode=np.repeat(np.arange(30), times),
            gamma=GAMMA,
        )
        _, low, high = measure(data, draws=200)["numbers"]["mean_possibility"]
        width.append(high - low)
    assert width[1] == pytest.approx(width[0])


def test_the_pooled_distance_is_that_of_all_atoms_from_all_outcomes():
    """Catches a grid that tells 0 from 0.0004: half of the atoms at 0.5, outcomes 0, so 2 * (1/2)^2 * 0.5."""
    atoms = np.tile(np.repeat([0.0004, 0.5], 25), (20, 1)).astype(np.float32)
    data = Predictions(atoms=atoms, possibility=np.zeros(20), episode=np.arange(20), gamma=GAMMA)
    assert measure(data, draws=5)["numbers"]["pooled_energy_distance"][0] == pytest.approx(0.25, abs=1e-3)


def test_coverage_is_told_where_something_is_at_stake():
    """Catches a coverage of 1 that is made of states in which nothing can happen."""
    atoms = np.concatenate([np.zeros((90, 50)), np.tile(np.linspace(0.3, 0.5, 50), (10, 1))]).astype(np.float32)
    data = Predictions(atoms=atoms, possibility=np.zeros(100), episode=np.arange(100), gamma=GAMMA)
    found = measure(data, draws=5)
    assert found["states_at_stake"] == 10
    assert found["coverage"][-1]["came_out"][0] == 0.0
