"""Mathematics of CURA-PPO: numbers worked out by hand."""

from __future__ import annotations

import pytest
import torch

from cura_torchrl.objectives import (
    energy_distance,
    normalise,
    risk_cost,
    sr_lambda_targets,
    standardise,
    uncertainty_cost,
)
from cura_torchrl.objectives.functional import masked_moments


def _column(*values: float) -> torch.Tensor:
    return torch.tensor(values).unsqueeze(-1)


def test_energy_distance_gradient_is_exact_in_double_precision(generator: torch.Generator) -> None:
    """Catches a gradient that is not that of the value, to either argument."""
    x = torch.randn(3, 7, dtype=torch.float64, generator=generator, requires_grad=True)
    y = torch.randn(3, 4, dtype=torch.float64, generator=generator, requires_grad=True)
    assert torch.autograd.gradcheck(energy_distance, (x, y))


def test_energy_distance_pulls_a_point_to_the_target_and_keeps_a_spread() -> None:
    """Catches the spread term's sign, without which predictions collapse to the median."""
    target = torch.tensor([0.0, 1.0])
    spread, point = torch.tensor([0.0, 1.0]), torch.tensor([0.5, 0.5])
    # point: 2 * 0.5 - 0 - 0.5 = 0.5
    assert energy_distance(spread, target).item() == 0.0
    assert energy_distance(point, target).item() == pytest.approx(0.5)


def test_energy_distance_survives_a_large_offset() -> None:
    """Catches cancellation: at 10,000, float32 resolves 0.001, and the weights must not multiply the offset."""
    x, y = torch.tensor([0.0, 2.0]) + 1e4, torch.tensor([1.0]) + 1e4
    assert energy_distance(x, y).item() == pytest.approx(1.0, abs=1e-6)


def test_energy_distance_refuses_sets_that_do_not_fit() -> None:
    """Catches silent broadcasting of a target without the batch, and the distance of nothing."""
    for target in (torch.zeros(5), torch.zeros(3, 0)):
        with pytest.raises(ValueError, match=r"prediction has shape \(3, 5\)"):
            energy_distance(torch.zeros(3, 5), target)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_energy_distance_sums_half_precision_in_single(dtype: torch.dtype, generator: torch.Generator) -> None:
    """Catches sums that leave the range of half precision: 50 atoms make steps of 247,500."""
    one, other = (torch.rand(4, 50, generator=generator).to(dtype) + shift for shift in (0.0, 2.0))
    one.requires_grad_()
    distance = energy_distance(one, other)
    assert distance.dtype == dtype
    torch.testing.assert_close(distance.float(), energy_distance(one.float(), other.float()), rtol=1e-2, atol=1e-3)
    distance.sum().backward()
    assert one.grad.isfinite().all()


def test_energy_distance_follows_transforms_of_functions(generator: torch.Generator) -> None:
    """Catches a function of its own that vmap and grad cannot look into."""
    one, other = torch.rand(2, 4, 50, generator=generator).unbind(0)
    torch.testing.assert_close(torch.vmap(energy_distance)(one, other), energy_distance(one, other))
    slope = torch.func.grad(lambda atoms: energy_distance(atoms, other).sum())(one)
    expected = one.clone().requires_grad_()
    energy_distance(expected, other).sum().backward()
    torch.testing.assert_close(slope, expected.grad)


def test_energy_distance_compiles_into_one_graph() -> None:
    """Catches a branch on data, which would break torch.compile's graph, and wrong tensor operations."""
    compiled = torch.compile(energy_distance, fullgraph=True, backend="eager")
    x, y = torch.rand(4, 6), torch.rand(4, 5)
    torch.testing.assert_close(compiled(x, y), energy_distance(x, y), rtol=0.0, atol=1e-6)


def _targets(lmbda: float, atoms: list[float], ends: dict[int, str], costs: list[float]) -> torch.Tensor:
    """Targets with gamma 0.5 of one atom a step; ``ends`` maps steps to terminated or truncated."""
    flags = {kind: torch.tensor([[ends.get(t) == kind] for t in range(len(costs))]) for kind in ("term", "trunc")}
    z = _column(*atoms)
    return sr_lambda_targets(_column(*costs), z, flags["term"], flags["trunc"], gamma=0.5, lmbda=lmbda).squeeze(-1)


