"""Training runs that are over in seconds."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from cura_torchrl.trainers.methods import method

if TYPE_CHECKING:
    from pathlib import Path

    from cura_torchrl.trainers.config import TrainConfig

FRAMES = 8
"""Frames of one rollout: two worlds, four steps."""


def small_run(run_dir: Path, *, updates: int, **changes: Any) -> TrainConfig:
    """Return a run of some updates that sees no map, with networks of eight units."""
    preset = method("cura-ppo")
    sizes = {"actor_hidden_sizes": (8,), "critic_hidden_sizes": (8,), "collision_hidden_sizes": (8,)}
    return preset.replace(
        num_envs=2,
        total_frames=updates * FRAMES,
        perception="none",
        run_dir=run_dir,
        learner_threads=1,
        ppo=dataclasses.replace(preset.ppo, rollout_steps=4),
        network=dataclasses.replace(preset.network, **sizes),
        **changes,
    )
