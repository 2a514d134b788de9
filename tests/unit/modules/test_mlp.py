"""The trunk that the networks have in common."""

from __future__ import annotations

import math

import torch
from torch import nn

from cura_torchrl.modules import ObservationMLP, ObservationNorm
from cura_torchrl.modules.mlp import orthogonal_init_


def test_only_the_observation_is_normalised() -> None:
    """Catches a norm over the concatenation, which would rescale the map's code, or over nothing."""
    norm = ObservationNorm(1)
    norm.update(torch.tensor([[9.0], [11.0]]))  # mean 10, deviation 1
    trunk = ObservationMLP(2, 1, hidden_sizes=(), observation_norm=norm)
    nn.init.ones_(trunk.mlp[0].weight)
    nn.init.zeros_(trunk.mlp[0].bias)
    # (12 - 10) / 1 + 30 = 32
    assert trunk(torch.tensor([[12.0]]), torch.tensor([[30.0]])).item() == 32.0


def test_layers_have_the_sizes_asked_for() -> None:
    """Catches a default depth or activation of TorchRL's MLP slipping in."""
    layers = list(ObservationMLP(5, 3, hidden_sizes=(8, 4)).mlp)
    assert [(x.in_features, x.out_features) for x in layers if isinstance(x, nn.Linear)] == [(5, 8), (8, 4), (4, 3)]
    assert [type(layer) for layer in layers] == [nn.Linear, nn.ELU, nn.Linear, nn.ELU, nn.Linear]


def test_orthogonal_init_gives_every_layer_its_gain() -> None:
    """Catches the small last gain applied to the wrong layer: all singular values equal the gain."""
    network = nn.Sequential(nn.Linear(4, 6), nn.ELU(), nn.Linear(6, 5), nn.ELU(), nn.Linear(5, 2))
    orthogonal_init_(network, hidden_gain=math.sqrt(2.0), last_gain=0.01)
    gains = [torch.linalg.svdvals(layer.weight) for layer in network if isinstance(layer, nn.Linear)]
    for singular_values, gain in zip(gains, (math.sqrt(2.0), math.sqrt(2.0), 0.01), strict=True):
        assert torch.allclose(singular_values, torch.full_like(singular_values, gain), rtol=1e-4)
    assert all(torch.count_nonzero(layer.bias) == 0 for layer in network if isinstance(layer, nn.Linear))
