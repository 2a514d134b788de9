"""Makes the pushing task known to Gymnasium, without importing torch or a simulator."""

from __future__ import annotations

import importlib

from cura_torchrl.trainers.errors import UnavailableError

GYM_ID = "cura_torchrl/Push-v0"
"""What ``gymnasium.make`` calls the task."""


def register_gym() -> str:
    """Make the pushing task known to ``gymnasium.make``; harmless when done twice.

    Returns:
        The task's name; its keyword arguments are those of :class:`~cura_torchrl.trainers.gym_env.PushGym`.

    Raises:
        UnavailableError: If gymnasium is not installed.
    """
    try:
        gymnasium = importlib.import_module("gymnasium")
    except ModuleNotFoundError:
        msg = "gymnasium is not installed; accepted: first pip install cura-torchrl[gym]"
        raise UnavailableError(msg) from None
    if GYM_ID not in gymnasium.registry:
        gymnasium.register(id=GYM_ID, entry_point="cura_torchrl.trainers.gym_env:PushGym")
    return GYM_ID
