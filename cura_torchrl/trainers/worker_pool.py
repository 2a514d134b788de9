"""Processes that work on parts of a job side by side: they tell how far they are, and end with who started them."""

from __future__ import annotations

import multiprocessing
import os
import threading
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import TYPE_CHECKING, Any, TypeVar

from cura_torchrl.trainers.errors import WorkerError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_Part = TypeVar("_Part")
_Result = TypeVar("_Result")

_POLL = 0.5
"""Time between two looks at how far the processes are [s]."""

_counter: Any = None
"""In a worker: what all workers of the pool have done [1], shared with their parent."""


def in_processes(
    work: Callable[[_Part], _Result],
    parts: Sequence[_Part],
    num_workers: int,
    *,
    keep: Callable[[_Part, _Result], object],
    tick: Callable[[int], object],
) -> None:
    """Work on parts in processes of their own, which end when this one does, even if it is killed.

    Args:
        work: What to do with a part; it and all that it takes and returns can be pickled.
        parts: The parts; they are begun in this order.
        num_workers: Number of processes [1].
        keep: Called here with each part and its result, as they come.
        tick: Called here with how much :func:`count_one` counted since it was called last [1].

    Raises:
        WorkerError: If a process dies.
    """
    context = multiprocessing.get_context("spawn")
    counter, told = context.Value("q", 0), 0
    with ProcessPoolExecutor(
        min(num_workers, len(parts)), mp_context=context, initializer=_begin, initargs=(counter,)
    ) as pool:
        futures = {pool.submit(work, part): part for part in parts}
        waiting = set(futures)
        try:
            while waiting:
                done, waiting = wait(waiting, timeout=_POLL, return_when=FIRST_COMPLETED)
                now = counter.value
                if now > told:
                    tick(now - told)
                    told = now
                # What is done first: where a process has died, others may have ended just before.
                for future in sorted(done, key=lambda future: future.exception() is not None):
                    keep(futures[future], future.result())
        except BrokenProcessPool:
            msg = "a process that plays has died; accepted: the same command again, perhaps with fewer workers"
            raise WorkerError(msg) from None
        finally:
            pool.shutdown(wait=False, cancel_futures=True)  # else leaving the block would work on to the end


def count_one() -> None:
    """Tell the process that started this one that one more piece of a part is done."""
    if _counter is not None:
        with _counter.get_lock():
            _counter.value += 1


def _begin(counter: Any) -> None:
    global _counter  # noqa: PLW0603 - a process of the pool has one parent
    _counter = counter
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when its parent is killed: it would wait for work forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
