"""Train the encoder of confidence maps that all methods share, once and before any policy."""

from __future__ import annotations

import dataclasses
import functools
import json
import logging
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import torch
from matplotlib.figure import Figure
from torch.nn import functional as F  # noqa: N812
from tqdm import tqdm

from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.transforms import ConfidenceMap
from cura_torchrl.modules.map_vae import MapVAE, map_vae_loss
from cura_torchrl.trainers.decoding import encode
from cura_torchrl.trainers.errors import RunError
from cura_torchrl.trainers.folders import make_folder
from cura_torchrl.trainers.info import git_commit, versions
from cura_torchrl.trainers.training.map_dataset import (
    MapDataset,
    RandomPusher,
    collect_maps,
    unpack_maps,
    unpacking_table,
)
from cura_torchrl.trainers.training.pretrain_map_config import PretrainMapConfig

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from tensordict.nn import TensorDictModuleBase
    from torchrl.envs import EnvBase

    from cura_torchrl.envs.config import MapConfig, Simulator

logger = logging.getLogger(__name__)

WEIGHTS_NAME = "map_vae.pt"
"""File with the weights, see :meth:`cura_torchrl.modules.MapVAE.load`."""
FIGURES_NAME = "map_vae.json"
"""File with the held-out figures, the configuration and what it was made with."""
PICTURE_NAME = "map_vae.png"
"""Picture of held-out maps beside their reconstructions."""
MAPS_NAME = "maps.pt"
"""File with the collected maps; kept, so that another training need not collect them again."""
TRAINING_NAME = "training.pt"
"""File with the state of the training after its last epoch."""


def make_random_env(config: PretrainMapConfig, worker: int, *, occlusion: bool, simulator: Simulator) -> EnvBase:
    """Return a worker's environment for collecting.

    Args:
        config: Environment.
        worker: Index of the process.
        occlusion: Whether rays see the object.
        simulator: Which simulator runs the worlds.

    Returns:
        Environment with true obstacles for the scripted pusher, on the stream "vae".
    """
    task = dataclasses.replace(config.env.task, stream="vae", privileged=True, random_first_age=False)
    lidar = dataclasses.replace(config.env.lidar, occlusion=occlusion)
    env = dataclasses.replace(config.env, task=task, lidar=lidar, simulator=simulator)
    return PushEnv(
        config.num_envs,
        env,
        seed=config.seed,
        first_episode=worker * config.num_envs,
        episode_stride=config.num_workers * config.num_envs,
    )


def pretrain_map(
    config: PretrainMapConfig,
    *,
    make_env: Callable[..., EnvBase] = make_random_env,
    policy: TensorDictModuleBase | None = None,
) -> dict[str, float]:
    """Collect maps, train the autoencoder, and write weights, figures and a picture to ``config.run_dir``.

    What is there already is used: maps that were collected in the same way, and a training that was cut off.

    Args:
        config: Everything.
        make_env: Called with the configuration, a worker's index, ``occlusion`` and ``simulator``; must be picklable.
        policy: What pushes; None is the scripted pusher with noise.

    Returns:
        Held-out figures, see :func:`measure`.

    Raises:
        RunError: If the maps are of too few episodes to hold one out and to train on another, or the folder of the run
            cannot be made.
    """
    make_folder(config.run_dir, "run_dir")
    policy = RandomPusher(noise=config.noise) if policy is None else policy
    data = _maps(config, make_env, policy)
    torch.set_num_threads(config.threads)
    train, held_out = data.split(config.held_out)
    if not min(len(train), len(held_out)):
        msg = f"num_maps is {config.num_maps}, of which {len(held_out)} are held out; accepted: enough for two episodes"
        raise RunError(msg)
    table = unpacking_table(config.map.decay, config.decays, config.map.channels)
    vae = _train(config, data, train, table)
    figures = {"train_maps": float(len(train)), "held_out_maps": float(len(held_out))}
    for which, decay in enumerate(config.decays):
        scores = measure(vae, _in_batches(data, held_out, which, table, config.batch_size), config.map)
        figures |= {f"{name}, decay {decay:g}": value for name, value in scores.items()}
    vae.save(config.run_dir / WEIGHTS_NAME)
    _draw(vae, data, held_out, table, config)
    # The folder of the machine that trained says nothing elsewhere.
    told = dataclasses.replace(config, run_dir=PretrainMapConfig.run_dir)
    record = {"figures": figures, "config": encode(told), "versions": versions(), "commit": git_commit()}
    _write(config.run_dir / FIGURES_NAME, json.dumps(record, indent=2) + "\n")
    logger.info("%s", ", ".join(f"{name} {value:.4g}" for name, value in figures.items()))
    return figures


