"""Maps for the autoencoder: collected by pushing at random, one byte a cell, whatever the decay.

A map that decays is stored once. Its confidence tells how long ago a cell was seen, and so what it would be under any
other decay: M' = M^(ln alpha' / ln alpha).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from tensordict.nn import TensorDictModuleBase
from torch.nn import functional as F  # noqa: N812
from torchrl.data import Composite, UnboundedDiscrete
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.transforms import ObservationTransform
from tqdm import tqdm

from cura_torchrl import keys
from cura_torchrl.envs.robots.scripted import ScriptedAvoider, ScriptedPusher
from cura_torchrl.trainers.training.local_collector import local_collector

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from tensordict import TensorDictBase
    from torchrl.envs import EnvBase, Transform

LEVELS = 127
"""Steps that a confidence is stored in; above them, one bit holds the occupancy."""
CODES = "map_codes"
"""Key of a stored map, uint8, shape ``[*, W * W]``."""


@dataclass(frozen=True)
class MapDataset:
    """Stored maps and the episode that each comes from."""

    codes: torch.Tensor
    """One byte a cell, see :func:`pack_maps`, shape ``[M, W * W]``."""
    episodes: torch.Tensor
    """Index of the scenario, int64, shape ``[M]``: maps are held out by it, since those of one episode are alike."""

    def split(self, held_out: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the maps to train on and those held out, by episode.

        Args:
            held_out: Share of the episodes that is held out [1].

        Returns:
            Indices of the maps, int64; every ``1 / held_out``-th episode is held out.

        Examples:
            >>> data = MapDataset(torch.zeros(4, 1, dtype=torch.uint8), torch.tensor([0, 1, 2, 0]))
            >>> [part.tolist() for part in data.split(0.5)]
            [[1], [0, 2, 3]]
        """
        is_held_out = self.episodes % round(1 / held_out) == 0
        return (~is_held_out).nonzero().flatten(), is_held_out.nonzero().flatten()

    def save(self, path: Path, fingerprint: str) -> None:
        """Write the maps; the file appears whole or not at all.

        Args:
            path: File to write.
            fingerprint: What the maps were collected with.
        """
        partial = path.with_name(f"{path.name}.partial")
        torch.save({"codes": self.codes, "episodes": self.episodes, "fingerprint": fingerprint}, partial)
        partial.replace(path)

    @classmethod
    def load(cls, path: Path, fingerprint: str) -> MapDataset | None:
        """Return maps that were collected in the same way.

        Args:
            path: File that :meth:`save` has written, or no file.
            fingerprint: What the maps have to be collected with.

        Returns:
            The maps, in the file's memory; None if there are none or they are others.
        """
        if not path.exists():
            return None
        stored = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
        return cls(stored["codes"], stored["episodes"]) if stored["fingerprint"] == fingerprint else None


def pack_maps(maps: torch.Tensor) -> torch.Tensor:
    """Store confidence and occupancy in one byte a cell.

    Args:
        maps: Confidence and occupancy, shape ``[*, 2, W, W]``.

    Returns:
        Confidence in :data:`LEVELS` steps, never rounded to 0 where a cell was seen, plus 128 where it is occupied,
        uint8, shape ``[*, W * W]``.

    Examples:
        >>> pack_maps(torch.tensor([[[1.0, 1e-9, 0.0]], [[1.0, 0.0, 0.0]]])).tolist()
        [255, 1, 0]
    """
    confidence, occupancy = maps.flatten(-2).unbind(-2)
    level = (confidence * LEVELS).round().clamp_min(1.0) * (confidence > 0)
    return (level + 128.0 * occupancy).to(torch.uint8)


def unpacking_table(decay: float, decays: Sequence[float], channels: str) -> torch.Tensor:
    """Return what each byte stands for under each decay.

    Args:
        decay: Decay that the maps were collected with, between 0 and 1 [1].
        decays: Decays to show them under [1].
        channels: Channels as in :class:`~cura_torchrl.envs.config.MapConfig`.

    Returns:
        Values of the channels, shape ``[len(decays), 256, C]``.

    Examples:
        >>> unpacking_table(0.9, (0.9, 1.0), "confidence")[:, [0, 64, 255], 0].round(decimals=2).tolist()
        [[0.0, 0.5, 1.0], [0.0, 1.0, 1.0]]
    """
    byte = torch.arange(256)
    confidence, occupancy = (byte % 128) / LEVELS, (byte >= 128).float()
    tables = []
    for other in decays:
        # 0 to the power 0 is 1: a cell that was never seen is no special case but for the decay 1.
        power = math.log(other) / math.log(decay) if other > 0 else math.inf
        faded = confidence**power * (confidence > 0)
        tables.append(
            {
                "confidence+occupancy": torch.stack([faded, occupancy], -1),
                "product": (faded * occupancy)[:, None],
                "confidence": faded[:, None],
            }[channels]
        )
    return torch.stack(tables)


