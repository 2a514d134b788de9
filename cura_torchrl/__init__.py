"""CURA-PPO in TorchRL: pushing through occlusion with a distributional collision estimator.

The public names are imported on first use, so that importing the package is fast and loads no simulator.

Examples:
    >>> import cura_torchrl
    >>> cura_torchrl.CURALoss.__name__
    'CURALoss'
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cura_torchrl.envs.push import PushEnv
    from cura_torchrl.envs.transforms import ConfidenceMap, EncodeMap
    from cura_torchrl.modules import DistributionalCollisionEstimator, MapVAE
    from cura_torchrl.objectives import CURAAdvantage, CURALoss
    from cura_torchrl.trainers.gym_registration import register_gym
    from cura_torchrl.trainers.loaded_policy import load_policy

__version__ = "0.1.0"

_SOURCES = {
    "PushEnv": "cura_torchrl.envs.push",
    "ConfidenceMap": "cura_torchrl.envs.transforms",
    "EncodeMap": "cura_torchrl.envs.transforms",
    "MapVAE": "cura_torchrl.modules",
    "DistributionalCollisionEstimator": "cura_torchrl.modules",
    "CURAAdvantage": "cura_torchrl.objectives",
    "CURALoss": "cura_torchrl.objectives",
    "load_policy": "cura_torchrl.trainers.loaded_policy",
    "register_gym": "cura_torchrl.trainers.gym_registration",
}

__all__ = [
    "CURAAdvantage",
    "CURALoss",
    "ConfidenceMap",
    "DistributionalCollisionEstimator",
    "EncodeMap",
    "MapVAE",
    "PushEnv",
    "__version__",
    "load_policy",
    "register_gym",
]


def __getattr__(name: str) -> Any:
    """Import a public name on first use.

    Args:
        name: One of ``__all__``.

    Returns:
        The class or function.

    Raises:
        AttributeError: If there is no such name.
    """
    if name not in _SOURCES:
        msg = f"module {__name__!r} has no attribute {name!r}"
        raise AttributeError(msg)
    value = getattr(importlib.import_module(_SOURCES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted(__all__)
