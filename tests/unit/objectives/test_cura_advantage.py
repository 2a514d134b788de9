"""Advantage and targets of a rollout."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives.value import GAE

from cura_torchrl.modules import DistributionalCollisionEstimator, make_risk_measure
from cura_torchrl.objectives import CURAAdvantage
from tests.rollouts import ENVS, STEPS, StateEstimator, make_networks, make_rollout


def _table() -> TensorDictModule:
    return TensorDictModule(
        StateEstimator(), in_keys=["observation"], out_keys=["collision_atoms", "risk", "uncertainty"]
    )


def _zero_critic() -> TensorDictModule:
    critic = nn.Linear(2, 1)
    nn.init.zeros_(critic.weight)
    nn.init.zeros_(critic.bias)
    return TensorDictModule(critic, in_keys=["observation"], out_keys=["state_value"])


def _table_rollout() -> TensorDict:
    """One row of three steps: (R, U) = (0.2, 0.04), (0.4, 0.16), (0.5, 0.09), collision, seen as (0.9, 0.01)."""
    states = torch.tensor([[[0.2, 0.04], [0.4, 0.16], [0.5, 0.09], [0.9, 0.01]]])
    end = torch.tensor([[[False], [False], [True]]])
    signals = {"reward": torch.tensor([[[1.0], [2.0], [6.0]]]), "cost": end.float(), "done": end, "terminated": end}
    return TensorDict({"observation": states[:, :3], "next": {"observation": states[:, 1:], **signals}}, [1, 3])


@pytest.mark.parametrize("scale", ["raw", "zscore"])
def test_without_costs_it_is_gae_to_the_last_bit(scale: str) -> None:
    """Catches any difference from plain PPO in the methods without costs: they must be TorchRL's z-scored GAE."""
    critic, estimator = make_networks()
    ours = CURAAdvantage(critic, estimator, risk_coeff=0.0, uncertainty_coeff=0.0, advantage_scale=scale)(
        make_rollout()
    )
    theirs = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)(make_rollout())
    for key in ("advantage", "value_target", "state_value", ("next", "state_value")):
        assert torch.equal(ours[key], theirs[key]), key


def test_without_costs_a_broken_estimator_changes_nothing() -> None:
    """Catches 0 * NaN in the policy's advantage of methods that do not use the costs."""
    critic, estimator = make_networks()
    clean = CURAAdvantage(critic, estimator, risk_coeff=0.0, uncertainty_coeff=0.0)(make_rollout())["advantage"]
    with torch.no_grad():
        next(estimator.parameters()).fill_(float("nan"))
    broken = CURAAdvantage(critic, estimator, risk_coeff=0.0, uncertainty_coeff=0.0)(make_rollout())
    assert torch.equal(broken["advantage"], clean)


def test_the_penalised_advantage_is_the_one_worked_out_by_hand() -> None:
    """Catches a wrong sign, coefficient, mask or order of normalisation, by the paper's Eq. (8) to (10).

    gamma = lmbda = 0 and V = 0, so A = r = 1, 2, 6.
    C^R = 0.9 * 0.4 - 0.2, 0.9 * 0.5 - 0.4, 1 - 0.5 = 0.16, 0.05, 0.5; C^U = 0.12, -0.07, and none at the collision.
    """
    estimate = CURAAdvantage(_zero_critic(), _table(), gamma=0.0, lmbda=0.0, normalise_sum=False)
    risk_cost = torch.tensor([0.16, 0.05, 0.5], dtype=torch.float64)
    risk_cost = (risk_cost - risk_cost.mean()) / risk_cost.std(correction=0)
    # Mean 0.025, deviation 0.095: +1 and -1.
    uncertainty_cost = torch.tensor([1.0, -1.0, 0.0], dtype=torch.float64)
    expected = torch.tensor([1.0, 2.0, 6.0], dtype=torch.float64) - 0.25 * risk_cost - 1.0 * uncertainty_cost
    advantage = estimate(_table_rollout())["advantage"].flatten().double()
    assert torch.allclose(advantage, expected, atol=1e-5)


