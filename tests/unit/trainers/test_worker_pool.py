"""Parts of a job in processes of their own, or in this one."""

from __future__ import annotations

import os
import time

import pytest

from cura_torchrl.trainers.errors import WorkerError
from cura_torchrl.trainers.worker_pool import WorkerPool, count_one


def _square(number: int) -> int:
    count_one()
    if number < 0:
        time.sleep(2.0)  # the others are done by then
        os._exit(1)
    return number * number


@pytest.mark.parametrize("num_workers", [1, 2])
def test_every_part_is_kept_with_its_own_result(num_workers: int) -> None:
    """Catches results that are kept for another part, and work that is not told, also when a pool is used again."""
    kept, told = {}, []
    with WorkerPool(num_workers) as pool:
        pool.run(_square, [1, 2, 3], keep=kept.__setitem__, tick=told.append)
        assert pool.map(_square, [5, 4, 6, 5], tick=told.append) == [25, 16, 36, 25]
    assert kept == {1: 1, 2: 4, 3: 9}
    assert sum(told) == 7
    count_one()  # nobody waits for it
    assert sum(told) == 7


def test_what_was_done_before_a_process_died_is_kept() -> None:
    """Catches results that are thrown away with the process that died after them."""
    kept = {}
    with (
        WorkerPool(2) as pool,
        pytest.raises(WorkerError, match="a worker process has died; accepted: the same command again"),
    ):
        pool.run(_square, [1, 2, -1], keep=kept.__setitem__, tick=lambda _: None)
    assert kept == {1: 1, 2: 4}


def _sleep(seconds: float) -> None:
    time.sleep(seconds)


def test_an_error_does_not_wait_for_work_that_nobody_wants() -> None:
    """Catches Ctrl-C that ends only after the parts under way, which may take many minutes."""
    started = time.monotonic()

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), WorkerPool(2) as pool:
        pool.run(_sleep, [0.0, 250.0], keep=stop, tick=lambda _: None)
    assert time.monotonic() - started < 200.0
