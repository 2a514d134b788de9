"""Folders and files that commands write to, tried before anything is played or measured."""

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


def make_place(file: Path, what: str) -> None:
    """Make the folder of a file that is to be written.

    Args:
        file: The file.
        what: What it is for, in words.

    Raises:
        RunError: If the folder cannot be made, or there is a folder where the file is to be.
    """
    if file.is_dir():
        msg = f"{what} is {str(file)!r}, a folder; accepted: a file to write"
        raise RunError(msg)
    make_folder(file.parent, f"folder of {what}")
