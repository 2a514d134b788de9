"""The distributional collision estimator as a TensorDict module."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from cura_torchrl.modules import DistributionalCollisionEstimator, ObservationNorm, conditional_value_at_risk


def _inputs(*batch: int) -> dict[str, torch.Tensor]:
    return {"observation": torch.randn(*batch, 3), "latent": torch.randn(*batch, 2)}


@pytest.mark.parametrize("batch", [(), (7,), (4, 5)])
def test_atoms_risk_and_uncertainty_agree(batch: tuple[int, ...]) -> None:
    """Catches moments of another tensor than the atoms that are written, and a lost trailing dimension."""
    td = DistributionalCollisionEstimator(5)(TensorDict(_inputs(*batch), batch))
    atoms = td["collision_atoms"]
    assert atoms.shape == (*batch, 50)
    assert torch.allclose(td["risk"], atoms.mean(-1, keepdim=True))
    assert torch.allclose(td["uncertainty"], (atoms - td["risk"]).square().mean(-1, keepdim=True))


def test_the_network_is_the_one_the_paper_and_its_reference_use() -> None:
    """Catches a bounded or activated head: 256 x 3 ELU, linear head of 50."""
    layers = list(DistributionalCollisionEstimator(40).module.trunk.mlp)
    sizes = [layer.out_features for layer in layers if isinstance(layer, nn.Linear)]
    assert sizes == [256, 256, 256, 50]
    assert isinstance(layers[-1], nn.Linear)
    assert sum(isinstance(layer, nn.ELU) for layer in layers) == 3


def test_tensors_and_tensordicts_give_the_same() -> None:
    """Catches an estimator that only works inside TorchRL: it has to be usable alone."""
    estimator, inputs = DistributionalCollisionEstimator(5), _inputs(6)
    td = estimator(TensorDict(inputs, [6]))
    for value, key in zip(estimator(**inputs), estimator.out_keys, strict=True):
        assert torch.equal(value, td[key])


def test_keys_may_be_nested_and_inputs_any_number() -> None:
    """Catches keys that are fixed to this package's environment."""
    estimator = DistributionalCollisionEstimator(
        3, num_atoms=8, hidden_sizes=(16,), in_keys=[("agent", "state")], out_keys=[("dce", "z"), ("dce", "r"), "u"]
    )
    td = estimator(TensorDict({("agent", "state"): torch.randn(4, 3)}, [4]))
    assert td["dce", "z"].shape == (4, 8)
    assert td["dce", "r"].shape == td["u"].shape == (4, 1)


def test_the_risk_measure_replaces_the_risk_alone() -> None:
    """Catches a risk measure that also changes atoms or uncertainty, or is ignored."""
    mean = DistributionalCollisionEstimator(5)
    tail = DistributionalCollisionEstimator(5, risk_measure=partial(conditional_value_at_risk, alpha=0.1))
    tail.load_state_dict(mean.state_dict())
    inputs = TensorDict(_inputs(6), [6])
    a, b = mean(inputs.clone()), tail(inputs.clone())
    assert torch.equal(a["collision_atoms"], b["collision_atoms"])
    assert torch.equal(a["uncertainty"], b["uncertainty"])
    # alpha = 0.1 of 50 atoms: the mean of the 5 largest
    assert torch.allclose(b["risk"], a["collision_atoms"].topk(5).values.mean(-1, keepdim=True), atol=1e-6)


def test_the_norm_is_shared_by_reference() -> None:
    """Catches a copy of the norm, which the trainer's update would not reach."""
    norm = ObservationNorm(3)
    estimator, inputs = DistributionalCollisionEstimator(5, observation_norm=norm), _inputs(6)
    before = estimator(**inputs)[0]
    norm.update(torch.randn(100, 3) * 4.0 + 2.0)
    assert not torch.allclose(estimator(**inputs)[0], before)


def test_nonsense_is_refused() -> None:
    """Catches an estimator without atoms, or with a risk key that is silently dropped."""
    with pytest.raises(ValueError, match="num_atoms is 0"):
        DistributionalCollisionEstimator(5, num_atoms=0)
    with pytest.raises(ValueError, match="three keys"):
        DistributionalCollisionEstimator(5, out_keys=["atoms", "risk"])
