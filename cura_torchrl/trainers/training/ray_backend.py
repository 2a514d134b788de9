"""Collecting on the nodes of a Ray cluster, through TorchRL's own Ray collector.

Ray finds the cluster by the variable ``RAY_ADDRESS``, or by the node that this process runs on; without one it starts
a cluster of this machine alone.
"""

from __future__ import annotations

import functools
import logging
import signal
import threading
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict
from torchrl.collectors import Collector

from cura_torchrl import keys
from cura_torchrl.trainers.errors import NodeLostError, NonFiniteError, UnavailableError, WorkerError
from cura_torchrl.trainers.training.diagnostics import find_non_finite

try:
    import ray
    from ray.exceptions import ActorUnavailableError, RayActorError, RayError, RayTaskError
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
except ImportError:
    ray = None

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

    from tensordict import TensorDictBase
    from tensordict.nn import ProbabilisticTensorDictSequential
    from torchrl.envs import EnvBase

    from cura_torchrl.trainers.config import TrainConfig

logger = logging.getLogger(__name__)

START_SECONDS = 300.0
"""Time in which every worker has to be there [s]: it imports torch and builds its worlds."""
PROBE_SECONDS = 2.0
"""Time in which Ray tells which workers are dead [s], once a call to one of them has failed."""
UNAVAILABLE_SECONDS = 8.0
"""The same where one cannot be reached and is not known to be dead [s]."""
DROPPED_KEYS = (keys.SCAN, ("next", keys.SCAN))
"""What no one reads in a rollout: four fifths of its bytes. The map has seen the scan already."""


@dataclass(frozen=True, kw_only=True)
class Node:
    """A machine of the cluster."""

    id: str
    """Ray's own identifier."""
    name: str
    """Ray's name of the node, and its address."""
    num_cpus: int
    """Processors that it offers [1]."""


class RayRollouts:
    """Rollouts of workers that are spread over nodes, each made with the policy's present weights.

    Args:
        collector: TorchRL's Ray collector.
        policy: Policy on the CPU whose weights are sent out.
        nodes: Node of each worker.
    """

    def __init__(self, collector: Any, policy: ProbabilisticTensorDictSequential, nodes: Sequence[Node]) -> None:
        self._collector, self._policy, self._nodes = collector, policy, nodes

    def start(self) -> None:
        """Wait until every worker has built its worlds.

        Raises:
            WorkerError: If a worker cannot start, or has not within :data:`START_SECONDS`.
            NodeLostError: If a node has died.
        """  # noqa: DOC502 - raised by what this calls
        pings = [worker.__ray_ready__.remote() for worker in self._collector.remote_collectors]
        _, late = ray.wait(pings, num_returns=len(pings), timeout=START_SECONDS)
        if late:
            names = _names(self._nodes[pings.index(ping)] for ping in late)
            msg = f"no worker has started within {START_SECONDS:.0f} s on {names}; accepted: nodes with free processors"
            raise WorkerError(msg)
        self._call(ray.get, pings)

    def next(self) -> TensorDictBase:
        """Send the weights out and collect a rollout.

        Returns:
            Rollout, shape ``[num_envs, rollout_steps]``, without :data:`DROPPED_KEYS`.

        Raises:
            NodeLostError: If a node, or the worker on it, has died.
            NonFiniteError: If a number is not finite.
        """  # noqa: DOC502 - raised by what this calls
        # Three things of torchrl 0.14.1's RayCollector are gone round with its own `map_fn`. Its iterator ends at once
        # with `total_frames=-1`, its default; it waits for all rollouts before it looks at an error, where `ray.get` of
        # all raises the first; and its weights go through gloo, whose processes connect each to each, at an address
        # that is 127.0.1.1 where /etc/hosts says so. Ray's object store needs no connections but its own.
        weights = ray.put(TensorDict.from_module(self._policy).data)
        self._call(self._collector.map_fn, "update_policy_weights_", [(weights,)] * len(self._nodes))
        return torch.cat(self._call(self._collector.map_fn, "next"))

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except RayTaskError as error:
            # What a worker raised on purpose is told like the learner's own.
            raise error.cause from None
        except RayError as error:
            raise self._explain(error) from None

    def _explain(self, error: Exception) -> NodeLostError | WorkerError:
        # Asks every worker: the failed call names one, and a node takes several with it. One that is busy counts as
        # alive. Ray's list of nodes is no help: it shows a dead one until a health check fails.
        pings = [worker.__ray_ready__.remote() for worker in self._collector.remote_collectors]
        # A connection may break before Ray knows that who was at its other end is dead.
        patience = UNAVAILABLE_SECONDS if isinstance(error, ActorUnavailableError) else PROBE_SECONDS
        answered, _ = ray.wait(pings, num_returns=len(pings), timeout=patience)
        deaths = [(node, _death(ping)) for node, ping in zip(self._nodes, pings, strict=True) if ping in answered]
        lost = {node for node, death in deaths if death is not None}
        for node, death in deaths:
            if death is not None and death.actor_init_failed:
                reason = str(death).strip().splitlines()[-1]
                return WorkerError(f"a worker cannot start on {node.name}: {reason}")
        if not lost:
            return WorkerError(f"Ray has failed: {error}; the last checkpoint is intact, go on with --resume")
        return NodeLostError(_names(lost), frozenset(node.id for node in lost))


