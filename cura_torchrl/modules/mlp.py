"""The trunk that actor, critic and collision estimator have in common."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import nn
from torchrl.modules import MLP

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from cura_torchrl.modules.observation_norm import ObservationNorm


class ObservationMLP(nn.Module):
    """Perceptron over an observation and further inputs, of which only the observation is normalised.

    The code of the confidence map is close to standard normal by construction, so it enters as it is.

    Args:
        in_features: Sizes of observation and further inputs together [1].
        out_features: Size of the output [1].
        hidden_sizes: Sizes of the hidden layers [1].
        activation: Module class between layers.
        observation_norm: Normalisation of the first input, shared by reference; none leaves it as it is.

    Examples:
        >>> ObservationMLP(5, 2, hidden_sizes=(8,))(torch.zeros(7, 3), torch.zeros(7, 2)).shape
        torch.Size([7, 2])
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        hidden_sizes: Sequence[int],
        activation: Callable[[], nn.Module] = nn.ELU,
        observation_norm: ObservationNorm | None = None,
    ) -> None:
        super().__init__()
        self.observation_norm = nn.Identity() if observation_norm is None else observation_norm
        self.mlp = MLP(in_features, out_features, num_cells=list(hidden_sizes), activation_class=activation)

    def forward(self, observation: torch.Tensor, *inputs: torch.Tensor) -> torch.Tensor:
        """Return the network's output.

        Args:
            observation: Input to be normalised, shape ``[*B, D]``.
            *inputs: Inputs to be appended as they are, shape ``[*B, K]`` each.

        Returns:
            Output, shape ``[*B, out_features]``.
        """
        return self.mlp(self.observation_norm(observation), *inputs)


def orthogonal_init_(network: nn.Module, *, hidden_gain: float, last_gain: float) -> None:
    """Initialise every linear layer orthogonally with zero bias, in place.

    Args:
        network: Module whose linear layers run in the order they are registered.
        hidden_gain: Gain of all layers but the last [1].
        last_gain: Gain of the last layer [1].

    Examples:
        >>> layer = nn.Linear(3, 2)
        >>> orthogonal_init_(layer, hidden_gain=1.0, last_gain=2.0)
        >>> torch.allclose(layer.weight @ layer.weight.T, 4.0 * torch.eye(2), atol=1e-5)
        True
    """
    layers = [layer for layer in network.modules() if isinstance(layer, nn.Linear)]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, last_gain if layer is layers[-1] else hidden_gain)
        nn.init.zeros_(layer.bias)
