"""The methods as presets, the paper's and those beyond it: one method is one configuration of the same code."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cura_torchrl.envs.config import MapConfig, PushEnvConfig, RobotName
from cura_torchrl.trainers.config import CURAConfig, RiskMeasureKind, TrainConfig, UncertaintyKind
from cura_torchrl.trainers.lists import require_known

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cura_torchrl.trainers.loaded_policy import LoadedPolicy


@dataclass(frozen=True, kw_only=True)
class Method:
    """What tells a method from the others; all else is the same. Source: paper, section "Experimental Results"."""

    label: str
    """Name in tables and figures."""
    occlusion: bool
    """Whether the LiDAR sees the pushed object, which then hides what is behind it."""
    decay: float
    """alpha of the confidence map [1]: 0.9 is the paper's confidence, 1 accumulates without confidence."""
    risk_coeff: float
    """lambda_r [1]."""
    uncertainty_coeff: float
    """lambda_u [1]."""
    risk_measure: RiskMeasureKind = "mean"
    """What of the predicted distribution the risk is; its level is the default of ``CURAConfig.risk_level``."""
    uncertainty: UncertaintyKind = "total"
    """Which variance the uncertainty is."""
    robot: RobotName = "ridgeback_franka"
    """What pushes: the arm's hand, or a bare base's front face."""


METHODS: dict[str, Method] = {
    "cura-ppo": Method(label="CURA-PPO", occlusion=True, decay=0.9, risk_coeff=0.0625, uncertainty_coeff=0.25),
    "push": Method(label="Push w/ Occlusion", occlusion=True, decay=1.0, risk_coeff=0.0, uncertainty_coeff=0.0),
    "push-no-occlusion": Method(
        label="Push w/o Occlusion", occlusion=False, decay=1.0, risk_coeff=0.0, uncertainty_coeff=0.0
    ),
    "push-conf": Method(label="Baseline w/ Conf.", occlusion=True, decay=0.9, risk_coeff=0.0, uncertainty_coeff=0.0),
    "cura-no-uncertainty": Method(
        label="CURA w/o Uncertainty", occlusion=True, decay=0.9, risk_coeff=0.0625, uncertainty_coeff=0.0
    ),
    "cura-no-risk": Method(label="CURA w/o Risk", occlusion=True, decay=0.9, risk_coeff=0.0, uncertainty_coeff=0.25),
    "push-base": Method(
        label="Push w/ Base", occlusion=True, decay=1.0, risk_coeff=0.0, uncertainty_coeff=0.0, robot="ridgeback"
    ),
    "cura-ppo-base": Method(
        label="CURA-PPO w/ Base",
        occlusion=True,
        decay=0.9,
        risk_coeff=0.0625,
        uncertainty_coeff=0.25,
        robot="ridgeback",
    ),
}
"""The methods by name. Both coefficients are a quarter of the paper's, for they weigh against a z-scored advantage."""

EXTENSIONS: dict[str, Method] = {
    "cura-cvar": dataclasses.replace(METHODS["cura-ppo"], label="CURA-PPO, CVaR", risk_measure="cvar"),
    "cura-perceptual": dataclasses.replace(METHODS["cura-ppo"], label="CURA-PPO, perceptual", uncertainty="perceptual"),
}
"""Methods that the paper does not have: ``cura-ppo`` with one knob turned."""

PRESETS = {**METHODS, **EXTENSIONS}
"""All methods that there are by name."""

CURRICULUM = ((0, 0), (40_000, 1), (150_000, 2), (2_000_000, 4), (4_000_000, 6))
"""(frames, K): the same schedule for every method, in frames and not by success, which would compare stages of it."""


def method(name: str) -> TrainConfig:
    """Return the configuration that trains a method.

    Args:
        name: One of :data:`PRESETS`.

    Returns:
        The preset.

    Raises:
        ValueError: If there is no such method; the line lists those there are.

    Examples:
        >>> method("push").map.decay
        1.0
        >>> method("cura-ppo").cura.uncertainty_coeff
        0.25
    """  # noqa: DOC502 - raised by what this calls
    require_known("method", name, PRESETS)
    preset = PRESETS[name]
    env = PushEnvConfig()
    return TrainConfig(
        method=name,
        env=dataclasses.replace(
            env,
            robot=dataclasses.replace(env.robot, model=preset.robot),
            lidar=dataclasses.replace(env.lidar, occlusion=preset.occlusion),
            # Resets spread out over time; in lockstep the returns oscillate with the episode's phase.
            task=dataclasses.replace(env.task, random_first_age=True, curriculum=CURRICULUM),
        ),
        map=MapConfig(decay=preset.decay),
        cura=CURAConfig(
            risk_coeff=preset.risk_coeff,
            uncertainty_coeff=preset.uncertainty_coeff,
            risk_measure=preset.risk_measure,
            uncertainty=preset.uncertainty,
        ),
    )


def method_label(loaded: LoadedPolicy) -> str:
    """Return what a policy's method is called.

    Args:
        loaded: The policy.

    Returns:
        Its name in tables, or, for a method of one's own, its name.
    """
    name = loaded.config.method
    return PRESETS[name].label if name in PRESETS else name


def policy_labels(loaded: Sequence[LoadedPolicy], sources: Sequence[str]) -> list[str]:
    """Return what policies are called in figures and pages.

    Args:
        loaded: The policies.
        sources: Where each comes from: a method's name, or the path of a run or checkpoint.

    Returns:
        Their methods' names; where some are the same, with the last part of the source's path or, if those are the same
        too, all of it.
    """
    labels, ends = [method_label(policy) for policy in loaded], [Path(source).name for source in sources]
    told = sources if len(set(ends)) < len(ends) else ends
    return [
        label if labels.count(label) == 1 else f"{label} ({source})" for label, source in zip(labels, told, strict=True)
    ]
