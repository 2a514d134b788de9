"""Actor and critic as TorchRL modules that read (observation, latent)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from tensordict.nn import InteractionType, TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator

from cura_torchrl import keys
from cura_torchrl.modules.mlp import ObservationMLP, orthogonal_init_

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from tensordict import NestedKey

    from cura_torchrl.modules.observation_norm import ObservationNorm

LOG_PROB_KEY = f"{keys.ACTION}_log_prob"
"""Log-probability of the action, where TorchRL's PPO losses look for it."""


class _GaussianHead(nn.Module):
    """Returns a trunk's output as loc beside a learned scale that is the same in every state."""

    def __init__(self, trunk: nn.Module, action_dim: int, init_std: float, min_std: float) -> None:
        super().__init__()
        self.trunk = trunk
        self.min_std = min_std
        self.log_excess = nn.Parameter(torch.full((action_dim,), math.log(init_std - min_std)))

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        loc = self.trunk(*inputs)
        # A sum, not a clamp: the gradient does not vanish at the bound.
        return loc, (self.min_std + self.log_excess.exp()).expand_as(loc)


class _Scaled(nn.Module):
    """A network whose output is multiplied by a constant."""

    def __init__(self, trunk: nn.Module, scale: float) -> None:
        super().__init__()
        self.trunk = trunk
        self.scale = scale

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor:
        return self.scale * self.trunk(*inputs)


def make_actor(
    in_features: int,
    action_dim: int,
    *,
    hidden_sizes: Sequence[int] = (256, 128, 64),
    activation: Callable[[], nn.Module] = nn.ELU,
    observation_norm: ObservationNorm | None = None,
    init_std: float = 0.6,
    min_std: float = 0.05,
    in_keys: Sequence[NestedKey] = (keys.OBSERVATION, keys.LATENT),
) -> ProbabilisticActor:
    """Return a Gaussian actor for TorchRL's collectors and losses.

    It writes ``loc``, ``scale``, ``action`` and ``action_log_prob``. The scale is learned and the same in every state.
    Actions are not squashed: the environment clamps them, and the log-probability is that of the unclamped action. The
    last layer is small, so that the first actions are centred on zero whatever the observation.

    Args:
        in_features: Sizes of all inputs together [1].
        action_dim: Size of the action [1].
        hidden_sizes: Sizes of the hidden layers [1].
        activation: Module class between layers.
        observation_norm: Normalisation of the first input, shared by reference.
        init_std: Standard deviation of the normalised action at the start [1].
        min_std: Bound that the standard deviation stays above [1].
        in_keys: Keys of the inputs, the observation first.

    Returns:
        Actor whose distribution is an ``IndependentNormal`` over the action, shape ``[*B, action_dim]``.

    Raises:
        ValueError: If ``min_std`` is not positive or ``init_std`` is not above it.

    Examples:
        >>> from tensordict import TensorDict
        >>> actor = make_actor(5, 6)
        >>> td = actor(TensorDict({"observation": torch.zeros(7, 3), "latent": torch.zeros(7, 2)}, [7]))
        >>> td["action"].shape, td["action_log_prob"].shape
        (torch.Size([7, 6]), torch.Size([7]))
    """
    if not 0.0 < min_std < init_std:
        msg = f"min_std is {min_std} and init_std {init_std}; accepted: 0 < min_std < init_std"
        raise ValueError(msg)
    trunk = ObservationMLP(
        in_features, action_dim, hidden_sizes=hidden_sizes, activation=activation, observation_norm=observation_norm
    )
    orthogonal_init_(trunk, hidden_gain=math.sqrt(2.0), last_gain=0.01)
    head = TensorDictModule(
        _GaussianHead(trunk, action_dim, init_std, min_std), in_keys=list(in_keys), out_keys=["loc", "scale"]
    )
    return ProbabilisticActor(
        head,
        in_keys=["loc", "scale"],
        out_keys=[keys.ACTION],
        distribution_class=IndependentNormal,
        return_log_prob=True,
        log_prob_key=LOG_PROB_KEY,
        default_interaction_type=InteractionType.RANDOM,
    )


def make_critic(
    in_features: int,
    *,
    hidden_sizes: Sequence[int] = (256, 128, 64),
    activation: Callable[[], nn.Module] = nn.ELU,
    observation_norm: ObservationNorm | None = None,
    scale: float = 1.0,
    in_keys: Sequence[NestedKey] = (keys.OBSERVATION, keys.LATENT),
    out_key: NestedKey = keys.STATE_VALUE,
) -> ValueOperator:
    """Return a critic for TorchRL's value estimators and losses.

    Args:
        in_features: Sizes of all inputs together [1].
        hidden_sizes: Sizes of the hidden layers [1].
        activation: Module class between layers.
        observation_norm: Normalisation of the first input, shared by reference.
        scale: What the network's output is multiplied by, the magnitude of the returns: the network then learns numbers
            of order one.
        in_keys: Keys of the inputs, the observation first.
        out_key: Key of the value.

    Returns:
        Module that writes the state value, shape ``[*B, 1]``.

    Examples:
        >>> make_critic(5)(observation=torch.zeros(7, 3), latent=torch.zeros(7, 2)).shape
        torch.Size([7, 1])
    """
    trunk = ObservationMLP(
        in_features, 1, hidden_sizes=hidden_sizes, activation=activation, observation_norm=observation_norm
    )
    orthogonal_init_(trunk, hidden_gain=math.sqrt(2.0), last_gain=1.0)
    return ValueOperator(_Scaled(trunk, scale), in_keys=list(in_keys), out_keys=[out_key])
