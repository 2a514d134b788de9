"""Properties of the energy distance that hold for all atoms."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from cura_torchrl.objectives import energy_distance

# Whole multiples of 1/64: ties are frequent, and sums and differences are exact.
ELEMENTS = st.integers(-640, 640).map(lambda i: i / 64)
ATOMS = hnp.arrays(np.float64, st.integers(1, 12), elements=ELEMENTS).map(torch.from_numpy)


def _all_pairs(x: torch.Tensor, y: torch.Tensor) -> float:
    a, b = x.numpy(), y.numpy()
    cross, own, other = (np.abs(p[:, None] - q).mean() for p, q in ((a, b), (a, a), (b, b)))
    return float(2 * cross - own - other)


@given(ATOMS, ATOMS)
@settings(deadline=None)
def test_it_equals_the_form_over_all_pairs(x: torch.Tensor, y: torch.Tensor) -> None:
    """Catches ties between or within the sets, sets of one atom, and sets of different sizes."""
    assert abs(energy_distance(x, y).item() - _all_pairs(x, y)) < 1e-12


@given(ATOMS, ATOMS)
@settings(deadline=None)
def test_it_is_symmetric_and_not_negative(x: torch.Tensor, y: torch.Tensor) -> None:
    """Catches a lost absolute value, without which the distance is unbounded below."""
    distance = energy_distance(x, y).item()
    assert distance >= -1e-12
    assert abs(distance - energy_distance(y, x).item()) < 1e-12


@given(ATOMS, st.randoms(use_true_random=False), st.integers(1, 4))
@settings(deadline=None)
def test_it_is_zero_for_the_same_distribution(x: torch.Tensor, random: object, copies: int) -> None:
    """Catches a dependence on the order of the atoms or on their number: repeating each one changes nothing."""
    order = list(range(x.shape[0] * copies))
    random.shuffle(order)
    assert abs(energy_distance(x, x.repeat(copies)[order]).item()) < 1e-12


@given(ATOMS, ATOMS, ELEMENTS, st.integers(1, 8))
@settings(deadline=None)
def test_it_ignores_the_origin_and_scales_with_the_atoms(
    x: torch.Tensor, y: torch.Tensor, shift: float, k: int
) -> None:
    """Catches weights that do not sum to zero, and a squared distance."""
    distance = energy_distance(x, y).item()
    assert abs(energy_distance(x + shift, y + shift).item() - distance) < 1e-12
    assert abs(energy_distance(-k * x, -k * y).item() - k * distance) < 1e-11


@given(ATOMS, ATOMS)
@settings(deadline=None)
def test_gradients_of_both_sets_cancel(x: torch.Tensor, y: torch.Tensor) -> None:
    """Catches a gradient that would move both sets together, ties included: translation changes nothing."""
    x, y = x.clone().requires_grad_(), y.clone().requires_grad_()
    energy_distance(x, y).backward()
    assert abs((x.grad.sum() + y.grad.sum()).item()) < 1e-12
