"""Statistics of collision atoms."""

from __future__ import annotations

import math
import pickle
from functools import partial

import pytest
import torch

from cura_torchrl.modules import (
    atom_mean,
    atom_quantile,
    atom_variance,
    conditional_value_at_risk,
    make_risk_measure,
    quantile_midpoints,
    wang_risk,
)

ATOMS = torch.tensor([0.5, 0.0, 1.0, 0.1, 0.4])
"""Unsorted; sorted 0, 0.1, 0.4, 0.5, 1; sum 2, sum of squares 0.01 + 0.16 + 0.25 + 1 = 1.42."""


def test_midpoints_are_centred_on_equal_shares() -> None:
    """Catches levels i/N or (i+1)/N, which would bias every quantile read-out by half an atom."""
    assert torch.allclose(quantile_midpoints(50)[[0, 1, 49]], torch.tensor([0.01, 0.03, 0.99]))
    with pytest.raises(ValueError, match="num_atoms is 0"):
        quantile_midpoints(0)


def test_variance_is_that_of_the_population() -> None:
    """Catches the sample variance, which is N / (N - 1) too large against the paper's Eq. (6)."""
    assert atom_mean(ATOMS).item() == pytest.approx(0.4)
    assert atom_variance(ATOMS).item() == pytest.approx(1.42 / 5 - 0.4**2)  # 0.284 - 0.16 = 0.124


def test_variance_of_equal_atoms_has_a_finite_gradient() -> None:
    """Catches a variance computed through a square root, whose gradient is NaN at zero."""
    atoms = torch.full((3, 4), 0.5, requires_grad=True)
    atom_variance(atoms).sum().backward()
    assert torch.equal(atoms.grad, torch.zeros(3, 4))


def test_quantiles_at_the_midpoints_are_the_sorted_atoms() -> None:
    """Catches a read-out by output index: outputs trained by energy distance come in no order."""
    assert torch.equal(atom_quantile(ATOMS, quantile_midpoints(5)), ATOMS.sort().values)


@pytest.mark.parametrize("num_atoms", [3, 7, 50, 100])
def test_quantile_at_a_share_boundary_is_the_atom_below_it(num_atoms: int) -> None:
    """Catches rounding in level * N, by which 0.07 * 100 = 7.000001 would be the eighth atom."""
    levels = torch.arange(1, num_atoms + 1) / num_atoms
    assert torch.equal(atom_quantile(torch.arange(num_atoms), levels), torch.arange(num_atoms))


@pytest.mark.parametrize(
    ("alpha", "expected"),
    [
        (1.0, 0.4),  # all of it: the mean
        (0.2, 1.0),  # one atom of five
        (0.4, 0.75),  # (1 + 0.5) / 2
        (0.5, (1.0 + 0.5 + 0.5 * 0.4) / 2.5),  # two atoms and half of the third
        (0.01, 1.0),  # less than an atom: the largest
    ],
)
def test_cvar_is_the_mean_of_the_upper_tail(alpha: float, expected: float) -> None:
    """Catches the lower tail (returns, not costs), and whole atoms where the tail's edge falls inside one."""
    assert conditional_value_at_risk(ATOMS, alpha).item() == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("alpha", [0.0, -0.1, 1.1, math.nan])
def test_cvar_refuses_a_tail_that_is_none(alpha: float) -> None:
    """Catches a division by zero that would come out as NaN risk."""
    with pytest.raises(ValueError, match="accepted: above 0 to 1"):
        conditional_value_at_risk(ATOMS, alpha)


@pytest.mark.parametrize("beta", [-0.5, 0.0, 1.0])
def test_wang_shifts_a_normal_distribution_by_beta_deviations(beta: float) -> None:
    """Catches the wrong sign of beta and weights that do not sum to one; closed form: m + beta s."""
    levels = quantile_midpoints(20_001, dtype=torch.float64)
    normal = 2.0 + 3.0 * torch.special.ndtri(levels)
    # The outermost atoms stand for the tails beyond them: 20,001 atoms leave an error of 1e-3 deviations.
    assert wang_risk(normal, beta).item() == pytest.approx(2.0 + 3.0 * beta, abs=5e-3)


def test_measures_work_over_any_leading_shape() -> None:
    """Catches a reduction over the wrong dimension."""
    batch = torch.stack([ATOMS, ATOMS + 1.0]).expand(4, 2, 5)
    measures = (atom_mean, atom_variance, partial(conditional_value_at_risk, alpha=0.3), partial(wang_risk, beta=0.5))
    for measure in measures:
        assert measure(batch).shape == (4, 2)
        assert measure(batch)[3, 0].item() == pytest.approx(measure(ATOMS).item())
    assert atom_quantile(batch, torch.tensor([0.1, 0.5, 0.9])).shape == (4, 2, 3)


@pytest.mark.parametrize(
    ("kind", "level", "expected"),
    [
        ("mean", 0.5, 0.425),  # (0.5 + 1.3 - 0.2 + 0.1) / 4, as it is
        ("cvar", 0.5, 0.75),  # (1.0 + 0.5) / 2
        ("cvar", 0.125, 1.0),  # half of the largest atom
        ("cvar", 1.0, 0.4),  # (0.5 + 1.0 + 0.0 + 0.1) / 4
        ("wang", 0.0, 0.4),
    ],
)
def test_measures_by_name_keep_the_tail_inside_the_range_of_the_possibility(
    kind: str, level: float, expected: float
) -> None:
    """Catches a level that is not passed on, and a risk above 1, which no discounted indicator can have."""
    measure = pickle.loads(pickle.dumps(make_risk_measure(kind, level)))
    assert measure(torch.tensor([0.5, 1.3, -0.2, 0.1])).item() == pytest.approx(expected)


def test_wang_by_name_has_the_level_as_its_shift() -> None:
    """Catches CVaR under Wang's name: the upper one of two atoms weighs 1 - Phi(-1) = 0.8413."""
    assert make_risk_measure("wang", 1.0)(torch.tensor([1.0, 0.0])).item() == pytest.approx(0.8413, abs=1e-4)


@pytest.mark.parametrize(
    ("kind", "level", "message"),
    [
        ("cvar", 0.0, r"alpha is 0\.0; accepted: above 0 to 1"),
        ("cvar", 1.5, r"alpha is 1\.5; accepted: above 0 to 1"),
        ("cvar", math.nan, r"alpha is nan; accepted: above 0 to 1"),
        ("wang", -0.5, r"beta is -0\.5; accepted: 0 or more"),
        ("wang", math.nan, r"beta is nan; accepted: 0 or more"),
    ],
)
def test_a_level_out_of_range_is_refused_when_the_measure_is_made(kind: str, level: float, message: str) -> None:
    """Catches a level that is found to be wrong in the first step of training, or never."""
    with pytest.raises(ValueError, match=message):
        make_risk_measure(kind, level)


def test_an_unknown_measure_is_refused() -> None:
    """Catches a wrong name that falls back to the mean."""
    with pytest.raises(ValueError, match="risk measure is 'var'; accepted: mean, cvar, wang"):
        make_risk_measure("var")