def test_the_risk_cost_is_that_of_the_estimator_s_risk_measure() -> None:
    """Catches a risk cost of the mean whatever the estimator calls risk.

    Two atoms, of which CVaR of the upper half is the larger: R = 0.4, 0.8, 0.5, and the last is not looked at.
    C^R = 0.9 * 0.8 - 0.4, 0.9 * 0.5 - 0.8, 1 - 0.5 = 0.32, -0.35, 0.5. The mean would give 0.25, -0.23, 0.7.
    """
    estimator = DistributionalCollisionEstimator(
        2, num_atoms=2, hidden_sizes=(), in_keys=["observation"], risk_measure=make_risk_measure("cvar", 0.5)
    )
    weight, bias = estimator.parameters()
    nn.init.eye_(weight)
    nn.init.zeros_(bias)
    atoms = torch.tensor([[[0.0, 0.4], [0.8, 0.2], [0.1, 0.5], [0.9, 0.9]]])
    rollout = _table_rollout()
    rollout["observation"], rollout["next", "observation"] = atoms[:, :3], atoms[:, 1:]
    options = {"gamma": 0.0, "lmbda": 0.0, "normalise_sum": False}
    estimate = CURAAdvantage(_zero_critic(), estimator, risk_coeff=0.5, uncertainty_coeff=0.0, **options)
    cost = torch.tensor([0.32, -0.35, 0.5])
    expected = torch.tensor([1.0, 2.0, 6.0]) - 0.5 * (cost - cost.mean()) / cost.std(correction=0)
    torch.testing.assert_close(estimate(rollout)["advantage"].flatten(), expected)


def test_costs_can_be_accumulated_along_the_trajectory() -> None:
    """Catches a sum that runs over a trajectory's end, or is normalised step by step before it is taken.

    With factor 0.9 * 0.5: C^R = 0.16 + 0.45 * (0.05 + 0.45 * 0.5), 0.05 + 0.45 * 0.5, 0.5 = 0.28375, 0.275, 0.5;
    C^U = 0.12 - 0.45 * 0.07, -0.07 = 0.0885, -0.07, of which the mean is 0.00925 and the deviation 0.07925.
    """
    options = {"gamma": 0.0, "lmbda": 0.0, "normalise_sum": False}
    estimate = CURAAdvantage(_zero_critic(), _table(), cost_lmbda=0.5, **options)
    risk_cost = torch.tensor([0.28375, 0.275, 0.5], dtype=torch.float64)
    risk_cost = (risk_cost - risk_cost.mean()) / risk_cost.std(correction=0)
    expected = torch.tensor([1.0, 2.0, 6.0], dtype=torch.float64) - 0.25 * risk_cost
    expected -= torch.tensor([1.0, -1.0, 0.0], dtype=torch.float64)
    assert torch.allclose(estimate(_table_rollout())["advantage"].flatten().double(), expected, atol=1e-5)
    # Cut after the first step: each step is then on its own but for the last two.
    rollout = _table_rollout()
    rollout["next", "done"] = torch.tensor([[[True], [False], [True]]])
    risk_cost = torch.tensor([0.16, 0.275, 0.5], dtype=torch.float64)
    risk_cost = (risk_cost - risk_cost.mean()) / risk_cost.std(correction=0)
    only_risk = CURAAdvantage(_zero_critic(), _table(), cost_lmbda=0.5, uncertainty_coeff=0.0, **options)
    expected = torch.tensor([1.0, 2.0, 6.0], dtype=torch.float64) - 0.25 * risk_cost
    assert torch.allclose(only_risk(rollout)["advantage"].flatten().double(), expected, atol=1e-5)


