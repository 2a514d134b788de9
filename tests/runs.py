"""Training runs that are over in seconds."""

from __future__ import annotations

import dataclasses
import functools
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import pytest
import torch

from cura_torchrl.envs.config import TaskConfig
from cura_torchrl.modules import MapVAE
from cura_torchrl.trainers.build import Networks
from cura_torchrl.trainers.checkpoint import CHECKPOINT_FOLDER, save_checkpoint
from cura_torchrl.trainers.config import NetworkConfig
from cura_torchrl.trainers.evaluation import task as evaluation_task
from cura_torchrl.trainers.methods import method

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from cura_torchrl.envs.config import Simulator
    from cura_torchrl.trainers.config import TrainConfig

FRAMES = 8
"""Frames of one rollout: two worlds, four steps."""
TINY_FRAMES = 3000
"""Steps that the tiny runs claim to have been trained for."""


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


@contextmanager
def short_evaluation() -> Iterator[None]:
    """Evaluate with episodes of one second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation_task, "TaskConfig", functools.partial(TaskConfig, episode_time=1.0))
        yield


def tiny_run(name: str, folder: Path, simulator: Simulator = "bullet") -> Path:
    """Write a run of untrained networks with short episodes, the same each time, and return its folder."""
    folder.mkdir(exist_ok=True)
    encoder = folder / "map_vae.pt"
    torch.manual_seed(1)
    MapVAE().save(encoder)
    preset = method(name).replace(simulator=simulator)
    task = dataclasses.replace(preset.env.task, episode_time=1.0, curriculum=((0, 0), (2000, 1), (9000, 6)))
    small = NetworkConfig(actor_hidden_sizes=(8,), critic_hidden_sizes=(8,), collision_hidden_sizes=(8,))
    config = preset.replace(
        run_dir=folder / name,
        encoder=encoder,
        env=dataclasses.replace(preset.env, task=task),
        ppo=dataclasses.replace(preset.ppo, rollout_steps=4, epochs=1, lr=1e-3),
        network=small,
    )
    save_checkpoint({"networks": Networks(config)}, config, config.run_dir / CHECKPOINT_FOLDER, frames=TINY_FRAMES)
    (config.run_dir / "progress.csv").write_text("frames,reward,lr\n2000,1.0,0.002\n3000,1.5,0.003\n")
    return config.run_dir
