"""Distributional Collision Estimator (DCE): the distribution of the collision possibility as N atoms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import torch
from tensordict.nn import TensorDictModule
from torch import nn

from cura_torchrl import keys
from cura_torchrl.modules.functional import atom_mean, atom_variance
from cura_torchrl.modules.mlp import ObservationMLP

if TYPE_CHECKING:
    from tensordict import NestedKey

    from cura_torchrl.modules.observation_norm import ObservationNorm

RiskMeasure = Callable[[torch.Tensor], torch.Tensor]
"""Maps atoms, shape ``[*B, N]``, to a risk, shape ``[*B]``."""


class _AtomsAndMoments(nn.Module):
    """Appends risk and uncertainty to the atoms of a trunk."""

    def __init__(self, trunk: nn.Module, risk_measure: RiskMeasure) -> None:
        super().__init__()
        self.trunk = trunk
        self.risk_measure = risk_measure

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        atoms = self.trunk(*inputs)
        return atoms, self.risk_measure(atoms).unsqueeze(-1), atom_variance(atoms).unsqueeze(-1)


class DistributionalCollisionEstimator(TensorDictModule):
    """Predicts the distribution of C = sum_k gamma_c^k c_(t+k) from what the policy sees.

    The head is linear and its atoms are in no order, see :mod:`cura_torchrl.modules.functional`. It has its own
    parameters; only the observation's normalisation is shared with actor and critic.

    Reads and writes (default keys):

    ==================== ===== ====================================================
    ``observation``      read  shape ``[*B, D]``, normalised if there is a norm
    ``latent``           read  shape ``[*B, L]``, taken as it is
    ``collision_atoms``  write atoms of C [1], shape ``[*B, N]``
    ``risk``             write risk measure of the atoms [1], shape ``[*B, 1]``
    ``uncertainty``      write population variance of the atoms [1], shape ``[*B, 1]``
    ==================== ===== ====================================================

    Args:
        in_features: Sizes of all inputs together, D + L [1].
        num_atoms: N, number of atoms [1].
        hidden_sizes: Sizes of the hidden layers [1].
        activation: Module class between layers.
        observation_norm: Normalisation of the first input, shared by reference.
        risk_measure: What to read as risk from the atoms, such as
            :func:`~cura_torchrl.modules.make_risk_measure` returns; the paper takes the mean. This alone decides: the
            risk cost and the logs read what the estimator writes.
        in_keys: Keys of the inputs, the observation first.
        out_keys: Keys of atoms, risk and uncertainty.

    Raises:
        ValueError: If there is no atom, or ``out_keys`` are not three.

    Source:
        Paper Eq. (3) to (6).

    Examples:
        >>> from tensordict import TensorDict
        >>> dce = DistributionalCollisionEstimator(5)
        >>> td = dce(TensorDict({"observation": torch.zeros(7, 3), "latent": torch.zeros(7, 2)}, [7]))
        >>> td["collision_atoms"].shape, td["risk"].shape, td["uncertainty"].shape
        (torch.Size([7, 50]), torch.Size([7, 1]), torch.Size([7, 1]))
        >>> atoms, risk, uncertainty = dce(observation=torch.zeros(7, 3), latent=torch.zeros(7, 2))
    """

    def __init__(
        self,
        in_features: int,
        *,
        num_atoms: int = 50,
        hidden_sizes: Sequence[int] = (256, 256, 256),
        activation: Callable[[], nn.Module] = nn.ELU,
        observation_norm: ObservationNorm | None = None,
        risk_measure: RiskMeasure = atom_mean,
        in_keys: Sequence[NestedKey] = (keys.OBSERVATION, keys.LATENT),
        out_keys: Sequence[NestedKey] = (keys.COLLISION_ATOMS, keys.RISK, keys.UNCERTAINTY),
    ) -> None:
        if num_atoms < 1:
            msg = f"num_atoms is {num_atoms}; accepted: 1 or more"
            raise ValueError(msg)
        if len(out_keys) != 3:
            msg = f"out_keys are {list(out_keys)}; accepted: three keys, for atoms, risk and uncertainty"
            raise ValueError(msg)
        trunk = ObservationMLP(
            in_features,
            num_atoms,
            hidden_sizes=hidden_sizes,
            activation=activation,
            observation_norm=observation_norm,
        )
        super().__init__(_AtomsAndMoments(trunk, risk_measure), in_keys=list(in_keys), out_keys=list(out_keys))
        self.num_atoms = num_atoms
