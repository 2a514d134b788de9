"""Folders that commands write to."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cura_torchrl.trainers.errors import RunError

if TYPE_CHECKING:
    from pathlib import Path


def make_folder(folder: Path, what: str) -> None:
    """Make a folder where there is none.

    Args:
        folder: The folder.
        what: What it is for, in words.

    Raises:
        RunError: If it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        accepted = "a folder, or a path where one can be made"
        msg = f"{what} is {str(folder)!r} ({error.strerror}); accepted: {accepted}"
        raise RunError(msg) from None
