"""The training loop: collect, estimate, update, log, checkpoint; nothing in it is hidden."""

from __future__ import annotations

import copy
import logging
import signal
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch
from torchrl.checkpoint import GlobalRNGState

from cura_torchrl.trainers.build import Networks, build_collector, fitting_encoder
from cura_torchrl.trainers.checkpoint import find_checkpoint, read_config, restore, save_checkpoint, sweep
from cura_torchrl.trainers.decoding import changed_fields
from cura_torchrl.trainers.errors import (
    CheckpointError,
    Interrupted,
    NodeLostError,
    RunError,
    UnavailableError,
    WorkerError,
)
from cura_torchrl.trainers.training.diagnostics import (
    RecentEpisodes,
    finished_episodes,
    rollout_statistics,
)
from cura_torchrl.trainers.training.learner import Learner
from cura_torchrl.trainers.training.progress import Progress, require_logger
from cura_torchrl.trainers.training.ray_backend import RayRollouts, require_ray
from cura_torchrl.trainers.training.run_folder import CHECKPOINT_FOLDER, locked, require_no_run
from cura_torchrl.trainers.training.signals import Interruption
from cura_torchrl.trainers.training.warm_start import start_from

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from torchrl.collectors import BaseCollector

    from cura_torchrl.trainers.config import TrainConfig

logger = logging.getLogger(__name__)

_PLACE_FIELDS = {
    "run_dir", "device", "backend", "num_workers", "learner_threads", "env.simulator", "env.physics.planar_graph"
}  # fmt: skip
"""Fields that only say where a run goes on, or follow from another."""
_DEATH_SIGNS = ("process failed", "failed to initialize", "process object is closed", "Cannot close a process")
"""What TorchRL's and Python's errors say when a worker process has died."""


_PATIENCE = 3
"""Times in a row that workers may die before an update [1]; nodes of a cluster that is started anew look new."""


def train(config: TrainConfig, *, resume: bool = False, init_from: Path | None = None) -> Path:
    """Train a method.

    Args:
        config: The run.
        resume: Whether to go on from the newest good checkpoint in ``run_dir``.
        init_from: Checkpoint or run whose networks to start from; optimisers, counters and curriculum start afresh.

    Returns:
        The last checkpoint.

    Raises:
        CheckpointError: If a checkpoint is missing or damaged, or ``run_dir`` holds a run that is not to be resumed.
        RunError: If a run is to be resumed and to start from other networks, or the encoder does not take the maps.
        NonFiniteError: If a reward, an observation, a loss or a gradient is not finite; the last checkpoint is intact.
        Interrupted: If SIGINT or SIGTERM asked the run to stop.
        WorkerError: If a process that collects has died, or no node is left that could.
        UnavailableError: If a part that was asked for is not installed.
    """  # noqa: DOC502 - raised by what this calls
    if resume and init_from is not None:
        msg = (
            f"init_from is {init_from} beside resume; accepted: --resume, which goes on with the run's own networks, or"
        )
        raise RunError(f"{msg} --init-from with another --run-dir")
    _require_device(config.device)
    require_logger(config)
    if config.backend == "ray":
        require_ray()
    if config.perception == "map":
        fitting_encoder(config)  # what is wrong with it is told before there is a folder
    with locked(config.run_dir), Interruption(signal.SIGINT, signal.SIGTERM) as signals:
        return _Run(config, resume=resume, init_from=init_from).loop(signals)


