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


class NodeLostError(WorkerError):
    """A node of the cluster, or the worker on it, has died; the run can go on without it.

    Args:
        names: Names and addresses of the nodes that have died.
        node_ids: Ray's identifiers of them.

    Examples:
        >>> str(NodeLostError("two (192.0.2.2)", frozenset({"ab12"})))
        'node two (192.0.2.2) has died, or the worker on it'
    """

    def __init__(self, names: str, node_ids: frozenset[str]) -> None:
        super().__init__(f"node {names} has died, or the worker on it")
        self.node_ids = node_ids


class RunsFailedError(RunError):
    """Of several runs some have failed; the others are done."""

    exit_code = 1


class UnavailableError(RunError):
    """A part that was asked for is not installed or not there."""


class Interrupted(RunError):  # noqa: N818 - no error of anyone's: the run was asked to stop
    """The run was asked to stop by a signal, and has written a checkpoint.

    Args:
        number: The signal.
        advice: How to go on.

    Examples:
        >>> Interrupted(signal.SIGTERM).exit_code
        143
    """

    def __init__(self, number: int, advice: str = "go on with --resume") -> None:
        super().__init__(f"stopped by {signal.Signals(number).name} with a checkpoint written; {advice}")
        self.exit_code = 128 + number
