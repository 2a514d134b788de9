"""The loop, on the real environment with two worlds."""

from __future__ import annotations

import dataclasses
import os
import signal
from typing import TYPE_CHECKING

import pytest
import torch

from cura_torchrl.trainers import train as module
from cura_torchrl.trainers.build import Networks, build_collector
from cura_torchrl.trainers.checkpoint import CHECKPOINT_FOLDER, find_checkpoint, read_config
from cura_torchrl.trainers.errors import (
    CheckpointError,
    Interrupted,
    NodeLostError,
    NonFiniteError,
    RunError,
    UnavailableError,
    WorkerError,
)
from cura_torchrl.trainers.train import RandomState, train
from cura_torchrl.trainers.training.learner import Learner
from cura_torchrl.trainers.training.progress import PROGRESS_NAME, read_progress
from cura_torchrl.trainers.training.run_folder import locked
from tests.runs import FRAMES, small_run

if TYPE_CHECKING:
    from pathlib import Path

    from cura_torchrl.trainers.config import TrainConfig


@pytest.fixture
def config(tmp_path: Path) -> TrainConfig:
    """A run of two updates that sees no map."""
    return small_run(tmp_path / "run", updates=2, checkpoint_minutes=0.0)


def frames_of(config: TrainConfig) -> list[float]:
    """Frames of the rows in progress.csv."""
    return [row["frames"] for row in read_progress(config.run_dir / PROGRESS_NAME)]


def test_a_run_writes_rows_and_checkpoints_and_goes_on_where_it_stopped(config: TrainConfig) -> None:
    """Catches a resumed run that starts over, repeats rows, or forgets its optimisers."""
    path = train(config)
    assert frames_of(config) == [FRAMES, 2 * FRAMES]
    assert read_config(path)[1]["frames"] == 2 * FRAMES
    longer = config.replace(total_frames=3 * FRAMES)
    again = train(longer, resume=True)
    assert frames_of(config) == [FRAMES, 2 * FRAMES, 3 * FRAMES]
    assert read_config(again) == (longer, read_config(again)[1])
    assert find_checkpoint(config.run_dir) == again


def test_random_draws_come_back_also_from_a_machine_with_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a run of a GPU that cannot go on without one, and draws that are not restored."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    random = RandomState()
    state = {**random.state_dict(), "torch_cuda": [torch.zeros(16, dtype=torch.uint8)]}
    drawn = torch.rand(4)
    random.load_state_dict(state)
    assert torch.equal(torch.rand(4), drawn)


@pytest.mark.parametrize("device", ["cuda:99", "gpu"])
def test_a_device_that_is_not_there_is_refused_in_one_line(config: TrainConfig, device: str) -> None:
    """Catches a traceback from deep inside PyTorch, and a run folder that is left behind."""
    with pytest.raises(UnavailableError, match=rf"device is '{device}' .*accepted: cpu") as caught:
        train(config.replace(device=device))
    assert "\n" not in str(caught.value)
    assert not config.run_dir.exists()


def test_the_environments_are_on_the_learners_device_where_they_can_be(config: TrainConfig) -> None:
    """Catches PyBullet's worlds, or those of other processes, that are sought on a GPU."""
    gpu = config.replace(device="cuda")
    here = gpu.replace(simulator="planar", env=dataclasses.replace(config.env, simulator="planar"))
    assert (here.env_device, gpu.env_device) == ("cuda", "cpu")
    assert here.replace(num_workers=2).env_device == "cpu"
    assert here.replace(backend="ray").env_device == "cpu"


def test_a_finished_run_is_left_as_it_is(config: TrainConfig) -> None:
    """Catches a resume that trains beyond the frames that were asked for."""
    assert train(config) == train(config, resume=True)


def test_a_folder_with_a_run_is_not_overwritten(config: TrainConfig) -> None:
    """Catches days of training lost to a forgotten flag."""
    train(config)
    with pytest.raises(CheckpointError, match="holds a run already; accepted: --resume"):
        train(config)
    with pytest.raises(CheckpointError, match="method is 'push' but"):
        train(config.replace(method="push"), resume=True)


def test_two_processes_do_not_train_in_one_folder(config: TrainConfig) -> None:
    """Catches checkpoints of two runs mixed in one folder."""
    with locked(config.run_dir), pytest.raises(CheckpointError, match="is being trained in by another process"):
        train(config)


def test_networks_may_start_from_another_run(config: TrainConfig, tmp_path: Path) -> None:
    """Catches a warm start that loads optimisers or counters, or nothing at all."""
    train(config)
    started = config.replace(run_dir=tmp_path / "second", total_frames=FRAMES)
    before = module._Run(started, resume=False, init_from=config.run_dir)
    source = module._Run(config, resume=True, init_from=None)
    ours, theirs = before.learner.networks.state_dict(), source.learner.networks.state_dict()
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    assert (before.learner.frames, source.learner.frames) == (0, 2 * FRAMES)


def test_a_run_that_is_resumed_starts_from_no_other(config: TrainConfig, tmp_path: Path) -> None:
    """Catches networks that were asked for and silently left out."""
    train(config)
    with pytest.raises(RunError, match=r"init_from is .*other beside resume; accepted: --resume, .*, or --init-from"):
        train(config, resume=True, init_from=tmp_path / "other")


