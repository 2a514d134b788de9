"""Parts of a job in processes of their own."""

from __future__ import annotations

import os

import pytest

from cura_torchrl.trainers.errors import WorkerError
from cura_torchrl.trainers.worker_pool import count_one, in_processes


def _square(number: int) -> int:
    count_one()
    if number < 0:
        os._exit(1)
    return number * number


def test_every_part_is_kept_with_its_own_result() -> None:
    """Catches results that are kept for another part, and work that is not told."""
    kept, told = {}, []
    in_processes(_square, [1, 2, 3], 2, keep=kept.__setitem__, tick=told.append)
    assert kept == {1: 1, 2: 4, 3: 9}


def test_what_was_done_before_a_process_died_is_kept() -> None:
    """Catches results that are thrown away with the process that died after them."""
    kept = {}
    with pytest.raises(WorkerError, match="a process that plays has died; accepted: the same command again"):
        in_processes(_square, [1, 2, -1], 1, keep=kept.__setitem__, tick=lambda _: None)
    assert kept == {1: 1, 2: 4}
