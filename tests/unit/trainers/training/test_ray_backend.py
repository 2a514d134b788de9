"""Collecting on a Ray cluster; the slow tests start one of two nodes on this machine."""

from __future__ import annotations

import signal
import threading
import time
from typing import TYPE_CHECKING, Any

import pytest
import torch
from tensordict import TensorDict

from cura_torchrl.trainers import train as module
from cura_torchrl.trainers.build import Networks, build_collector
from cura_torchrl.trainers.checkpoint import CHECKPOINT_FOLDER, find_checkpoint, read_config
from cura_torchrl.trainers.errors import NodeLostError, NonFiniteError, UnavailableError, WorkerError
from cura_torchrl.trainers.train import train
from cura_torchrl.trainers.training import ray_backend
from cura_torchrl.trainers.training.learner import Learner
from cura_torchrl.trainers.training.progress import PROGRESS_NAME, read_progress
from cura_torchrl.trainers.training.ray_backend import DROPPED_KEYS, Node, place, require_ray, without_scan
from tests.runs import FRAMES, small_run

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from cura_torchrl.trainers.config import TrainConfig


@pytest.fixture
def config(tmp_path: Path) -> TrainConfig:
    """A run of three updates that sees no map, with a worker on each of two nodes."""
    return small_run(tmp_path / "run", updates=3, backend="ray", num_workers=2, checkpoint_minutes=1e6)


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Two nodes of two processors each, as far as Ray knows."""
    # Imported here: Ray's own test cluster draws in packages that nothing else needs.
    from ray.cluster_utils import Cluster  # noqa: PLC0415

    options = {"num_cpus": 2, "object_store_memory": 80 * 2**20}
    started = Cluster(initialize_head=True, head_node_args={**options, "node_name": "one", "include_dashboard": False})
    try:
        started.add_node(node_name="two", **options)
        monkeypatch.setenv("RAY_ADDRESS", started.address)
        yield started
    finally:
        started.shutdown()


def node(name: str, num_cpus: int) -> Node:
    """A node whose identifier is its name."""
    return Node(id=name, name=name, num_cpus=num_cpus)


@pytest.mark.parametrize(
    ("num_cpus", "num_workers", "num_envs", "expected"),
    [
        ((2, 2), 2, 64, "ab"),  # one each, not two on the first
        ((1, 3), 4, 64, "abbb"),
        ((0, 2), 2, 64, "bb"),  # a head that only learns
        ((2, 2), 8, 64, "abab"),  # four processors, four workers
        ((2, 1), 4, 64, "ab"),  # three cannot share 64 worlds evenly, two can
        ((1, 1), 2, 3, "a"),
        ((), 2, 64, ""),
    ],
)
def test_workers_are_spread_and_share_the_worlds_evenly(
    num_cpus: tuple[int, ...], num_workers: int, num_envs: int, expected: str
) -> None:
    """Catches workers crowded on one node, more than the processors hold, or a rollout that shrinks with the nodes."""
    nodes = [node(name, count) for name, count in zip("ab", num_cpus, strict=False)]
    assert "".join(found.name for found in place(nodes, num_workers, num_envs)) == expected


def test_the_scan_stays_on_the_node_unless_it_is_spoilt() -> None:
    """Catches a rollout of five times the bytes, and a scan that is not finite and that the learner never sees."""
    root, after = ({"scan": torch.zeros(2, 3), "observation": torch.zeros(2, 1)} for _ in range(2))
    batch = TensorDict({**root, "next": after}, [2])
    sent = without_scan(batch)
    assert set(sent.keys(True, True)) == set(batch.keys(True, True)) - set(DROPPED_KEYS)
    batch["next", "scan"][0, 0] = float("nan")
    with pytest.raises(NonFiniteError, match=r"next\.scan of a rollout is not finite"):
        without_scan(batch)


def test_without_ray_the_error_says_what_to_install(config: TrainConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a traceback, or a run's folder that is begun before the missing package is noticed."""
    monkeypatch.setattr(ray_backend, "ray", None)
    with pytest.raises(UnavailableError, match=r"ray is not installed; accepted: pip install 'cura-torchrl\[ray\]'"):
        require_ray()
    with pytest.raises(UnavailableError):
        train(config)
    assert not config.run_dir.exists()


@pytest.mark.slow
def test_rollouts_come_from_both_nodes_with_the_learner_s_present_weights(config: TrainConfig, cluster: Any) -> None:
    """Catches workers that are all on one node, old weights or normalisation, or a dead worker beside a living one."""
    config = config.replace(num_envs=3, num_workers=3)
    learner = Learner(config, Networks(config))
    actor = learner.networks.actor
    before = signal.getsignal(signal.SIGTERM)
    with build_collector(config, actor, frames_done=0) as rollouts:
        assert signal.getsignal(signal.SIGTERM) is before
        where = [
            ray_backend.ray.get(worker.__ray_call__.remote(_node_id))
            for worker in rollouts._collector.remote_collectors
        ]
        assert set(where) == {node.node_id for node in cluster.list_all_nodes()}
        for _ in range(3):
            batch = rollouts.next()
            assert batch.shape == (3, 4)
            assert batch["episode"][:, 0].flatten().tolist() == [0, 1, 2]  # a row of each worker
            with torch.no_grad():
                now = actor.module[0](batch.select("observation", "latent"))
            torch.testing.assert_close(now["loc"], batch["loc"], atol=1e-5, rtol=0)
            learner.update(batch)
        # The first node has the third worker too, which lives on.
        ray_backend.ray.kill(rollouts._collector.remote_collectors[0])
        with pytest.raises(NodeLostError) as lost:
            rollouts.next()
        assert lost.value.node_ids == {where[0]} == {where[2]}
    with (
        pytest.raises(WorkerError, match=r"num_workers is 6; accepted: up to 3, what the Ray cluster can hold"),
        build_collector(config.replace(num_envs=6, num_workers=6), actor, frames_done=0),
    ):
        pass


@pytest.mark.slow
def test_a_node_that_dies_is_named_and_the_run_goes_on_without_it(
    config: TrainConfig, cluster: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Catches a learner that waits for ever for a node that is gone, starts over, or gives its environments up."""
    (second,) = (node for node in cluster.list_all_nodes() if node is not cluster.head_node)
    killed_at = []

    def kill() -> None:
        cluster.remove_node(second, allow_graceful=False)
        killed_at.append(time.time())

    update = Learner.update

    def update_and_kill(self: Learner, batch: object) -> dict[str, float]:
        metrics = update(self, batch)
        if not killed_at:
            thread = threading.Thread(target=kill)
            thread.start()
            thread.join()
        return metrics

    monkeypatch.setattr(Learner, "update", update_and_kill)
    path = train(config)
    (record,) = [record for record in caplog.records if record.name == module.__name__]
    name, saved = f"two ({second.node_ip_address})", config.run_dir / CHECKPOINT_FOLDER / f"checkpoint-{FRAMES:012d}"
    assert record.getMessage() == f"node {name} has died, or the worker on it; the run goes on from {saved} without it"
    assert record.created - killed_at[0] < 10.0
    assert read_config(path)[1]["frames"] == 3 * FRAMES
    assert [row["frames"] for row in read_progress(config.run_dir / PROGRESS_NAME)] == [8, 16, 24]
    assert find_checkpoint(config.run_dir) == path


def _node_id(_: object) -> str:
    return str(ray_backend.ray.get_runtime_context().get_node_id())
