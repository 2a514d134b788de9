"""The paper's mathematics against independent NumPy in float64 and against numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cura_torchrl.objectives import energy_distance, sr_lambda_targets

GAMMA = 0.9
STEPS = 10
TRUTH = [0.387420489, 0.43046721, 0.4782969, 0.531441, 0.59049, 0.6561, 0.729, 0.81, 0.9, 1.0]
"""0.9^9 to 0.9^0: the collision possibility over ten steps of which the last collides."""


def _numpy_energy(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """All-pairs energy distance, diagonal included, and its gradient to x, by the signs of the differences."""
    cross, own, other = (p[..., :, None] - q[..., None, :] for p, q in ((x, y), (x, x), (y, y)))
    value = 2 * np.abs(cross).mean((-1, -2)) - np.abs(own).mean((-1, -2)) - np.abs(other).mean((-1, -2))
    gradient = 2 * np.sign(cross).mean(-1) / x.shape[-1] - 2 * np.sign(own).mean(-1) / x.shape[-1]
    return value, gradient


@pytest.mark.parametrize(("num_x", "num_y"), [(50, 50), (50, 7), (1, 50), (3, 1)])
def test_energy_distance_and_gradient_equal_all_pairs_in_float64(num_x: int, num_y: int) -> None:
    """Catches wrong rank weights, above all for sets of different sizes; float32 against float64 to 1e-6."""
    rng = np.random.default_rng(0)
    x, y = rng.normal(0.2, 0.5, (64, num_x)), rng.random((64, num_y))
    value, gradient = _numpy_energy(x.astype(np.float32).astype(np.float64), y.astype(np.float32).astype(np.float64))
    prediction = torch.tensor(x, dtype=torch.float32, requires_grad=True)
    distance = energy_distance(prediction, torch.tensor(y, dtype=torch.float32))
    distance.sum().backward()
    assert np.abs(distance.detach().numpy() - value).max() < 1e-6
    assert np.abs(prediction.grad.numpy() - gradient).max() < 1e-6


def _ten_steps(rollouts: int, atoms: int, lmbda: float) -> torch.Tensor:
    """Targets of an episode that collides at its last step, with an estimator that predicts 0."""
    end = torch.zeros(rollouts, STEPS, 1, dtype=torch.bool)
    end[:, -1] = True
    zeros = torch.zeros(rollouts, STEPS, atoms)
    generator = torch.Generator().manual_seed(0)
    return sr_lambda_targets(
        end.float(), zeros, end, torch.zeros_like(end), gamma=GAMMA, lmbda=lmbda, generator=generator
    )


def test_one_step_targets_of_a_collision_reach_only_the_last_step() -> None:
    """Catches lambda = 0 that looks further than one step: 0, ..., 0, 1."""
    assert torch.equal(_ten_steps(2, 3, 0.0), torch.tensor([0.0] * 9 + [1.0])[:, None].expand(2, STEPS, 3))


def test_monte_carlo_targets_of_a_collision_are_the_truth() -> None:
    """Catches a trace cut before the terminal step: then all targets but the last would be 0, the estimator's word."""
    targets = _ten_steps(2, 3, 1.0)
    assert torch.allclose(targets, torch.tensor(TRUTH)[:, None].expand(2, STEPS, 3), rtol=1e-6)


def test_sr_targets_of_a_collision_are_right_in_expectation() -> None:
    """Catches a probability applied twice or to the wrong side: k steps before the end the mean is (0.95 * 0.9)^k.

    An atom is 0.9^k with probability p = 0.95^k and else 0. 500 rollouts of 50 atoms give n = 25,000 independent atoms,
    so the mean has the standard error 0.9^k sqrt(p (1 - p) / n); five of them are exceeded once in 1.7 million.
    """
    steps_left = np.arange(STEPS)[::-1]
    kept = 0.95**steps_left
    expected = kept * 0.9**steps_left
    error = 0.9**steps_left * np.sqrt(kept * (1 - kept) / 25_000)
    mean = _ten_steps(500, 50, 0.95).mean((0, 2)).numpy()
    assert (np.abs(mean - expected) <= 5 * error + 1e-6).all()
    assert expected[0] == pytest.approx(0.2442, abs=1e-4)


def test_each_sr_target_atom_is_one_n_step_return() -> None:
    """Catches averaging of returns, which would shrink the target's variance: atoms are the truth or 0, not between."""
    targets = _ten_steps(20, 50, 0.95)
    truth = torch.tensor(TRUTH)[:, None]
    assert (torch.isclose(targets, truth) | (targets == 0.0)).all()