def _maps(config: PretrainMapConfig, make_env: Callable[..., EnvBase], policy: TensorDictModuleBase) -> MapDataset:
    """Return the maps of this configuration, collected now if need be."""
    names = ("env", "simulators", "map", "num_maps", "keep_every", "num_envs", "num_workers", "noise", "seed")
    fingerprint = json.dumps([encode(getattr(config, name)) for name in names])
    path = config.run_dir / MAPS_NAME
    data = MapDataset.load(path, fingerprint)
    if data is not None:
        return data
    # Occupancy is dropped on reading where it is not wanted.
    map_config = dataclasses.replace(config.map, channels="confidence+occupancy")
    lidar = config.env.lidar
    parts = [
        collect_maps(
            functools.partial(make_env, config, occlusion=occlusion, simulator=simulator),
            functools.partial(ConfidenceMap, map_config, num_rays=lidar.num_rays, max_range=lidar.max_range),
            policy,
            num_envs=config.num_envs,
            num_workers=config.num_workers,
            num_maps=math.ceil(config.num_maps / (2 * len(config.simulators))),
            keep_every=config.keep_every,
            seed=config.seed,
        )
        for simulator in config.simulators
        for occlusion in (True, False)
    ]
    data = MapDataset(torch.cat([part.codes for part in parts]), torch.cat([part.episodes for part in parts]))
    data.save(path, fingerprint)
    return data


def _train(config: PretrainMapConfig, data: MapDataset, train: torch.Tensor, table: torch.Tensor) -> MapVAE:
    torch.manual_seed(config.seed)
    vae = MapVAE(
        latent_size=config.latent_size,
        channels=table.shape[-1],
        window=config.map.window,
        widths=config.widths,
        patch=config.patch,
        activation=config.activation,
    )
    optimiser = torch.optim.Adam(vae.parameters(), lr=config.lr)
    steps = config.epochs * math.ceil(len(train) / config.batch_size)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    parts: dict[str, Any] = {"vae": vae, "optimiser": optimiser, "schedule": schedule}
    fingerprint = json.dumps(encode(dataclasses.replace(config, run_dir=Path(), threads=1)))
    path = config.run_dir / TRAINING_NAME
    first = _resume(path, parts, fingerprint)
    for epoch in range(first, config.epochs):
        # A generator for each epoch: a training that was cut off goes on as if it had not been.
        generator = torch.Generator().manual_seed(config.seed + 7919 * epoch)
        order = train[torch.randperm(len(train), generator=generator)]
        with tqdm(order.split(config.batch_size), desc=f"epoch {epoch + 1}/{config.epochs}", unit="batch") as bar:
            for batch in bar:
                which = torch.randint(len(table), (len(batch),), generator=generator)
                total = _update(vae, optimiser, unpack_maps(data.codes[batch], which, table), config, generator)
                schedule.step()
                bar.set_postfix(loss=f"{total:.1f}", refresh=False)
        state = {name: part.state_dict() for name, part in parts.items()}
        partial = path.with_name(f"{path.name}.partial")
        torch.save({"epochs": epoch + 1, "fingerprint": fingerprint, **state}, partial)
        partial.replace(path)
    return vae.eval()


def _update(
    vae: MapVAE,
    optimiser: torch.optim.Optimizer,
    maps: torch.Tensor,
    config: PretrainMapConfig,
    generator: torch.Generator,
) -> float:
    """Return the loss after one gradient step."""
    mean, log_variance = vae.statistics(maps)
    noise = torch.randn(mean.shape, generator=generator)
    logits = vae.decode(mean + noise * (0.5 * log_variance).exp())
    has_occupancy = config.map.channels != "confidence"
    loss = map_vae_loss(
        logits,
        mean,
        log_variance,
        maps,
        beta=config.beta,
        occupancy_weight=config.occupancy_weight if has_occupancy else 1.0,
        occupied_weight=config.occupied_weight if has_occupancy else 1.0,
    )
    optimiser.zero_grad(set_to_none=True)
    loss.total.backward()
    torch.nn.utils.clip_grad_norm_(vae.parameters(), 1e3)
    optimiser.step()
    return loss.total.item()


def _resume(path: Path, parts: dict[str, Any], fingerprint: str) -> int:
    """Return the epochs that a training had done when it was cut off, and restore its state."""
    if not path.exists():
        return 0
    stored = torch.load(path, map_location="cpu", weights_only=True)
    if stored["fingerprint"] != fingerprint:
        return 0
    for name, part in parts.items():
        part.load_state_dict(stored[name])
    return int(stored["epochs"])


