"""Configuration of the training of many runs: pure data, importable without torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cura_torchrl.envs.config import Simulator
from cura_torchrl.trainers.config import TrainConfig
from cura_torchrl.trainers.lists import Numbers, split_names
from cura_torchrl.trainers.methods import method
from cura_torchrl.validation import require

if TYPE_CHECKING:
    from collections.abc import Sequence

_OWN_FLAGS = ("--method", "--seed", "--total-frames", "--simulator", "--run-dir", "--init-from", "--resume")
"""Flags of ``train`` that ``train-all`` sets itself."""
_GPU_RUNS = 8
"""Most runs that share a GPU unless more are asked for [1]: so many trained side by side on an H100."""


@dataclass(frozen=True, kw_only=True)
class TrainAllConfig:
    """Train every method with every seed, each as a run METHOD-SEED of train; what is trained already is kept."""

    methods: tuple[str, ...] = ("push-no-occlusion", "push", "cura-ppo")
    """What is trained, one after the other or joined by commas."""
    seeds: Numbers = (0,)
    """Training seeds, one after the other or joined by commas."""
    total_frames: int = TrainConfig.total_frames
    """Environment steps of each run [1]; runs that have fewer go on."""
    simulator: Simulator = TrainConfig.simulator
    """Which simulator runs the worlds."""
    runs: Path = Path("runs")
    """Folder of runs; METHOD-SEED in it holds checkpoints, progress.csv and, as train.log, what train printed."""
    init_from: tuple[str, ...] = ()
    """Warm starts, one after the other or joined by commas: METHOD=PATH is that of a method, a PATH alone that of all
    other methods; none starts from nothing."""
    jobs: int | None = None
    """Runs side by side [1]; none is as many as the cores allow, on a GPU with a core each and at most eight."""
    retries: int = 2
    """How often a run that failed is tried again from its last checkpoint [1]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "methods", split_names(self.methods))
        object.__setattr__(self, "init_from", split_names(self.init_from))
        require(bool(self.methods), "methods", self.methods, "one or more methods")
        for name in self.methods:
            method(name)
        are_seeds = all(0 <= seed < 2**31 for seed in self.seeds) and len(set(self.seeds)) == len(self.seeds)
        require(bool(self.seeds) and are_seeds, "seeds", self.seeds, "one or more different ones of 0 to 2147483647")
        require(self.total_frames > 0, "total_frames", self.total_frames, "1 or more")
        require(self.jobs is None or self.jobs > 0, "jobs", self.jobs, "1 or more")
        require(self.retries >= 0, "retries", self.retries, "0 or more")
        starts = [name for name, equals, _ in (entry.partition("=") for entry in self.init_from) if equals]
        for name in starts:
            method(name)
        alone = len(self.init_from) - len(starts)
        is_clear = alone <= 1 and len(set(starts)) == len(starts)
        require(is_clear, "init_from", self.init_from, "one METHOD=PATH for each method, and one PATH for the others")

    def start_of(self, name: str) -> Path | None:
        """Return the warm start of a method.

        Args:
            name: The method.

        Returns:
            A run or a checkpoint; None where the method starts from nothing.

        Examples:
            >>> config = TrainAllConfig(init_from=("imitate-push-conf", "push=imitate-push"))
            >>> config.start_of("push").name, config.start_of("cura-ppo").name
            ('imitate-push', 'imitate-push-conf')
        """
        found = dict(entry.split("=", 1) if "=" in entry else ["", entry] for entry in self.init_from)
        path = found.get(name, found.get(""))
        return None if path is None else Path(path)

    def train_arguments(self, name: str, seed: int, flags: Sequence[str] = ()) -> tuple[str, ...]:
        """Return the arguments of ``train`` for one run.

        Args:
            name: The method.
            seed: Training seed.
            flags: Further flags, the same for all runs.

        Returns:
            The arguments, without a warm start and without ``--resume``.

        Raises:
            ValueError: If one of the flags is set by this configuration; one line.

        Examples:
            >>> TrainAllConfig().train_arguments("push", 3, ["--seed", "4"])
            Traceback (most recent call last):
            ValueError: flag after -- is '--seed'; accepted: the flags of train but --method, --seed, --total-frames, \
--simulator, --run-dir, --init-from, --resume
        """  # noqa: DOC502 - raised by what this calls
        for flag in flags:
            is_own = flag.partition("=")[0].replace("_", "-") in _OWN_FLAGS
            require(not is_own, "flag after --", flag, f"the flags of train but {', '.join(_OWN_FLAGS)}")
        folder = self.runs / f"{name}-{seed}"
        own = {"method": name, "seed": seed, "total-frames": self.total_frames, "simulator": self.simulator}
        words = (word for flag, value in own.items() for word in (f"--{flag}", str(value)))
        return (*words, "--run-dir", str(folder), *flags)


@dataclass(frozen=True, kw_only=True)
class PlannedRun:
    """One run that is asked for."""

    config: TrainConfig
    """Its whole configuration."""
    arguments: tuple[str, ...]
    """Arguments of ``train`` that make this configuration."""
    init_from: Path | None = None
    """Run or checkpoint whose networks to start from."""

    @property
    def name(self) -> str:
        """Name of the run's folder, METHOD-SEED."""
        return self.config.run_dir.name


def default_jobs(run: TrainConfig, cores: int) -> int:
    """Return how many runs fit side by side.

    Args:
        run: Configuration of each of them.
        cores: Cores that there are [1].

    Returns:
        Number of runs [1], at least one.

    Examples:
        >>> default_jobs(TrainConfig(num_workers=1, learner_threads=2), cores=9)
        4
        >>> default_jobs(TrainConfig(device="cuda"), cores=16)
        8
    """
    if run.device != "cpu":
        return max(1, min(_GPU_RUNS, cores // run.num_workers))
    return max(1, cores // max(run.num_workers, run.learner_threads))