def test_a_baseline_takes_out_what_the_state_explains() -> None:
    """Catches a baseline of the wrong sign, or one that takes out what the action has done.

    U(o') - U(o) is the state's U, which the regression sees, plus 0.1 or -0.1 that it does not see.
    """
    generator = torch.Generator().manual_seed(0)
    state = 0.1 + torch.rand(8, 32, 2, generator=generator)
    action = 0.1 * (2.0 * torch.randint(2, (8, 32, 1), generator=generator) - 1.0)
    after = torch.cat([state[..., :1], 2.0 * state[..., 1:] + action], -1)
    still = torch.zeros(8, 32, 1, dtype=torch.bool)
    signals = {"reward": torch.zeros(8, 32, 1), "cost": still.float(), "done": still, "terminated": still}
    rollout = TensorDict({"observation": state, "next": {"observation": after, **signals}}, [8, 32])
    options = {"normalise_sum": False, "risk_coeff": 0.0, "gamma": 0.0, "lmbda": 0.0}
    by_baseline = {}
    for baseline in ("mean", "state"):
        estimate = CURAAdvantage(_zero_critic(), _table(), cost_baseline=baseline, **options)
        advantage = estimate(rollout.clone())["advantage"]
        by_baseline[baseline] = torch.corrcoef(torch.stack([advantage.flatten(), action.flatten()]))[0, 1].item()
    assert by_baseline["state"] < -0.99
    assert by_baseline["mean"] > -0.5


def test_the_sum_is_standardised_for_the_optimiser() -> None:
    """Catches a sum that keeps the scale of the reward, on which PPO's step size would depend."""
    critic, estimator = make_networks()
    plain = CURAAdvantage(critic, estimator, normalise_sum=False)(make_rollout())["advantage"]
    advantage = CURAAdvantage(critic, estimator)(make_rollout())["advantage"]
    assert torch.allclose(advantage, (plain - plain.mean()) / plain.std(), atol=1e-6)


def test_the_placebo_deals_the_same_uncertainty_costs_to_other_steps() -> None:
    """Catches a placebo that changes the costs' distribution, reaches terminal steps or leaves the costs in place."""
    critic, estimator = make_networks()
    plain, placebo = (
        CURAAdvantage(
            critic, estimator, risk_coeff=0.0, uncertainty_coeff=1.0, normalise_sum=False, shuffle_uncertainty=shuffled
        )(make_rollout())
        for shuffled in (False, True)
    )
    raw = plain["value_target"] - plain["state_value"]
    terminated = plain["next", "terminated"]
    costs, dealt = ((raw - rollout["advantage"])[~terminated] for rollout in (plain, placebo))
    torch.testing.assert_close(dealt.sort().values, costs.sort().values, atol=1e-5, rtol=0.0)  # sums of floats about 5
    assert (dealt - costs).abs().max() > 0.1
    torch.testing.assert_close(placebo["advantage"][terminated], plain["advantage"][terminated])


def test_zscore_scales_the_advantage_before_the_costs() -> None:
    """Catches an option without effect: with the reward times 100 the costs keep their share."""
    critic, estimator = _zero_critic(), _table()
    base, scaled = _table_rollout(), _table_rollout()
    scaled["next", "reward"] *= 100.0
    for scale, same in (("zscore", True), ("raw", False)):
        estimate = CURAAdvantage(critic, estimator, advantage_scale=scale)
        a, b = estimate(base.clone())["advantage"], estimate(scaled.clone())["advantage"]
        assert torch.allclose(a, b, atol=1e-5) == same


def test_targets_use_the_true_last_observation_and_the_collision() -> None:
    """Catches a bootstrap from the root of the next step, which belongs to another episode after a reset.

    One step (lambda 0): 0.9 * (0.4 -+ 0.4), 0.9 * (0.5 -+ 0.3), then the collision's 1.
    """
    rollout = CURAAdvantage(_zero_critic(), _table(), collision_lmbda=0.0)(_table_rollout())
    expected = torch.tensor([[[0.0, 0.72], [0.18, 0.72], [1.0, 1.0]]])
    assert torch.allclose(rollout["collision_target"], expected, atol=1e-6)


