"""What every command of the command line needs: its flags read, errors as one line, nothing but results on stdout."""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import logging
import os
import re
import sys
from typing import TYPE_CHECKING, Any

import tyro

from cura_torchrl.trainers.errors import RunError
from cura_torchrl.trainers.info import git_commit

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

PROGRAM = "cura-torchrl"


def require_path(path: Path | None) -> None:
    """Raise unless a path exists: before anything slow is imported; what it holds is checked when it is read.

    Args:
        path: The path, if any.

    Raises:
        RunError: If there is nothing.
    """
    if path is not None and not path.exists():
        msg = f"no checkpoint at {path}; accepted: a run's folder or a checkpoint's folder"
        raise RunError(msg)


def parse(options: type[Any], command: str, arguments: list[str], default: Any = None) -> Any:
    """Return the flags of a command as its configuration.

    Args:
        options: The configuration's class.
        command: Name of the command.
        arguments: Arguments after it.
        default: What the flags start from; the class's defaults if None.

    Returns:
        The configuration.

    Raises:
        RunError: If the flags are wrong; one line in place of tyro's box.
        SystemExit: After ``--help``.
    """
    printed = io.StringIO()
    given = {} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(printed), one_line_errors():
            return tyro.cli(options, prog=f"{PROGRAM} {command}", args=arguments, **given)
    except SystemExit as exit_:
        if exit_.code in {0, None}:
            raise
        raise RunError(_unbox(printed.getvalue())) from None


def _unbox(text: str) -> str:
    """Return the message inside tyro's box."""
    inside = re.findall(r"^│ ?(.*?) *│$", text, flags=re.MULTILINE)
    rule = next((index for index, line in enumerate(inside) if line.startswith("───")), len(inside))
    return " ".join(" ".join(inside[:rule] or [text]).split())


@contextlib.contextmanager
def one_line_errors() -> Iterator[None]:
    """Turn errors of a configuration into those that the command line shows in one line.

    Yields:
        Nothing.

    Raises:
        RunError: If a value is not acceptable.
    """
    try:
        yield
    except (ValueError, argparse.ArgumentError) as error:
        raise RunError(str(error)) from None


@contextlib.contextmanager
def clean_stdout() -> Iterator[None]:
    """Send what libraries print, C code and worker processes included, to stderr.

    Yields:
        Nothing.
    """
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)


def load_module(name: str) -> Any:
    """Return a module that needs torch, TorchRL or the simulator, which write to stdout while they are imported.

    From here on the code that runs is what is recorded, even if another commit is checked out meanwhile.

    Args:
        name: Its name.

    Returns:
        The module.
    """
    git_commit()
    with clean_stdout():
        module = importlib.import_module(name)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    return module


def as_text(result: dict[str, Any], indent: str = "") -> str:
    r"""Return a result for people to read, a line a value.

    Args:
        result: JSON-compatible.
        indent: What each line begins with.

    Returns:
        Lines of text.

    Examples:
        >>> as_text({"success": 0.5, "versions": {"torch": "2"}})
        'success: 0.5\nversions:\n  torch: 2\n'
    """
    lines = []
    for name, value in result.items():
        if isinstance(value, dict):
            lines.append(f"{indent}{name}:\n{as_text(value, indent + '  ')}".rstrip("\n"))
        else:
            shown = f"{value:.4g}" if isinstance(value, float) else value
            lines.append(f"{indent}{name}: {', '.join(value) if isinstance(value, list) else shown}")
    return "\n".join(lines) + "\n"
