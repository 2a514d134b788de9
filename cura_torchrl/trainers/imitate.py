"""A warm start: networks that imitate the scripted pusher where there are no obstacles.

Obstacle-free pushing is what all methods have in common, and on PyBullet it costs PPO millions of frames. Imitation
learns it from a few ten thousand (dataset aggregation: the learner drives, the expert labels), and ``train
--init-from`` goes on from there with any method. It sees neither map nor obstacles, so it favours none.
"""

from __future__ import annotations

import dataclasses
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict
from tqdm import tqdm

from cura_torchrl import keys
from cura_torchrl.envs.config import require, require_finite
from cura_torchrl.envs.robots.scripted import ScriptedPusher
from cura_torchrl.trainers.build import LATENT_SIZE, Networks, make_env
from cura_torchrl.trainers.checkpoint import CHECKPOINT_FOLDER, save_checkpoint
from cura_torchrl.trainers.methods import method
from cura_torchrl.trainers.threads import one_thread

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

    from cura_torchrl.trainers.config import TrainConfig

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class ImitateConfig:
    """Imitate the scripted pusher without obstacles."""

    run_dir: Path = Path("runs/imitate")
    """Folder for the checkpoint."""
    num_envs: int = 32
    """Worlds that are played side by side [1]."""
    rounds: int = 4
    """Rounds of collecting and fitting [1]; from the second on the learner drives half of the worlds."""
    steps: int = 500
    """Policy steps of each world in a round [1]."""
    epochs: int = 30
    """Passes over all data after each round [1]."""
    minibatch_size: int = 512
    """Frames per gradient step [1]."""
    lr: float = 1e-3
    """Learning rate [1]."""
    noise: float = 0.3
    """Standard deviation of the smooth noise added to what is executed, not to what is learned [1]."""
    std: float = 0.25
    """Standard deviation of the action that training starts with [1]."""
    seed: int = 0
    """Seed of scenarios, networks and noise [1]."""

    def __post_init__(self) -> None:
        require_finite(self)
        for name in ("num_envs", "rounds", "steps", "epochs", "minibatch_size", "lr", "std"):
            require(getattr(self, name) > 0, name, getattr(self, name), "a positive number")
        require(self.noise >= 0, "noise", self.noise, "a number that is not negative")


def imitate(config: ImitateConfig) -> Path:
    """Fit the actor to the scripted pusher.

    Args:
        config: Amount of data and of fitting.

    Returns:
        The checkpoint, for ``train --init-from``.
    """
    torch.manual_seed(config.seed)
    train_config = _train_config(config)
    networks = Networks(train_config)
    env = make_env(train_config, config.num_envs)
    observations, labels = torch.empty(0), torch.empty(0)
    try:
        for index in range(config.rounds):
            with one_thread():
                seen, expert = _collect(env, networks, config, learner_drives=index > 0)
            observations, labels = torch.cat([observations, seen]), torch.cat([labels, expert])
            networks.observation_norm.update(seen)
            error = _fit(networks, observations, labels, config)
            logger.info("round %d: %d frames, root mean square error of the action %.3f", index + 1, len(labels), error)
    finally:
        env.close()
    folder = config.run_dir / CHECKPOINT_FOLDER
    return save_checkpoint({"networks": networks}, train_config, folder, frames=len(labels))


def _train_config(config: ImitateConfig) -> TrainConfig:
    """Return the configuration of a policy that sees no map, where there are no obstacles."""
    preset = method("push")
    scenario = dataclasses.replace(preset.env.task.scenario, max_obstacles=0)
    env = dataclasses.replace(
        preset.env,
        task=dataclasses.replace(preset.env.task, scenario=scenario),
        lidar=dataclasses.replace(preset.env.lidar, num_rays=8),
    )
    return preset.replace(
        env=env,
        network=dataclasses.replace(preset.network, init_std=config.std),
        perception="none",
        seed=config.seed,
        run_dir=config.run_dir,
        num_envs=config.num_envs,
    )


@torch.no_grad()
def _collect(
    env: EnvBase, networks: Networks, config: ImitateConfig, *, learner_drives: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return observations ``[F, D]`` and the expert's actions ``[F, A]``."""
    expert = ScriptedPusher()
    is_learner = (torch.arange(config.num_envs) % 2 == 0)[:, None] & torch.tensor(learner_drives)
    carrier, noise, kept = env.reset(), torch.zeros(config.num_envs, 6), []
    for _ in tqdm(range(config.steps), desc="collect", unit="step"):
        label = expert(carrier.select(keys.OBSERVATION))[keys.ACTION]
        own = networks.actor.module[0](carrier.select(keys.OBSERVATION, keys.LATENT))["loc"]
        kept.append((carrier[keys.OBSERVATION], label))
        # Ornstein-Uhlenbeck, correlated over about ten steps: white noise would average out.
        noise = 0.9 * noise + config.noise * (1 - 0.9**2) ** 0.5 * torch.randn_like(noise)
        _, carrier = env.step_and_maybe_reset(
            carrier.set(keys.ACTION, (torch.where(is_learner, own, label) + noise).clamp(-1.0, 1.0))
        )
    return torch.cat([entry[0] for entry in kept]), torch.cat([entry[1] for entry in kept])


def _fit(networks: Networks, observations: torch.Tensor, labels: torch.Tensor, config: ImitateConfig) -> float:
    """Regress the actor's mean on the labels.

    Returns:
        Root mean square error of the last pass [1].
    """
    optimizer = torch.optim.Adam(networks.actor.parameters(), lr=config.lr)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.epochs, eta_min=0.1 * config.lr)
    error = 0.0
    for _ in tqdm(range(config.epochs), desc="fit", unit="epoch"):
        total = 0.0
        for index in torch.randperm(len(labels)).split(config.minibatch_size):
            batch = TensorDict(
                {keys.OBSERVATION: observations[index], keys.LATENT: torch.zeros(len(index), LATENT_SIZE)}, [len(index)]
            )
            loss = (networks.actor.module[0](batch)["loc"] - labels[index]).square().mean()
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            total += loss.item() * len(index)
        schedule.step()
        error = (total / len(labels)) ** 0.5
    return error