class RandomState(GlobalRNGState):
    """State of the process's random draws, without a GPU's where there is none: from there on the draws are others."""

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore it.

        Args:
            state_dict: What ``state_dict`` returned, on this machine or another.
        """
        is_there = torch.cuda.is_available()
        super().load_state_dict({name: value for name, value in state_dict.items() if is_there or name != "torch_cuda"})


def _require_device(name: str) -> None:
    try:
        torch.zeros(0, device=name)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        accepted = "cpu, or a device of this machine that its PyTorch was built for"
        msg = f"device is {name!r} ({str(error).splitlines()[0]}); accepted: {accepted}"
        raise UnavailableError(msg) from None


class _Run:
    """State of a run between updates."""

    def __init__(self, config: TrainConfig, *, resume: bool, init_from: Path | None) -> None:
        self.config = config
        self.folder = config.run_dir / CHECKPOINT_FOLDER
        sweep(self.folder)
        torch.set_num_threads(config.learner_threads)
        torch.manual_seed(config.seed)
        self.learner = Learner(config, Networks(config))
        networks = self.learner.networks
        is_shared = config.env_device == config.device
        self.policy = networks.actor if is_shared else copy.deepcopy(networks.actor).to(config.env_device)
        self.components = {**self.learner.components(), "rng": RandomState()}
        self.saved_at = time.monotonic()
        source = self._source(resume)
        if source is not None:
            restore(source, self.components)
        elif init_from is not None:
            start = find_checkpoint(init_from)
            fresh = start_from(start, networks)
            told = f"; it has no {' and no '.join(fresh)}, which start afresh" if fresh else ""
            logger.info("networks start from %s%s", start, told)
        self.sync()

    def _source(self, resume: bool) -> Path | None:
        # The checkpoint to go on from, or None for a run that starts.
        if not resume:
            require_no_run(self.config.run_dir, "--resume, or another --run-dir")
            return None
        source = find_checkpoint(self.config.run_dir)
        before, _ = read_config(source)
        if before.method != self.config.method:
            msg = f"method is {self.config.method!r} but {source} is of {before.method!r}; accepted: the same method"
            raise CheckpointError(msg)
        for name, (old, new) in changed_fields(before, self.config).items():
            if name not in _PLACE_FIELDS:
                logger.info("%s: %s -> %s", name, old, new)
        return source

    def loop(self, signals: Interruption) -> Path:
        # Trains until the frames are spent.
        frames = self.learner.frames
        checkpoint = self._save() if frames == 0 else find_checkpoint(self.config.run_dir)
        if frames >= self.config.total_frames:
            return checkpoint
        progress = Progress(self.config, frames=frames)
        recent = RecentEpisodes(self.config.recent_episodes)
        try:
            lost: frozenset[str] = frozenset()
            in_vain = 0
            while self.learner.frames < self.config.total_frames:
                before = self.learner.frames
                lost |= self._collect(signals, progress, recent, lost)
                in_vain = 0 if self.learner.frames > before else in_vain + 1
                if in_vain == _PATIENCE:
                    msg = f"workers died {in_vain} times in a row before an update; the last checkpoint is intact"
                    raise WorkerError(msg)
        except Interrupted:
            # Raised only between updates or while collecting, so what is saved is the end of a whole update.
            self._save()
            raise
        finally:
            progress.close()
        return self._save()

    def sync(self) -> None:
        # In place: workers have this memory mapped, so no message has to reach them, and none is waited for in vain.
        if self.policy is not self.learner.networks.actor:
            self.policy.load_state_dict(self.learner.networks.actor.state_dict())

    def _collect(
        self, signals: Interruption, progress: Progress, recent: RecentEpisodes, without: frozenset[str]
    ) -> frozenset[str]:
        # Trains until the frames are spent or nodes have died, and returns which.
        frames = self.learner.frames
        try:
            with (
                _worker_errors(signals),
                build_collector(self.config, self.policy, frames_done=frames, without=without) as collector,
            ):
                self._iterate(collector, signals, progress, recent)
        except NodeLostError as error:
            # Raised between updates, like a signal: the checkpoint that the run goes on from loses none of them.
            logger.warning("%s; the run goes on from %s without it", error, self._save())
            return error.node_ids
        return frozenset()

    def _iterate(
        self,
        collector: BaseCollector | RayRollouts,
        signals: Interruption,
        progress: Progress,
        recent: RecentEpisodes,
    ) -> None:
        while self.learner.frames < self.config.total_frames:
            started = time.monotonic()
            with signals.raising():
                batch = collector.next()
            collected = time.monotonic()
            recent.extend(finished_episodes(batch))
            row = {
                "frames": self.learner.frames + batch.numel(),
                "max_obstacles": self.config.env.task.max_obstacles(self.learner.frames),
                **recent.rates(),
                **rollout_statistics(batch),
                **self.learner.update(batch),
            }
            self.sync()
            finished = time.monotonic()
            row["collect_seconds"], row["update_seconds"] = collected - started, finished - collected
            row["frames_per_second"] = batch.numel() / (finished - started)
            progress.add(row)
            if finished - self.saved_at >= 60.0 * self.config.checkpoint_minutes:
                self._save()

    def _save(self) -> Path:
        path = save_checkpoint(
            self.components,
            self.config,
            self.folder,
            frames=self.learner.frames,
            keep_last=self.config.keep_checkpoints,
        )
        self.saved_at = time.monotonic()
        return path


@contextmanager
def _worker_errors(signals: Interruption) -> Iterator[None]:
    # TorchRL tells of a process that died by one of these, after the worker's own traceback has been printed. A signal
    # to the whole process group ends the workers too.
    try:
        yield
    except (RuntimeError, ValueError, EOFError, ConnectionError) as error:
        if not isinstance(error, (EOFError, ConnectionError)) and not any(sign in str(error) for sign in _DEATH_SIGNS):
            raise
        with signals.raising():
            pass
        msg = f"a process that collects has died ({error}); the last checkpoint is intact, go on with --resume"
        raise WorkerError(msg) from None
