"""Configuration of the benchmarks: pure data, importable without torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import tyro

from cura_torchrl.validation import require, require_fields

BenchTarget: TypeAlias = Literal["env", "learner", "lidar", "ik", "peers"]


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """Measure how fast the parts are, each beside a reference that is measured in turn with it."""

    target: tyro.conf.Positional[BenchTarget]
    """What is measured. env: PushEnv beside bare PyBullet; learner: loss and update; lidar: scan, map and encoder;
    ik: the arm's inverse kinematics; peers: the same task through other vectorised environments."""
    output: Path | None = None
    """File for the results; none is runs/bench/TARGET.json."""
    rounds: int = 7
    """How often everything is measured, in turn [1]; once more to warm up."""
    steps: int = 20
    """Policy steps of a round [1]."""
    num_envs: int = 64
    """Worlds of a process with PyBullet [1]; robots of ik."""
    num_workers: int = 2
    """Processes that are compared with one [1]; threads of what is timed by the clock on the wall in one process."""
    sweep: tuple[int, ...] = (16, 32)
    """Other numbers of worlds that env tries in one process [1]."""
    planar_envs: int = 1024
    """Worlds of the planar simulator over all processes [1]."""
    peer_envs: int = 8
    """Worlds of peers, which are as many processes for the others [1]; a multiple of the number of workers."""
    maps: int = 1024
    """Maps of a step of the map, and of a batch of the encoder [1]."""
    batch_size: int = 4096
    """Samples of a minibatch of the loss [1]; the energy distance takes four times as many."""
    panda_gym: bool = False
    """Whether peers measures panda-gym too, which pip installs from the package index into a virtual environment."""
    venv: Path = Path("runs/bench/panda-gym")
    """That virtual environment; made if it is not there."""
    seed: int = 0
    """Seed of scenarios, actions and networks [1]."""

    def __post_init__(self) -> None:
        require_fields(self)
        for name in ("rounds", "steps", "num_envs", "num_workers", "planar_envs", "peer_envs", "maps", "batch_size"):
            require(getattr(self, name) >= 1, name, getattr(self, name), "1 or more")
        require(all(count >= 1 for count in self.sweep), "sweep", self.sweep, "1 or more each")
        shares = self.peer_envs % self.num_workers == 0
        require(shares, "peer_envs", self.peer_envs, f"a multiple of num_workers, which is {self.num_workers}")
        require(0 <= self.seed < 2**31, "seed", self.seed, "0 to 2147483647")
