"""Handling of SIGINT and SIGTERM: the first does not interrupt a command being sent, nor a robot being stopped."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Any

from jaxlfi.robots.robot import RobotError

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(KeyboardInterrupt):
    """The process was asked to end by a signal."""


class Interrupts:
    """A context in which signals raise `Interrupted` only where they may: in `check`, `waiting` and `calling`.

    Outside the main thread, signals are unaffected, as Python does not allow handling them there.
    """

    def __init__(self):
        """No signal has been received yet."""
        self._received: list[int] = []
        self._patience: int | None = None  # number of signals held back before one is raised; None: all
        self._before: dict[int, Any] = {}
        self._broken_off = ""  # why a call is to be interrupted

    def __enter__(self) -> "Interrupts":
        """Handle signals."""
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._handle) for number in SIGNALS}
        return self

    def __exit__(self, kind, error, trace) -> None:
        """Restore the previous handlers; raise a signal that has not been raised yet."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}
        if kind is None:
            self.check()

    def check(self) -> None:
        """Raise `Interrupted` if there was a signal."""
        if self._received:
            raise Interrupted(signal.Signals(self._received[0]).name)

    def waiting(self) -> contextlib.AbstractContextManager[None]:
        """A context in which a signal interrupts at once."""
        return self._let(0)

    def calling(self) -> contextlib.AbstractContextManager[None]:
        """A context in which the second signal interrupts at once, as the call may never return."""
        return self._let(1)

    def break_off(self, why: str) -> None:
        """From another thread, interrupt the current call with a `RobotError`, if signals are handled."""
        if self._before:
            self._broken_off = why
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    @contextlib.contextmanager
    def _let(self, patience: int) -> Iterator[None]:
        self._patience = patience
        try:
            if not patience:
                self.check()
            yield
        finally:
            self._patience = None

    def _handle(self, number: int, frame) -> None:
        if self._broken_off:
            why, self._broken_off = self._broken_off, ""
            if self._patience is not None:
                self._patience = None
                raise RobotError(why)
            return  # the call has returned, and the loop is about to ask
        self._received.append(number)
        if self._patience is not None and len(self._received) > self._patience:
            self._patience = None  # once only
            self.check()