def test_one_step_targets_bootstrap_everywhere_but_after_the_end() -> None:
    """Catches a bootstrap after a collision; c + 0.5 z, and 1 at the collision."""
    targets = _targets(0.0, [0.2, 0.4, 0.8, 0.6], {1: "term", 2: "trunc"}, [0.0, 1.0, 0.0, 0.0])
    assert targets.tolist() == pytest.approx([0.1, 1.0, 0.4, 0.3])


def test_monte_carlo_targets_keep_episodes_apart() -> None:
    """Catches credit that leaks from one episode into the one before it in the same row.

    Steps 0-1 end in a collision: 0.5, 1. Steps 2-3 are truncated: bootstrap 0.6 twice discounted, 0.15, 0.3. Step 4-5
    run to the end of the rollout: bootstrap 0.8, so 0.2, 0.4.
    """
    ends = {1: "term", 3: "trunc"}
    targets = _targets(1.0, [0.9, 0.9, 0.9, 0.6, 0.9, 0.8], ends, [0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    assert targets.tolist() == pytest.approx([0.5, 1.0, 0.15, 0.3, 0.2, 0.4])


def test_a_step_both_terminated_and_truncated_is_terminal() -> None:
    """Catches a bootstrap when a collision falls on the time limit."""
    both = torch.tensor([[True]])
    z = torch.tensor([[0.7, 0.9]])
    targets = sr_lambda_targets(torch.ones(1, 1), z, both, both, gamma=0.9, lmbda=0.95)
    assert targets.tolist() == [[1.0, 1.0]]


def test_bootstrapped_atoms_are_clamped_to_the_range_of_the_collision_possibility() -> None:
    """Catches targets that chase an unbounded head out of [0, 1]."""
    no = torch.zeros(1, 1, dtype=torch.bool)
    z = torch.tensor([[-3.0, 0.5, 7.0]])
    targets = sr_lambda_targets(torch.zeros(1, 1), z, no, no, gamma=0.9, lmbda=0.5)
    assert targets.tolist()[0] == pytest.approx([0.0, 0.45, 0.9])


def test_a_broken_estimator_does_not_touch_terminal_targets() -> None:
    """Catches 0 * NaN = NaN in place of a choice."""
    z = torch.full((2, 3), float("nan"))
    end = torch.tensor([[False], [True]])
    targets = sr_lambda_targets(end.float(), z, end, ~end & end, gamma=0.9, lmbda=1.0)
    assert torch.allclose(targets, torch.tensor([[0.9] * 3, [1.0] * 3]))


def test_targets_are_repeatable_by_their_generator_and_carry_no_gradient() -> None:
    """Catches the global generator in use, and a gradient into the old estimator."""
    z = torch.rand(4, 16, 50, requires_grad=True)
    no = torch.zeros(4, 16, 1, dtype=torch.bool)

    def targets(seed: int) -> torch.Tensor:
        source = torch.Generator().manual_seed(seed)
        return sr_lambda_targets(no.float(), z, no, no, gamma=0.9, lmbda=0.5, generator=source)

    assert torch.equal(targets(3), targets(3))
    assert not torch.equal(targets(3), targets(4))
    assert not targets(3).requires_grad


def test_equal_sets_are_mixed_without_noise() -> None:
    """Catches shuffled pairing: where return and estimator agree atom by atom, the target is that set again."""
    z = torch.rand(50).expand(2, 8, 50)
    no = torch.zeros(2, 8, 1, dtype=torch.bool)
    targets = sr_lambda_targets(no.float(), z, no, no, gamma=1.0, lmbda=0.5)
    assert torch.equal(targets, z)


def test_sr_targets_refuse_shapes_that_would_broadcast() -> None:
    """Catches a missing trailing dimension, by which [B, T] flags would broadcast against the atoms."""
    z, good, bad = torch.zeros(4, 8, 8), torch.zeros(4, 8, 1, dtype=torch.bool), torch.zeros(4, 8, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"accepted: \[\*B, T, 1\]"):
        sr_lambda_targets(good.float(), z, bad, good, gamma=0.9, lmbda=0.5)
    with pytest.raises(ValueError, match="at least 1"):
        sr_lambda_targets(good[:, :0], z[:, :0], good[:, :0], good[:, :0], gamma=0.9, lmbda=0.5)


def test_risk_cost_drops_the_future_after_the_end() -> None:
    """Catches R of the state after a collision; 0 + 0.9 * 0.5 - 0.2 = 0.25, and 1 - 0.2 = 0.8."""
    cost = risk_cost(
        _column(0.0, 1.0), _column(0.2, 0.2), _column(0.5, 0.5), torch.tensor([[False], [True]]), gamma=0.9
    )
    assert torch.allclose(cost, _column(0.25, 0.8))


def test_uncertainty_cost_is_negative_where_the_view_clears() -> None:
    """Catches a discount or the reverse sign: 0.05 - 0.2 = -0.15."""
    assert torch.allclose(uncertainty_cost(_column(0.2), _column(0.05)), _column(-0.15))


def test_normalise_leaves_masked_steps_out_of_the_statistics_and_at_zero() -> None:
    """Catches a collision's uncertainty in the mean: of 1, 3, 5 the mean is 3 and the deviation sqrt(8 / 3)."""
    values, mask = _column(1.0, 3.0, 5.0, -100.0), torch.tensor([[True], [True], [True], [False]])
    out = normalise(values, floor=0.005, clip=5.0, mask=mask)
    assert torch.allclose(out, _column(-2.0, 0.0, 2.0, 0.0) / (8.0 / 3.0) ** 0.5)


def test_normalise_divides_small_noise_by_the_floor() -> None:
    """Catches a z-score of pure noise: deviation 1e-4 over the floor 0.005 is 0.02."""
    assert torch.allclose(normalise(_column(1e-4, -1e-4), floor=0.005, clip=5.0), _column(0.02, -0.02))


def test_normalise_clips_the_rare_collision() -> None:
    """Catches an outlier of (n - 1) / sqrt(n - 1) = 99.5 deviations among n = 9,900."""
    values = torch.zeros(9900, 1)
    values[0] = 1.0
    assert normalise(values, floor=0.005, clip=5.0).max().item() == 5.0


def test_normalise_of_nothing_is_zero() -> None:
    """Catches 0 / 0 when every step of a rollout is masked."""
    out = normalise(torch.rand(5, 1), floor=0.005, clip=5.0, mask=torch.zeros(5, 1, dtype=torch.bool))
    assert torch.equal(out, torch.zeros(5, 1))


def test_masked_values_may_be_anything() -> None:
    """Catches NaN * 0: padding holds whatever it holds."""
    mean, std = masked_moments(torch.tensor([2.0, 4.0, float("inf")]), torch.tensor([True, True, False]))
    assert (mean.item(), std.item()) == (3.0, 1.0)


def test_masked_standardise_agrees_with_the_unmasked_one() -> None:
    """Catches a masked z-score on another scale: population against sample deviation, sqrt((n - 1) / n) apart."""
    advantage = torch.tensor([1.0, 2.0, 3.0])
    ones = torch.ones(3, dtype=torch.bool)
    torch.testing.assert_close(standardise(advantage, ones), torch.tensor([-1.0, 0.0, 1.0]))
    padded = torch.tensor([1.0, float("nan"), 2.0, 3.0])
    expected = torch.tensor([-1.0, 0.0, 0.0, 1.0])
    torch.testing.assert_close(standardise(padded, ~padded.isnan()), expected)


def test_a_single_step_is_its_own_mean() -> None:
    """Catches 0 / 0 in the sample deviation of one step."""
    mask = torch.tensor([True, False])
    assert standardise(torch.tensor([3.0, 9.0]), mask).tolist() == [0.0, 0.0]
