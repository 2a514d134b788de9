"""Processes that work on parts of a job side by side: they tell how far they are, and end with who started them."""

from __future__ import annotations

import functools
import multiprocessing
import os
import threading
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
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
_tick: Callable[[int], object] | None = None
"""Where a part is worked on in the process of the pool: what is told of it."""


class WorkerPool:
    """Works on parts: in processes of their own, or here if one worker is asked for.

    Processes are started when there is work for them, and end when this one does, even if it is killed.

    Args:
        num_workers: How many parts are worked on side by side [1].
    """

    def __init__(self, num_workers: int) -> None:
        self._pool: ProcessPoolExecutor | None = None
        self._told = 0
        if num_workers > 1:
            context = multiprocessing.get_context("spawn")
            self._counter = context.Value("q", 0)
            self._pool = ProcessPoolExecutor(
                num_workers, mp_context=context, initializer=_begin, initargs=(self._counter,)
            )

    def __enter__(self) -> WorkerPool:
        """Open the pool.

        Returns:
            The pool.
        """
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """End the processes; after an exception at once, for nobody waits for what they are at.

        Args:
            kind: The exception's class, if there was one.
        """
        if self._pool is None:
            return
        if kind is not None:
            for process in list(self._pool._processes.values()):
                process.terminate()
        self._pool.shutdown(cancel_futures=True)

    def run(
        self,
        work: Callable[[_Part], _Result],
        parts: Sequence[_Part],
        *,
        keep: Callable[[_Part, _Result], object],
        tick: Callable[[int], object],
    ) -> None:
        """Work on parts.

        Args:
            work: What to do with a part; it and all that it takes and returns can be pickled.
            parts: The parts; they are begun in this order.
            keep: Called here with each part and its result, as they come.
            tick: Called here with how much :func:`count_one` counted since it was called last [1].

        Raises:
            WorkerError: If a process dies.
        """
        if self._pool is None:
            _run_here(work, parts, keep, tick)
            return
        try:
            futures = {self._pool.submit(work, part): part for part in parts}
            waiting = set(futures)
            while waiting:
                done, waiting = wait(waiting, timeout=_POLL, return_when=FIRST_COMPLETED)
                self._tell(tick)
                # What is done first: where a process has died, others may have ended just before.
                for future in sorted(done, key=_has_failed):
                    keep(futures[future], future.result())
        except BrokenProcessPool:
            msg = "a worker process has died; accepted: the same command again, perhaps with fewer workers"
            raise WorkerError(msg) from None

    def map(
        self, work: Callable[[_Part], _Result], parts: Sequence[_Part], *, tick: Callable[[int], object]
    ) -> list[_Result]:
        """Work on parts, and return what comes of them.

        Args:
            work: See :meth:`run`.
            parts: See :meth:`run`.
            tick: See :meth:`run`.

        Returns:
            Results in the order of the parts.

        Raises:
            WorkerError: If a process dies.
        """  # noqa: DOC502 - raised by what this calls
        found: dict[int, _Result] = {}

        def keep(part: tuple[int, _Part], result: _Result) -> None:
            found[part[0]] = result

        self.run(functools.partial(_numbered, work), list(enumerate(parts)), keep=keep, tick=tick)
        return [found[number] for number in range(len(parts))]

    def _tell(self, tick: Callable[[int], object]) -> None:
        now = self._counter.value
        if now > self._told:
            tick(now - self._told)
            self._told = now


def count_one() -> None:
    """Tell who works with the pool that one more piece of a part is done; elsewhere it does nothing."""
    if _tick is not None:
        _tick(1)
    if _counter is not None:
        with _counter.get_lock():
            _counter.value += 1


def _run_here(
    work: Callable[[_Part], _Result],
    parts: Sequence[_Part],
    keep: Callable[[_Part, _Result], object],
    tick: Callable[[int], object],
) -> None:
    global _tick  # noqa: PLW0603 - count_one is called from deep inside of the work
    before, _tick = _tick, tick
    try:
        for part in parts:
            keep(part, work(part))
    finally:
        _tick = before


def _numbered(work: Callable[[_Part], _Result], part: tuple[int, _Part]) -> _Result:
    return work(part[1])


def _has_failed(future: Future[Any]) -> bool:
    return future.exception() is not None


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