def test_a_truncated_step_bootstraps_and_keeps_its_costs() -> None:
    """Catches a time limit that is treated like a collision: 0.9 * 0.9 - 0.5 = 0.31 and not -0.5."""
    rollout = _table_rollout()
    rollout["next", "terminated"] = torch.zeros(1, 3, 1, dtype=torch.bool)
    rollout["next", "cost"] = torch.zeros(1, 3, 1)
    estimate = CURAAdvantage(_zero_critic(), _table(), collision_lmbda=1.0)
    out = estimate(rollout)
    # Bootstrap 0.9 * (0.9 -+ 0.1) at the end, and 0.9 of that before.
    assert torch.allclose(out["collision_target"][0, 2], torch.tensor([0.72, 0.90]), atol=1e-6)
    assert torch.allclose(out["collision_target"][0, 1], torch.tensor([0.648, 0.81]), atol=1e-6)
    # C^U = 0.12, -0.07, -0.08: mean -0.01, deviation sqrt((0.13^2 + 0.06^2 + 0.07^2) / 3) = 0.0920
    assert estimate.diagnostics(out)["uncertainty_cost_std"].item() == pytest.approx(0.0920, abs=1e-4)


def test_coefficients_can_be_set_and_are_saved() -> None:
    """Catches a warm-up that has no effect because an attribute shadows the buffer."""
    critic, estimator = make_networks()
    estimate = CURAAdvantage(critic, estimator, risk_coeff=0.0, uncertainty_coeff=0.0)
    cold = estimate(make_rollout())["advantage"]
    estimate.risk_coeff, estimate.uncertainty_coeff = 0.25, 1
    warm = estimate(make_rollout())["advantage"]
    assert not torch.allclose(cold, warm)
    assert torch.equal(warm, CURAAdvantage(critic, estimator)(make_rollout())["advantage"])
    assert estimate.state_dict()["risk_coeff"].item() == 0.25
    estimate.risk_coeff = np.float32(0.5)
    assert estimate.risk_coeff.item() == 0.5
    with pytest.raises(ValueError, match="uncertainty_coeff is inf; accepted: a finite number"):
        estimate.uncertainty_coeff = float("inf")


def test_a_resumed_run_draws_the_same_targets() -> None:
    """Catches a generator that starts again after loading: targets of the second rollout must be equal."""
    first, resumed = CURAAdvantage(*make_networks(), seed=3), CURAAdvantage(*make_networks(), seed=4)
    first(make_rollout())
    resumed.load_state_dict(first.state_dict())
    assert torch.equal(first(make_rollout(1))["collision_target"], resumed(make_rollout(1))["collision_target"])
    fresh = CURAAdvantage(*make_networks(), seed=3)(make_rollout(1))["collision_target"]
    assert not torch.equal(fresh, first(make_rollout(1))["collision_target"])


def test_padding_counts_for_nothing() -> None:
    """Catches padded steps in the statistics or leaking into targets: results equal those of the unpadded rollout."""
    estimate = CURAAdvantage(*make_networks(), collision_lmbda=1.0)
    short = make_rollout()[:, :10].clone()
    short["next", "terminated"][:, -1] = True
    short["next", "done"][:, -1] = True
    expected = estimate(short.clone())
    padded = torch.cat([short, make_rollout(1)[:, 10:]], 1)
    padded["next", "reward"][:, 10:] = 1e3
    padded["next", "terminated"][:, 10:] = False
    padded["next", "done"][:, 10:] = False
    padded["collector", "mask"] = (torch.arange(STEPS) < 10).expand(ENVS, STEPS)
    out = estimate(padded)
    torch.testing.assert_close(out["advantage"][:, :10], expected["advantage"], rtol=0.0, atol=1e-5)
    assert torch.count_nonzero(out["advantage"][:, 10:]) == 0
    assert torch.allclose(out["collision_target"][:, :10], expected["collision_target"])


def test_padding_after_an_open_trajectory_does_not_reach_its_targets() -> None:
    """Catches a trace that runs on from a trajectory's last step, which is not done, into its padding."""
    estimate = CURAAdvantage(*make_networks(), collision_lmbda=1.0)
    rollout = make_rollout()
    for flag in ("done", "terminated"):
        rollout["next", flag] = torch.zeros(ENVS, STEPS, 1, dtype=torch.bool)
    expected = estimate(rollout[:, :10].clone())["collision_target"]
    rollout["next", "cost"][:, 10:] = 1.0
    rollout["collector", "mask"] = (torch.arange(STEPS) < 10).expand(ENVS, STEPS).unsqueeze(-1)
    assert torch.allclose(estimate(rollout)["collision_target"][:, :10], expected)


