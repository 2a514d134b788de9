"""Networks, and the statistics of what they predict."""

from __future__ import annotations

from cura_torchrl.modules.actor_critic import make_actor, make_critic
from cura_torchrl.modules.collision_estimator import DistributionalCollisionEstimator
from cura_torchrl.modules.functional import (
    atom_mean,
    atom_quantile,
    atom_variance,
    conditional_value_at_risk,
    make_risk_measure,
    quantile_midpoints,
    wang_risk,
)
from cura_torchrl.modules.map_vae import MapVAE
from cura_torchrl.modules.mlp import ObservationMLP
from cura_torchrl.modules.observation_norm import ObservationNorm

__all__ = [
    "DistributionalCollisionEstimator",
    "MapVAE",
    "ObservationMLP",
    "ObservationNorm",
    "atom_mean",
    "atom_quantile",
    "atom_variance",
    "conditional_value_at_risk",
    "make_actor",
    "make_critic",
    "make_risk_measure",
    "quantile_midpoints",
    "wang_risk",
]
