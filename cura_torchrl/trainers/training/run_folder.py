"""A run's folder, as far as it can be read without torch; its lock dies with the process that trains in it."""

from __future__ import annotations

import fcntl
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING

from cura_torchrl.trainers.errors import CheckpointError
from cura_torchrl.trainers.folders import make_folder

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

CHECKPOINT_FOLDER = "checkpoints"
"""Folder of a run that holds its checkpoints."""
_LOCK_NAME = ".lock"
_TRIES = 5


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep a second process from training in the same folder.

    Args:
        folder: The run's folder; made if need be.

    Yields:
        Nothing.

    Raises:
        CheckpointError: If another process trains there.
        RunError: If the folder cannot be made.
    """  # noqa: DOC502 - raised by what this calls
    make_folder(folder, "run_dir")
    with (folder / _LOCK_NAME).open("w") as file:
        for tries_left in reversed(range(_TRIES)):
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if tries_left == 0:
                    msg = f"{folder} is being trained in by another process; accepted: another --run-dir"
                    raise CheckpointError(msg) from None
                time.sleep(0.05)  # who looks whether there is a lock holds it for a moment
        yield


def require_no_run(folder: Path, accepted: str) -> None:
    """Raise if a folder holds a run, which another would mix with.

    Args:
        folder: The run's folder; it need not exist.
        accepted: What to do in place of that, in words.

    Raises:
        CheckpointError: If there are checkpoints.
    """
    checkpoints = folder / CHECKPOINT_FOLDER
    if checkpoints.is_dir() and any(checkpoints.iterdir()):
        msg = f"{folder} holds a run already; accepted: {accepted}"
        raise CheckpointError(msg)


def is_locked(folder: Path) -> bool:
    """Return whether a process trains in a folder.

    Args:
        folder: The run's folder; it need not exist.

    Returns:
        Whether the lock is held.
    """
    try:
        with (folder / _LOCK_NAME).open() as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except BlockingIOError:
        return True
    return False
