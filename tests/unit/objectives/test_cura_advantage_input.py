"""Rollouts and networks of other forms than the usual: what is taken, and what is refused."""

from __future__ import annotations

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn

from cura_torchrl.modules import make_critic
from cura_torchrl.objectives import CURAAdvantage
from tests.rollouts import ENVS, STEPS, StateEstimator, make_networks, make_rollout


def test_a_baseline_does_not_learn_a_small_rollout_by_heart() -> None:
    """Catches a regression on more numbers than samples: it explains all, and nothing is left of the costs."""
    critic, estimator = make_networks()
    rollout = make_rollout()[:1, :6]  # six samples of seven numbers each
    small = {
        name: CURAAdvantage(critic, estimator, cost_baseline=name)(rollout.clone())["advantage"]
        for name in ("mean", "state")
    }
    torch.testing.assert_close(small["state"], small["mean"])
    whole = {name: CURAAdvantage(critic, estimator, cost_baseline=name)(make_rollout())["advantage"] for name in small}
    assert (whole["state"] - whole["mean"]).abs().max() > 0.1


def test_a_baseline_of_the_state_takes_observations_of_any_shape() -> None:
    """Catches a concatenation that only vectors fit into."""

    class Wide(nn.Module):
        def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, ...]:
            return StateEstimator()(image.flatten(-3)[..., :2].abs() + 0.1)

    wide = TensorDictModule(Wide(), in_keys=["image"], out_keys=["collision_atoms", "risk", "uncertainty"])
    rollout = make_rollout()
    rollout["image"], rollout["next", "image"] = torch.randn(2, ENVS, STEPS, 2, 2, 2).unbind(0)
    critic, _ = make_networks()
    assert CURAAdvantage(critic, wide, cost_baseline="state")(rollout)["advantage"].isfinite().all()


def test_a_critic_that_writes_another_key_is_refused_before_anything_is_written() -> None:
    """Catches an error deep inside of TorchRL's estimator; set_keys tells the key."""
    _, estimator = make_networks()
    estimate, rollout = CURAAdvantage(make_critic(5, hidden_sizes=(16,), out_key="v"), estimator), make_rollout()
    before = set(rollout.keys(True, True))
    with pytest.raises(KeyError, match=r"'state_value' is missing; accepted: networks"):
        estimate(rollout)
    assert set(rollout.keys(True, True)) == before
    estimate.set_keys(value="v")
    assert estimate(rollout)["advantage"].isfinite().all()


def test_time_that_is_not_the_last_dimension_is_refused() -> None:
    """Catches a rollout half of which is read along time: GAE looks for the dimension's name."""
    first = make_rollout().transpose(0, 1).contiguous()
    first.names = ["time", None]
    with pytest.raises(ValueError, match=r"dimensions are \['time', None\]; accepted: time as the last one"):
        CURAAdvantage(*make_networks())(first)
    last = make_rollout()
    last.names = [None, "time"]
    assert CURAAdvantage(*make_networks())(last)["advantage"].isfinite().all()


def test_both_networks_move_with_it() -> None:
    """Catches a critic that stays on its device and in its precision, for TorchRL hides it from PyTorch."""
    estimate = CURAAdvantage(*make_networks()).double()
    rollout = make_rollout().apply(lambda value: value.double() if value.is_floating_point() else value)
    assert estimate(rollout)["advantage"].dtype == torch.float64