def test_what_a_resumed_run_does_otherwise_is_told(config: TrainConfig, caplog: pytest.LogCaptureFixture) -> None:
    """Catches a flag that changes a run in the middle of its curve, of which its log would say nothing."""
    train(config)
    loud = {"ppo": dataclasses.replace(config.ppo, entropy_coeff=0.5), "learner_threads": 2, "keep_checkpoints": 2}
    with caplog.at_level("INFO", logger=module.__name__):
        train(config.replace(total_frames=3 * FRAMES, **loud), resume=True)
    told = [record.getMessage() for record in caplog.records if record.name == module.__name__]
    assert told == ["total_frames: 16 -> 24", "keep_checkpoints: 3 -> 2", "ppo.entropy_coeff: 0.005 -> 0.5"]


def test_a_perceptual_run_starts_from_a_method_of_the_paper_and_says_what_is_new(
    config: TrainConfig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Catches a fine-tuning that does not start, or does not tell that its estimators know nothing yet."""
    train(config)
    cura = dataclasses.replace(config.cura, uncertainty="perceptual")
    perceptual = config.replace(method="cura-perceptual", cura=cura, run_dir=tmp_path / "second", total_frames=FRAMES)
    with caplog.at_level("INFO"):
        checkpoint = train(perceptual, init_from=config.run_dir)
    assert "it has no privileged_estimator and no perceptual_estimator, which start afresh" in caplog.text
    assert train(perceptual.replace(total_frames=2 * FRAMES), resume=True).name > checkpoint.name


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_with_a_checkpoint(
    config: TrainConfig, number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a run that loses what it has learned since the last checkpoint when it is told to stop."""
    update = Learner.update

    def update_and_signal(self: Learner, batch: object) -> dict[str, float]:
        os.kill(os.getpid(), number)  # in the middle of an update, which is finished first
        return update(self, batch)

    monkeypatch.setattr(Learner, "update", update_and_signal)
    with pytest.raises(Interrupted) as caught:
        train(config.replace(checkpoint_minutes=1e6))
    assert caught.value.exit_code == 128 + number
    assert read_config(find_checkpoint(config.run_dir))[1]["frames"] == FRAMES
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_a_number_that_is_not_finite_leaves_the_last_checkpoint(
    config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a run that saves what a NaN has spoilt."""
    update = Learner.update

    def spoil(self: Learner, batch: object) -> dict[str, float]:
        if self.frames == FRAMES:
            batch["next", "reward"][0, 0] = float("nan")
        return update(self, batch)

    monkeypatch.setattr(Learner, "update", spoil)
    with pytest.raises(NonFiniteError, match=r"next\.reward of the rollout is not finite at 8 frames"):
        train(config)
    path = find_checkpoint(config.run_dir)
    assert read_config(path)[1]["frames"] == FRAMES
    assert len(list((config.run_dir / CHECKPOINT_FOLDER).iterdir())) == 2


@pytest.mark.slow
def test_workers_act_with_the_learner_s_present_weights(config: TrainConfig) -> None:
    """Catches workers that go on with old weights or normalisation: PPO's ratios would be wrong from the first step."""
    shared = config.replace(num_workers=2)
    learner = Learner(shared, Networks(shared))
    actor = learner.networks.actor
    with build_collector(shared, actor, frames_done=0) as collector:
        for _ in range(3):
            batch = collector.next()
            assert batch.shape == (2, 4)
            assert batch["episode"][:, 0].flatten().tolist() == [0, 1]
            with torch.no_grad():
                now = actor.module[0](batch.select("observation", "latent"))
            torch.testing.assert_close(now["loc"], batch["loc"], atol=1e-5, rtol=0)
            learner.update(batch)


def test_workers_that_die_again_and_again_end_the_run(config: TrainConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a run that starts a cluster for ever, in which the same worker is killed each time."""
    started = []

    @module.contextmanager
    def build_and_die(*_: object, **options: object) -> object:
        started.append(options["without"])
        yield
        raise NodeLostError("one", frozenset({str(len(started))}))

    monkeypatch.setattr(module, "build_collector", build_and_die)
    monkeypatch.setattr(module._Run, "_iterate", lambda *_: None)
    with pytest.raises(WorkerError, match="workers died 3 times in a row before an update"):
        train(config)
    assert started == [frozenset(), {"1"}, {"1", "2"}]


@pytest.mark.slow
def test_a_worker_that_is_killed_is_told_in_one_line(config: TrainConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a learner that waits for ever for a process that the system has killed."""
    build = module.build_collector

    class Killer:
        """Kills a worker before the second rollout."""

        def __init__(self, collector: object) -> None:
            self.collector, self.count = collector, 0

        def next(self) -> object:
            self.count += 1
            if self.count == 2:
                os.kill(self.collector.procs[0].pid, signal.SIGKILL)
            return self.collector.next()

    @module.contextmanager
    def build_and_kill(*given: object, **options: object) -> object:
        with build(*given, **options) as collector:
            yield Killer(collector)

    monkeypatch.setattr(module, "build_collector", build_and_kill)
    with pytest.raises(WorkerError, match="a process that collects has died"):
        train(config.replace(num_workers=2))
    assert read_config(find_checkpoint(config.run_dir))[1]["frames"] == FRAMES
