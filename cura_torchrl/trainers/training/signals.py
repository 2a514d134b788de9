"""Requests to stop, by signal: noted, and acted upon where nothing is lost by it."""

from __future__ import annotations

import signal
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

from cura_torchrl.trainers.errors import Interrupted

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import FrameType


_Requests = TypeVar("_Requests", bound="StopRequests")


class StopRequests:
    """Notes signals in place of what they do otherwise; those that are ignored, as nohup has SIGHUP, stay so.

    Only the main thread can handle signals: elsewhere nothing is noted.

    Args:
        *numbers: Signals.
    """

    def __init__(self, *numbers: int) -> None:
        self.received: list[int] = []
        """Signals that came, in their order."""
        self._numbers = numbers
        self._before: dict[int, Any] = {}

    def __enter__(self: _Requests) -> _Requests:
        """Note signals from now on.

        Returns:
            Itself.
        """
        if threading.current_thread() is threading.main_thread():
            handled = [number for number in self._numbers if signal.getsignal(number) is not signal.SIG_IGN]
            self._before = {number: signal.signal(number, self._handle) for number in handled}
        return self

    def __exit__(self, *_: object) -> None:
        """Let signals do what they did before."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, _: FrameType | None) -> None:
        self.received.append(number)


class Interruption(StopRequests):
    """Turns a signal into an exception, but only where that may happen; a second one acts at once.

    Args:
        *numbers: Signals.
    """

    def __init__(self, *numbers: int) -> None:
        super().__init__(*numbers)
        self._may_raise = False

    @contextmanager
    def raising(self) -> Iterator[None]:
        """Let a signal interrupt what is done in this context, or one that has come before it begins.

        Yields:
            Nothing.
        """
        self._may_raise = True
        try:
            self._check()
            yield
        finally:
            self._may_raise = False

    def _handle(self, number: int, frame: FrameType | None) -> None:
        super()._handle(number, frame)
        self.__exit__()
        self._check()

    def _check(self) -> None:
        if self._may_raise and self.received:
            raise Interrupted(self.received[0])
