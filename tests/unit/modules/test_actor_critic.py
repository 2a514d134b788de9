"""Actor and critic inside TorchRL's machinery."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import IndependentNormal

from cura_torchrl.modules import ObservationNorm, make_actor, make_critic


def _inputs(*batch: int) -> TensorDict:
    return TensorDict({"observation": torch.randn(*batch, 3) * 100.0, "latent": torch.randn(*batch, 2)}, batch)


def test_log_prob_is_that_of_the_written_distribution() -> None:
    """Catches a squashed or clamped action, or a sum over the wrong dimension; closed form of the normal density."""
    td = make_actor(5, 6)(_inputs(7))
    z = (td["action"] - td["loc"]) / td["scale"]
    expected = (-0.5 * z.square() - td["scale"].log() - 0.5 * math.log(2.0 * math.pi)).sum(-1)
    assert td["action_log_prob"].shape == (7,)
    assert torch.allclose(td["action_log_prob"], expected, atol=1e-5)


def test_deterministic_exploration_gives_the_mean() -> None:
    """Catches an actor that stays random in evaluation."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        td = make_actor(5, 6)(_inputs(7))
    assert torch.equal(td["action"], td["loc"])


def test_the_first_policy_is_centred_with_the_deviation_asked_for() -> None:
    """Catches a large last layer: observations in the hundreds must still give a mean near zero."""
    norm = ObservationNorm(3)
    norm.update(torch.randn(1000, 3) * 100.0)
    td = make_actor(5, 6, init_std=0.7, observation_norm=norm)(_inputs(1000))
    assert td["loc"].abs().max() < 0.2
    assert torch.allclose(td["scale"], torch.full((1000, 6), 0.7))


def test_the_deviation_is_learned_state_independent_and_bounded_below() -> None:
    """Catches a collapse to zero deviation, where the log-probability explodes, and a clamp without gradient there."""
    actor = make_actor(5, 2, init_std=0.5, min_std=0.1)
    head = actor.module[0].module
    with torch.no_grad():
        head.log_excess.fill_(-6.0)
    td = actor(_inputs(4))
    assert (td["scale"] > 0.1).all()
    assert torch.equal(td["scale"], td["scale"][:1].expand(4, 2))
    actor.get_dist(_inputs(4)).entropy().sum().backward()
    assert (head.log_excess.grad > 0.0).all()


def test_the_distribution_has_a_closed_form_entropy() -> None:
    """Catches a distribution for which PPO would fall back to sampled entropy; 0.5 log(2 pi e s^2) per dimension."""
    dist = make_actor(5, 6, init_std=0.5).get_dist(_inputs(3))
    assert isinstance(dist, IndependentNormal)
    assert dist.entropy()[0].item() == pytest.approx(6 * 0.5 * math.log(2.0 * math.pi * math.e * 0.25), rel=1e-5)


def test_bad_deviations_are_refused() -> None:
    """Catches the logarithm of a number that is not positive, that is a NaN policy."""
    with pytest.raises(ValueError, match="accepted: 0 < min_std < init_std"):
        make_actor(5, 2, init_std=0.05, min_std=0.05)


def test_critic_writes_one_value_per_state() -> None:
    """Catches a squeezed value, which TorchRL's GAE would broadcast wrongly."""
    assert make_critic(5)(_inputs(4, 8))["state_value"].shape == (4, 8, 1)


def test_the_norm_is_one_object_without_gradients() -> None:
    """Catches copies of the norm in actor and critic, and statistics in the optimiser."""
    norm = ObservationNorm(3)
    actor, critic = make_actor(5, 2, observation_norm=norm), make_critic(5, observation_norm=norm)
    for network in (actor, critic):
        assert [module for module in network.modules() if isinstance(module, ObservationNorm)] == [norm]
        assert not any("observation_norm" in name for name, _ in network.named_parameters())


def test_networks_survive_pickling_and_copying() -> None:
    """Catches a closure inside the actor, which no collector worker could receive."""
    norm = ObservationNorm(3)
    norm.update(torch.randn(50, 3))
    td = _inputs(6)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for network, key in ((make_actor(5, 2, observation_norm=norm), "loc"), (make_critic(5), "state_value")):
            expected = network(td.clone())[key]
            assert torch.equal(pickle.loads(pickle.dumps(network))(td.clone())[key], expected)
            assert torch.equal(copy.deepcopy(network)(td.clone())[key], expected)
