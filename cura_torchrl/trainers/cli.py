"""The command line: ``cura-torchrl COMMAND``."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
from typing import TYPE_CHECKING

from cura_torchrl.trainers.command_line import PROGRAM
from cura_torchrl.trainers.commands import COMMANDS
from cura_torchrl.trainers.errors import RunError
from cura_torchrl.trainers.methods import PRESETS

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Arguments; those of the process if None.

    Returns:
        Exit code: 0, 2 after a one-line error, 1 if some of several runs failed, 130 and 143 after SIGINT and SIGTERM,
        141 when nobody reads on.
    """
    # PyTorch then takes huge pages for large tensors. It reads this once, when it makes the first one.
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
    given = list(sys.argv[1:] if arguments is None else arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    try:
        _run(given)
    except RunError as error:
        return _complain(error, error.exit_code)
    except BrokenPipeError:  # who reads has seen enough, such as ``| head``
        _discard_output()
        return 128 + signal.SIGPIPE
    except OSError as error:
        _discard_output()
        return _complain(error, RunError.exit_code)
    except KeyboardInterrupt:
        return 130
    return 0


def _run(given: list[str]) -> None:
    if sys.stdout is None:
        raise RunError("standard output is closed; accepted: one that can be written, such as /dev/null")
    if not given or given[0] in {"-h", "--help"}:
        sys.stdout.write(_overview())
    elif given[0] in COMMANDS:
        COMMANDS[given[0]](given[1:])
    else:
        raise RunError(f"{given[0]!r} is no command; accepted: {', '.join(COMMANDS)}")
    sys.stdout.flush()  # else it would be told after the end that nothing could be written


def _discard_output() -> None:
    """Let what could not be written not be told again when Python ends."""
    with contextlib.suppress(OSError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _complain(error: Exception, code: int) -> int:
    sys.stderr.write(f"{PROGRAM}: {' '.join(str(error).split())}\n")
    return code


def _overview() -> str:
    lines = [f"  {name:<14}{(command.__doc__ or '').splitlines()[0]}" for name, command in COMMANDS.items()]
    usage = f"usage: {PROGRAM} COMMAND [flags]; {PROGRAM} COMMAND --help lists the flags"
    return "\n".join([usage, "", "commands:", *lines, "", f"methods: {', '.join(PRESETS)}", ""])


if __name__ == "__main__":
    sys.exit(main())