@pytest.mark.parametrize("options", [{}, {"risk_coeff": 0.0, "uncertainty_coeff": 0.0}])
def test_padding_after_an_open_trajectory_does_not_reach_its_advantage(options: dict[str, float]) -> None:
    """Catches an advantage or value target that runs on from a trajectory's last step, not done, into its padding."""
    estimate = CURAAdvantage(*make_networks(), **options)
    rollout = make_rollout()
    for flag in ("done", "terminated"):
        rollout["next", flag] = torch.zeros(ENVS, STEPS, 1, dtype=torch.bool)
    expected = estimate(rollout[:, :10].clone())
    rollout["next", "reward"][:, 10:] = 1e3
    rollout["collector", "mask"] = (torch.arange(STEPS) < 10).expand(ENVS, STEPS)
    before = rollout.clone()
    out = estimate(rollout)
    for key in ("advantage", "value_target", "state_value", ("next", "state_value")):
        # Sums of ten floats, about 5.
        torch.testing.assert_close(out[key][:, :10], expected[key], rtol=0.0, atol=1e-5)
    assert all(torch.equal(out[key], before[key]) for key in before.keys(True, True))


def test_a_rollout_without_the_cost_is_refused_before_anything_is_written() -> None:
    """Catches an error that does not name what is missing, and a rollout that is left half done."""
    estimate = CURAAdvantage(*make_networks())
    rollout = make_rollout()
    del rollout["next", "cost"]
    before = set(rollout.keys(True, True))
    with pytest.raises(KeyError, match=r"\('next', 'cost'\) is missing; accepted: .* set_keys"):
        estimate(rollout)
    assert set(rollout.keys(True, True)) == before


def test_a_network_that_writes_other_keys_is_refused_before_anything_is_written() -> None:
    """Catches an estimator of other out_keys that fails on a missing tensor; set_keys tells them."""
    critic, _ = make_networks()
    other = DistributionalCollisionEstimator(5, hidden_sizes=(16,), out_keys=("atoms", "risk", "uncertainty"))
    estimate, rollout = CURAAdvantage(critic, other), make_rollout()
    before = set(rollout.keys(True, True))
    with pytest.raises(KeyError, match=r"'collision_atoms' is missing; accepted: .* set_keys"):
        estimate(rollout)
    assert set(rollout.keys(True, True)) == before
    estimate.set_keys(collision_atoms="atoms")
    assert estimate(rollout)["collision_target"].shape == (ENVS, STEPS, 50)


def test_keys_can_be_nested() -> None:
    """Catches a hard-coded key anywhere between GAE, costs and targets."""
    critic, estimator = make_networks()
    expected = CURAAdvantage(critic, estimator)(make_rollout())
    estimate = CURAAdvantage(critic, estimator)
    estimate.set_keys(
        cost=("signal", "c"), reward=("signal", "r"), advantage=("out", "a"), collision_target=("out", "t")
    )
    moved = make_rollout()
    moved["next"].rename_key_("cost", ("signal", "c")).rename_key_("reward", ("signal", "r"))
    out = estimate(moved)
    assert torch.equal(out["out", "a"], expected["advantage"])
    assert torch.equal(out["out", "t"], expected["collision_target"])
    assert ("next", "signal", "c") in estimate.in_keys
    assert ("out", "a") in estimate.out_keys
    with pytest.raises(ValueError, match="'quantiles' is not a key of CURAAdvantage"):
        estimate.set_keys(quantiles="q")


def test_in_and_out_keys_are_exact() -> None:
    """Catches keys that are read or written without being listed."""
    estimate = CURAAdvantage(*make_networks())
    rollout = make_rollout()
    before = set(rollout.keys(True, True))
    assert set(estimate.in_keys) == before
    estimate(rollout)
    assert set(rollout.keys(True, True)) - before == set(estimate.out_keys)
    assert len(estimate.out_keys) == len(set(estimate.out_keys))


