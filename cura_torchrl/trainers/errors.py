"""What a user can cause and mend: each message is one line, and the command line shows nothing else."""

from __future__ import annotations

import signal


class RunError(Exception):
    """Base of the errors that the command line tells in one line."""

    exit_code = 2
    """Exit code of the command line."""


class CheckpointError(RunError, ValueError):
    """A checkpoint is missing, damaged, or does not fit."""


class NonFiniteError(RunError, ArithmeticError):
    """A number that must be finite is not; the run stopped in that step."""


class WorkerError(RunError):
    """A process that collects has died."""


class UnavailableError(RunError):
    """A part that was asked for is not installed or not there."""


class Interrupted(RunError):  # noqa: N818 - no error of anyone's: the run was asked to stop
    """The run was asked to stop by a signal, and has written a checkpoint.

    Args:
        number: The signal.

    Examples:
        >>> Interrupted(signal.SIGTERM).exit_code
        143
    """

    def __init__(self, number: int) -> None:
        super().__init__(f"stopped by {signal.Signals(number).name} with a checkpoint written; go on with --resume")
        self.exit_code = 128 + number
