"""Configuration of the encoder's training: pure data, importable without torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from cura_torchrl.envs.config import MapConfig, PushEnvConfig, Simulator
from cura_torchrl.validation import require, require_fields


@dataclass(frozen=True, kw_only=True)
class PretrainMapConfig:
    """Collect maps by pushing at random and train an autoencoder on them."""

    run_dir: Path = Path("runs/map_vae")
    """Folder for weights, figures, picture and maps."""
    env: PushEnvConfig = field(default_factory=PushEnvConfig)
    """Environment; its scenarios come from the stream "vae", with occlusion and without it half of the time each."""
    simulators: tuple[Simulator, ...] = ("bullet", "planar")
    """Simulators that the maps come from, as many from each; ``env.simulator`` is not used."""
    map: MapConfig = field(default_factory=MapConfig)
    """Map; its decay has to lie between 0 and 1, the other ones follow from it."""
    decays: tuple[float, ...] = (0.9, 1.0)
    """Decays that the encoder has to serve, drawn with equal chance for each map [1]."""
    num_maps: int = 100_000
    """Maps that are collected [1]; each takes ``window`` squared bytes."""
    keep_every: int = 3
    """One map is kept of this many steps [1]."""
    num_envs: int = 16
    """Worlds of each process [1]."""
    num_workers: int = 2
    """Processes that collect [1]."""
    noise: float = 0.35
    """Standard deviation of the smooth noise on the scripted action, as a share of its range [1]."""
    latent_size: int = 32
    """Length of the code z [1]."""
    widths: tuple[int, int, int] = (16, 32, 64)
    """Channels after each of the encoder's convolutions [1]."""
    patch: tuple[int, int] = (4, 4)
    """Kernel and stride of its first convolution [cells]."""
    activation: Literal["relu", "elu"] = "relu"
    """What follows each convolution."""
    beta: float = 1.0
    """Weight of the KL divergence [1]; 1 is the evidence lower bound but for the weight of occupied cells."""
    occupancy_weight: float = 20.0
    """Weight of the occupancy in the cross-entropy beside the confidence [1]; unused where there is only confidence."""
    occupied_weight: float = 10.0
    """Weight of an occupied cell beside a free one [1]; a 0.4 m obstacle shows 4 to 8 cells of 10,000."""
    epochs: int = 10
    """Passes over the maps [1]."""
    batch_size: int = 128
    """Maps per gradient step [1]."""
    lr: float = 2e-3
    """Learning rate at the start; it falls to 0 along half a cosine [1]."""
    held_out: float = 0.1
    """Share of the episodes that is held out for the figures [1]."""
    threads: int = 2
    """Threads of the training [1]."""
    seed: int = 0
    """Seed of scenarios, noise and networks."""

    def __post_init__(self) -> None:
        require_fields(self)
        require(0.0 < self.map.decay < 1.0, "map.decay", self.map.decay, "between 0 and 1: ages are read from it")
        require(
            bool(self.decays) and all(0.0 <= decay <= 1.0 for decay in self.decays),
            "decays",
            self.decays,
            "0 to 1 each",
        )
        for name in (
            "num_maps",
            "keep_every",
            "num_envs",
            "num_workers",
            "latent_size",
            "epochs",
            "batch_size",
            "threads",
        ):
            require(getattr(self, name) >= 1, name, getattr(self, name), "1 or more")
        require(min(*self.widths, *self.patch) >= 1, "widths, patch", (self.widths, self.patch), "1 or more each")
        require(0 <= self.seed < 2**31, "seed", self.seed, "0 to 2147483647")
        require(bool(self.simulators), "simulators", self.simulators, "one or more")
        require(0.0 < self.held_out <= 0.5, "held_out", self.held_out, "above 0, up to 0.5")
        require(self.lr > 0 and self.beta >= 0, "lr, beta", (self.lr, self.beta), "positive, not negative")
