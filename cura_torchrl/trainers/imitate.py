"""A warm start: networks that imitate a scripted pusher.

Dataset aggregation (the learner drives, the expert labels) learns from little what costs PPO millions of frames, and
``train --init-from`` goes on from there. The expert decides what is left for PPO:

- ``scripted`` pushes where there are no obstacles, what all methods have in common. The networks see neither map nor
  obstacles, so one warm start serves every method of the same robot and favours none.
- ``avoider`` steers around every obstacle, seen or not. The networks see what their method sees of it, so every method
  has a warm start of its own, made in the same way; what the map does not show, they cannot copy.

Source:
    Ross et al. (2011), "A Reduction of Imitation Learning and Structured Prediction to No-Regret Online Learning".
"""

from __future__ import annotations

import dataclasses
import logging
from typing import TYPE_CHECKING

import torch
from tqdm import tqdm

from cura_torchrl import keys
from cura_torchrl.envs.robots.scripted import ScriptedAvoider, ScriptedPusher
from cura_torchrl.trainers.build import Networks, make_env
from cura_torchrl.trainers.checkpoint import save_checkpoint, sweep
from cura_torchrl.trainers.threads import one_thread
from cura_torchrl.trainers.training.run_folder import CHECKPOINT_FOLDER, locked, require_no_run

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from tensordict import TensorDictBase
    from torchrl.envs import EnvBase

    from cura_torchrl.trainers.config import TrainConfig
    from cura_torchrl.trainers.training.imitate_config import ImitateConfig

logger = logging.getLogger(__name__)

_SEEN_KEYS = (keys.OBSERVATION, keys.LATENT)
"""What the networks read."""


def imitate(config: ImitateConfig) -> Path:
    """Fit the actor to the expert.

    Args:
        config: Amount of data and of fitting.

    Returns:
        The checkpoint, for ``train --init-from``.

    Raises:
        CheckpointError: If ``run_dir`` holds a run, or another process trains there.
    """  # noqa: DOC502 - raised by what this calls
    with locked(config.run_dir):
        sweep(config.run_dir / CHECKPOINT_FOLDER)
        require_no_run(config.run_dir, "another --run-dir")
        return _imitate(config)


def _imitate(config: ImitateConfig) -> Path:
    torch.manual_seed(config.seed)
    train_config = config.train_config
    networks = Networks(train_config)
    env = _make_env(train_config, config)
    rounds, played = [], _rounds(env, networks, config)
    try:
        for index in range(config.rounds):
            with one_thread():
                rounds.append(next(played))
            networks.observation_norm.update(rounds[-1][keys.OBSERVATION])
            data = torch.cat(rounds)
            error = _fit(networks, data, config)
            logger.info("round %d: %d frames, root mean square error of the action %.3f", index + 1, len(data), error)
    finally:
        env.close()
    folder = config.run_dir / CHECKPOINT_FOLDER
    return save_checkpoint({"networks": networks}, train_config, folder, frames=len(data))


def _make_env(train_config: TrainConfig, config: ImitateConfig) -> EnvBase:
    """Return the worlds, which show the expert what it asks for."""
    task = dataclasses.replace(train_config.env.task, privileged=config.expert == "avoider")
    return make_env(train_config.replace(env=dataclasses.replace(train_config.env, task=task)), config.num_envs)


@torch.no_grad()
def _rounds(env: EnvBase, networks: Networks, config: ImitateConfig) -> Iterator[TensorDictBase]:
    """Play on from round to round, so that ends of episodes are seen as often as their beginnings.

    Yields:
        What the networks see and the expert's actions in a round, batch size ``[F]``.
    """
    robot = env.base_env.config.robot
    expert = ScriptedAvoider(robot) if config.expert == "avoider" else ScriptedPusher(robot)
    carrier, noise = env.reset(), torch.zeros(env.action_spec.shape)
    for index in range(config.rounds):
        is_learner = (torch.arange(config.num_envs) % 2 == 0)[:, None] & torch.tensor(index > 0)
        kept = []
        for _ in tqdm(range(config.steps), desc="collect", unit="step"):
            label = expert(carrier.select(*expert.in_keys))[keys.ACTION]
            own = networks.actor.module[0](carrier.select(*_SEEN_KEYS))["loc"]
            kept.append(carrier.select(*_SEEN_KEYS).set(keys.ACTION, label))
            # Ornstein-Uhlenbeck, correlated over about ten steps: white noise would average out.
            noise = 0.9 * noise + config.noise * (1 - 0.9**2) ** 0.5 * torch.randn_like(noise)
            _, carrier = env.step_and_maybe_reset(
                carrier.set(keys.ACTION, (torch.where(is_learner, own, label) + noise).clamp(-1.0, 1.0))
            )
        yield torch.cat(kept)


def _fit(networks: Networks, data: TensorDictBase, config: ImitateConfig) -> float:
    """Regress the actor's mean on the expert's actions.

    Returns:
        Root mean square error of the last pass [1].
    """
    optimizer = torch.optim.Adam(networks.actor.parameters(), lr=config.lr)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.epochs, eta_min=0.1 * config.lr)
    error = 0.0
    for _ in tqdm(range(config.epochs), desc="fit", unit="epoch"):
        total = 0.0
        for index in torch.randperm(len(data)).split(config.minibatch_size):
            batch = data[index]
            loss = (networks.actor.module[0](batch.select(*_SEEN_KEYS))["loc"] - batch[keys.ACTION]).square().mean()
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            total += loss.item() * len(index)
        schedule.step()
        error = (total / len(data)) ** 0.5
    return error
