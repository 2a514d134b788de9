"""TorchRL's collector on this machine: in this process, or in several."""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

from torchrl.collectors import Collector
from torchrl.weight_update import SharedMemWeightSyncScheme

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from tensordict.nn import TensorDictModuleBase
    from torchrl.collectors import BaseCollector
    from torchrl.envs import EnvBase


@contextmanager
def local_collector(
    factories: Sequence[Callable[[], EnvBase]], policy: TensorDictModuleBase, frames_per_batch: int
) -> Iterator[BaseCollector]:
    """Collect without end, and stop in the end.

    Args:
        factories: Make the environments, one in this process or each in a process of its own.
        policy: Writes the action; processes share its memory.
        frames_per_batch: Environment steps of a batch, over all environments [1].

    Yields:
        Collector whose batches have the shape ``[rows of all environments, T]``.
    """
    options: dict[str, Any] = {
        "frames_per_batch": frames_per_batch,
        "total_frames": -1,
        "auto_register_policy_transforms": False,
        "use_buffers": True,
    }
    with ExitStack() as stack:
        if len(factories) == 1:
            collector = Collector(factories[0], policy, **options)
        else:
            scheme = SharedMemWeightSyncScheme()
            # Left to the end of the process it would start a thread there, and the process would never end.
            stack.callback(scheme.shutdown)
            processes = {"sync": True, "backend": "process", "backend_options": {"cat_results": 0}}
            collector = Collector(
                list(factories), policy, weight_sync_schemes={"policy": scheme}, **processes, **options
            )
        stack.callback(collector.shutdown)
        yield collector