def test_keyword_tensors_give_the_same_as_a_tensordict() -> None:
    """Catches a forward that is not dispatched."""
    rollout = make_rollout()
    out = CURAAdvantage(*make_networks())(rollout.clone())
    estimate = CURAAdvantage(*make_networks())
    flat = {"_".join(key) if isinstance(key, tuple) else key: rollout[key] for key in estimate.in_keys}
    for value, key in zip(estimate(**flat), estimate.out_keys, strict=True):
        assert torch.equal(value, out[key]), key


def test_nothing_of_it_carries_a_gradient() -> None:
    """Catches a graph of the whole rollout that is kept alive until the next one."""
    rollout = CURAAdvantage(*make_networks())(make_rollout())
    assert not any(value.requires_grad for value in rollout.values(True, True))


def test_diagnostics_are_the_numbers_they_say() -> None:
    """Catches a weight taken before normalisation, or statistics over terminal steps; see the hand-worked rollout."""
    estimate = CURAAdvantage(_zero_critic(), _table(), gamma=0.0, lmbda=0.0, collision_lmbda=0.0)
    rollout = estimate(_table_rollout())
    before = rollout.clone()
    numbers = {name: value.item() for name, value in estimate.diagnostics(rollout).items()}
    assert all(torch.equal(before[key], rollout[key]) for key in before.keys(True, True))
    # C^R = 0.16, 0.05, 0.5: mean 0.23667, deviation 0.19155. C^U = 0.12, -0.07: deviation 0.095.
    assert numbers["risk_cost_std"] == pytest.approx(0.19155, abs=1e-4)
    assert numbers["uncertainty_cost_std"] == pytest.approx(0.095, abs=1e-5)
    # A = 1, 2, 6: deviation sqrt(14 / 3). Normalised costs: deviation 1, and sqrt(2 / 3) with the terminal zero.
    assert numbers["risk_weight"] == pytest.approx(0.25 / (14 / 3) ** 0.5, abs=1e-5)
    assert numbers["uncertainty_weight"] == pytest.approx((2 / 3) ** 0.5 / (14 / 3) ** 0.5, abs=1e-5)
    # R = 0.2, 0.4, 0.5 and U = 0.04, 0.16, 0.09: covariance 0.0035556, deviations 0.124722 and 0.049216.
    assert numbers["risk_uncertainty_correlation"] == pytest.approx(0.0035556 / (0.124722 * 0.049216), abs=1e-4)
    assert numbers["risk_mean"] == pytest.approx(1.1 / 3)
    assert numbers["uncertainty_mean"] == pytest.approx(0.29 / 3)
    # 2 E|x - y| - E|x - x'| - E|y - y'| of the atoms (0, 0.4), (0, 0.8), (0.2, 0.8) and the targets (0, 0.72),
    # (0.18, 0.72), (1, 1): 0.72 - 0.2 - 0.36 = 0.16; 0.8 - 0.4 - 0.27 = 0.13; 1 - 0.3 - 0 = 0.7.
    assert numbers["energy_distance"] == pytest.approx((0.16 + 0.13 + 0.7) / 3, abs=1e-6)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"gamma": 1.1}, "gamma is 1.1; accepted: 0 to 1"),
        ({"collision_lmbda": -0.1}, "collision_lmbda is -0.1; accepted: 0 to 1"),
        ({"risk_floor": 0.0}, "risk_floor is 0.0; accepted: a positive number"),
        ({"advantage_scale": "none"}, "advantage_scale is 'none'; accepted: 'raw', 'zscore'"),
        ({"risk_coeff": float("nan")}, "risk_coeff is nan; accepted: a finite number"),
    ],
)
def test_nonsense_is_refused(kwargs: dict[str, object], message: str) -> None:
    """Catches a misspelt option that silently means the other one, and a division by zero."""
    with pytest.raises(ValueError, match=message):
        CURAAdvantage(*make_networks(), **kwargs)