def _in_batches(
    data: MapDataset, indices: torch.Tensor, which: int, table: torch.Tensor, batch_size: int
) -> Iterator[torch.Tensor]:
    for batch in indices.split(batch_size):
        yield unpack_maps(data.codes[batch], torch.full((len(batch),), which), table)


@torch.no_grad()
def measure(vae: MapVAE, batches: Iterator[torch.Tensor], config: MapConfig, *, reach: float = 4.0) -> dict[str, float]:
    """Measure how well maps come through the code.

    An occupied cell counts as found if a cell within one cell of it, diagonals included, is reconstructed as occupied
    (above 1/2), and a reconstructed one as right in the same way. Both are counted up to a distance from the robot.

    Args:
        vae: The autoencoder.
        batches: Maps, shape ``[B, C, W, W]`` each.
        config: Resolution and channels.
        reach: Distance from the robot up to which occupied cells are counted [m].

    Returns:
        ``bce``: cross-entropy, mean over cells and channels [nat]; ``confidence_error``: mean absolute error of the
        first channel [1]; ``recall`` and ``precision`` of occupied cells [1], 1 where there are none, absent from maps
        of confidence alone.
    """
    entropy, error, cells, maps_cells = 0.0, 0.0, 0, 0
    found = torch.zeros(4, dtype=torch.float64)
    for maps in batches:
        shown = vae.reconstruct(maps)
        entropy += F.binary_cross_entropy(shown, maps, reduction="sum").item()
        error += (shown[:, 0] - maps[:, 0]).abs().sum().item()
        cells += maps.numel()
        maps_cells += maps[:, 0].numel()
        found += _count_found(shown[:, -1] > 0.5, maps[:, -1] > 0.5, reach / config.resolution)
    figures = {"bce": entropy / cells, "confidence_error": error / maps_cells}
    if config.channels != "confidence":
        hits, occupied, right, claimed = found.tolist()
        figures |= {"recall": hits / occupied if occupied else 1.0, "precision": right / claimed if claimed else 1.0}
    return figures


def _count_found(claimed: torch.Tensor, occupied: torch.Tensor, reach: float) -> torch.Tensor:
    """Return the numbers of occupied cells found, occupied cells, claimed cells that are right, claimed cells."""
    window = occupied.shape[-1]
    offset = torch.arange(window) - (window - 1) / 2
    is_near = (offset[:, None] ** 2 + offset**2).sqrt() <= reach
    around_claimed = F.max_pool2d(claimed.float(), 3, 1, 1) > 0
    around_occupied = F.max_pool2d(occupied.float(), 3, 1, 1) > 0
    masks = (occupied & around_claimed, occupied, claimed & around_occupied, claimed)
    return torch.stack([(mask & is_near).sum() for mask in masks]).double()


@torch.no_grad()
def _draw(
    vae: MapVAE, data: MapDataset, held_out: torch.Tensor, table: torch.Tensor, config: PretrainMapConfig
) -> None:
    """Write held-out maps and their reconstructions, the robot in the middle and looking up."""
    chosen = held_out[torch.linspace(0, len(held_out) - 1, 6).long()]
    maps = unpack_maps(data.codes[chosen], torch.arange(6) % len(table), table)
    rows = [image for pair in zip(maps.unbind(1), vae.reconstruct(maps).unbind(1), strict=True) for image in pair]
    with mpl.rc_context({"font.size": 8}):
        figure = Figure(figsize=(12, 2.1 * len(rows)), layout="constrained")
        axes = figure.subplots(len(rows), 6, squeeze=False)
        for i, images in enumerate(rows):
            for j, image in enumerate(images):
                # Base-frame x (rows) upwards, y (columns) to the left.
                axes[i, j].imshow(image.flip(0, 1).numpy(), vmin=0.0, vmax=1.0, cmap="gray")
                axes[i, j].set_axis_off()
            axes[i, 0].set_title(f"channel {i // 2}, {('map', 'reconstruction')[i % 2]}", loc="left")
        partial = config.run_dir / f"partial-{PICTURE_NAME}"
        figure.savefig(partial, dpi=100)
    partial.replace(config.run_dir / PICTURE_NAME)


def _write(path: Path, text: str) -> None:
    partial = path.with_name(f"{path.name}.partial")
    partial.write_text(text)
    partial.replace(path)