def unpack_maps(codes: torch.Tensor, which: torch.Tensor, table: torch.Tensor) -> torch.Tensor:
    """Return stored maps under given decays.

    Args:
        codes: One byte a cell, shape ``[B, W * W]``.
        which: Index of each map's decay, int64, shape ``[B]``.
        table: As from :func:`unpacking_table`, shape ``[D, 256, C]``.

    Returns:
        Maps in [0, 1], channels last in memory, shape ``[B, C, W, W]``.
    """
    window = math.isqrt(codes.shape[-1])
    cells = F.embedding(codes.int() + 256 * which.int()[:, None], table.flatten(0, 1))
    return cells.unflatten(1, (window, window)).permute(0, 3, 1, 2)


class PackMaps(ObservationTransform):
    """Replaces maps by their bytes, so that a collector carries an eighth of the memory.

    Reads and removes ``confidence_map``, shape ``[*, 2, W, W]``; writes ``map_codes``, uint8, shape ``[*, W * W]``.
    """

    def __init__(self) -> None:
        super().__init__(in_keys=[keys.CONFIDENCE_MAP], out_keys=[CODES])

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        next_tensordict.set(CODES, pack_maps(next_tensordict.get(keys.CONFIDENCE_MAP)))
        return next_tensordict.exclude(keys.CONFIDENCE_MAP, inplace=True)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Replace the map's spec.

        Args:
            observation_spec: Spec of the environment so far.

        Returns:
            The same spec with the bytes instead of the map.
        """
        spec = observation_spec[keys.CONFIDENCE_MAP]
        shape = (*spec.shape[:-3], spec.shape[-2] * spec.shape[-1])
        observation_spec[CODES] = UnboundedDiscrete(shape=shape, dtype=torch.uint8, device=spec.device)
        del observation_spec[keys.CONFIDENCE_MAP]
        return observation_spec


class RandomPusher(TensorDictModuleBase):
    """Scripted pushing with smooth noise: every second row goes around obstacles, the others run into them.

    Reads ``observation``, ``obstacles``, ``sensor_pose``; writes ``action``. The noise of an action follows a
    first-order autoregression, so that the robot drifts off and turns rather than trembles.

    Args:
        noise: Standard deviation of the noise, as a share of an action's range [1].
        persistence: Correlation of the noise from one step to the next [1].
    """

    def __init__(self, *, noise: float, persistence: float = 0.9) -> None:
        super().__init__()
        self.avoider = ScriptedAvoider()
        self.pusher = ScriptedPusher()
        self.in_keys = list(self.avoider.in_keys)
        self.out_keys = [keys.ACTION]
        self.noise = noise
        self.persistence = persistence
        self._drift: torch.Tensor | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action for every row.

        Args:
            tensordict: Holds the in_keys, batch ``[N]``.

        Returns:
            The same tensordict.
        """
        straight = self.pusher(tensordict.copy())[keys.ACTION]
        around = self.avoider(tensordict.copy())[keys.ACTION]
        fresh = self.noise * torch.randn_like(straight)
        if self._drift is None or self._drift.shape != fresh.shape:
            self._drift = fresh
        self._drift = self.persistence * self._drift + math.sqrt(1 - self.persistence**2) * fresh
        avoids = (torch.arange(len(straight)) % 2 == 0)[:, None]
        tensordict[keys.ACTION] = (torch.where(avoids, around, straight) + self._drift).clamp(-1.0, 1.0)
        return tensordict


def collect_maps(
    make_env: Callable[[int], EnvBase],
    make_transform: Callable[[], Transform],
    policy: TensorDictModuleBase,
    *,
    num_envs: int,
    num_workers: int,
    num_maps: int,
    keep_every: int,
    seed: int,
) -> MapDataset:
    """Play, and keep some of the maps.

    Args:
        make_env: Makes the environment of the worker whose index it is given; reaches other processes.
        make_transform: Makes the transform that adds ``confidence_map``, confidence and occupancy, decaying.
        policy: What acts.
        num_envs: Rows of each worker's environment [1].
        num_workers: Processes [1]; 1 stays in this process.
        num_maps: Maps to keep [1].
        keep_every: One map is kept of this many steps [1].
        seed: Seed of the policy's noise [1].

    Returns:
        The maps.
    """
    codes, episodes, count = [], [], 0
    factories = [
        functools.partial(_make_worker_env, make_env, make_transform, worker, seed) for worker in range(num_workers)
    ]
    frames = num_workers * num_envs * 8 * keep_every
    with (
        tqdm(total=num_maps, desc="collect", unit="map") as bar,
        local_collector(factories, policy, frames) as collector,
    ):
        for batch in collector:
            codes.append(batch[CODES][:, ::keep_every].flatten(0, 1).clone())
            episodes.append(batch[keys.EPISODE][:, ::keep_every].flatten().clone())
            count += len(codes[-1])
            bar.update(len(codes[-1]))
            if count >= num_maps:
                break
    return MapDataset(torch.cat(codes)[:num_maps], torch.cat(episodes)[:num_maps])


def _make_worker_env(
    make_env: Callable[[int], EnvBase], make_transform: Callable[[], Transform], worker: int, seed: int
) -> EnvBase:
    torch.set_num_threads(1)
    torch.manual_seed(seed + 7919 * worker)
    return TransformedEnv(make_env(worker), Compose(make_transform(), PackMaps()))
