"""Loss and advantage of CURA-PPO, and the mathematics behind them."""

from __future__ import annotations

from cura_torchrl.objectives.cura import CURALoss
from cura_torchrl.objectives.cura_advantage import CURAAdvantage
from cura_torchrl.objectives.energy import energy_distance
from cura_torchrl.objectives.functional import (
    normalise,
    risk_cost,
    sr_lambda_targets,
    standardise,
    uncertainty_cost,
)
from cura_torchrl.objectives.perceptual import PerceptualObjective

__all__ = [
    "CURAAdvantage",
    "CURALoss",
    "PerceptualObjective",
    "energy_distance",
    "normalise",
    "risk_cost",
    "sr_lambda_targets",
    "standardise",
    "uncertainty_cost",
]