def require_ray() -> None:
    """Raise unless Ray can be imported.

    Raises:
        UnavailableError: If it cannot.
    """
    if ray is None:
        msg = "ray is not installed; accepted: pip install 'cura-torchrl[ray]'"
        raise UnavailableError(msg)


@contextmanager
def ray_rollouts(
    config: TrainConfig,
    make_env: Callable[..., EnvBase],
    policy: ProbabilisticTensorDictSequential,
    *,
    without: Collection[str] = (),
) -> Iterator[RayRollouts]:
    """Collect on the nodes of a cluster, and let them go in the end.

    Args:
        config: Number of environments and workers.
        make_env: Called on a node with the number of worlds and ``worker``, the index among all workers.
        policy: Policy on the CPU.
        without: Identifiers of nodes that have died. With any, fewer workers are accepted: they share all environments.

    Yields:
        Source of rollouts.

    Raises:
        UnavailableError: If Ray is not installed.
        WorkerError: If there are too few processors, or a worker cannot start.
        NodeLostError: If a node has died.
    """  # noqa: DOC502 - raised by what this calls
    require_ray()
    with ExitStack() as stack:
        if not ray.is_initialized():
            _connect()
            stack.callback(ray.shutdown)
        nodes = place([node for node in _living_nodes() if node.id not in without], config.num_workers, config.num_envs)
        if not nodes:
            msg = "no node of the Ray cluster is left to collect; the last checkpoint is intact, go on with --resume"
            raise WorkerError(msg)
        if len(nodes) < config.num_workers and not without:
            msg = f"num_workers is {config.num_workers}; accepted: up to {len(nodes)}, what the Ray cluster can hold"
            raise WorkerError(msg)
        collector = _collector(config, make_env, policy, nodes)
        stack.callback(collector.shutdown)
        rollouts = RayRollouts(collector, policy, nodes)
        rollouts.start()
        logger.info("collecting on %s; workers: %d", _names(nodes), len(nodes))
        yield rollouts


def place(nodes: Sequence[Node], num_workers: int, num_envs: int) -> list[Node]:
    """Return the node of each worker.

    Args:
        nodes: Nodes of the cluster.
        num_workers: Most workers [1].
        num_envs: Environments, which the workers have to share evenly [1].

    Returns:
        Nodes in turn, each as often as it has processors, and no more of them than can share the environments.

    Examples:
        >>> one, two = (Node(id=name, name=name, num_cpus=2) for name in ("one", "two"))
        >>> [node.name for node in place([one, two], num_workers=8, num_envs=6)]
        ['one', 'two', 'one']
    """
    rounds = range(max((node.num_cpus for node in nodes), default=0))
    slots = [node for turn in rounds for node in nodes if node.num_cpus > turn]
    most = min(num_workers, len(slots))
    return slots[: next((count for count in range(most, 0, -1) if num_envs % count == 0), 0)]


def without_scan(batch: TensorDictBase) -> TensorDictBase:
    """Return a rollout without what no one reads, which need not cross the network.

    Args:
        batch: Rollout of one worker; not changed.

    Returns:
        The rollout without :data:`DROPPED_KEYS`.

    Raises:
        NonFiniteError: If a number is not finite: the learner cannot look at what it does not get.
    """
    bad = find_non_finite(batch)
    if bad is not None:
        msg = f"{bad} of a rollout is not finite; the last checkpoint is intact"
        raise NonFiniteError(msg)
    return batch.exclude(*DROPPED_KEYS)


def _death(ping: Any) -> RayActorError | None:
    try:
        ray.get(ping)
    except RayActorError as death:
        return death
    return None


def _connect() -> None:
    before = signal.getsignal(signal.SIGTERM)
    ray.init(include_dashboard=False, log_to_driver=False, logging_level=logging.WARNING)
    # Ray takes SIGTERM for itself, and the run would end without a checkpoint.
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)


def _living_nodes() -> list[Node]:
    found: list[Mapping[str, Any]] = [node for node in ray.nodes() if node["Alive"]]
    return [
        Node(
            id=node["NodeID"],
            name=f"{node['NodeName']} ({node['NodeManagerAddress']})",
            num_cpus=int(node["Resources"].get("CPU", 0)),
        )
        for node in sorted(found, key=lambda node: node["NodeID"])
    ]


def _collector(
    config: TrainConfig, make_env: Callable[..., EnvBase], policy: ProbabilisticTensorDictSequential, nodes: list[Node]
) -> Any:
    share = config.num_envs // len(nodes)
    # Placed by hand, so that a node that dies has a name, and none that Ray does not know to be dead is given work.
    remote = [
        {"num_cpus": 1, "scheduling_strategy": NodeAffinitySchedulingStrategy(node.id, soft=False)} for node in nodes
    ]
    options = {
        "remote_configs": remote,
        # None of TorchRL's: see `RayRollouts.next`.
        "weight_sync_schemes": {},
        "collector_kwargs": {
            "auto_register_policy_transforms": False,
            "use_buffers": True,
            "postproc": without_scan,
        },
    }
    return Collector(
        [functools.partial(make_env, share, worker=worker) for worker in range(len(nodes))],
        policy,
        backend="ray",
        sync=True,
        frames_per_batch=config.frames_per_batch,
        backend_options=options,
    )


def _names(nodes: Iterator[Node] | Collection[Node]) -> str:
    return ", ".join(sorted({node.name for node in nodes}))
