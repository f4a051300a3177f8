"""A watchdog: when a call of the robot or the policy hangs, the robot is stopped from another thread.

While a loop waits for a call to return, it cannot command anything. The watchdog's thread then calls the robot's
`stop`, and interrupts the call if a signal can (a sleep, a read from a socket or a serial port). With a simulated clock
there is no thread: calls that take too long by that clock are detected when they return.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

from jaxlfi.robots.clock import Clock, Simulated
from jaxlfi.robots.interrupts import Interrupts
from jaxlfi.robots.robot import RobotError

LOOKS = 10
"""Number of times that the thread checks within the time limit of a call."""
PATIENCE = 5.0
"""Longest wait for a stop that the watchdog has begun, in s."""


class Stop:
    """A robot's stop, which several threads may request and which is called exactly once."""

    def __init__(self, stop: Callable[[], None]):
        """No stop has been requested yet."""
        self._stop, self._lock, self._ended = stop, threading.Lock(), threading.Event()
        self._failed: Exception | None = None

    def __call__(self) -> None:
        """Stop the robot, or wait until it is stopped.

        Raises:
            RobotError: if another thread's call of it does not return.
        """
        if not self._lock.acquire(blocking=False):
            if not self._ended.wait(PATIENCE):
                raise RobotError(f"no answer to stop in {PATIENCE:g} s")
            if self._failed is not None:
                raise self._failed
            return
        try:
            self._stop()
        except Exception as error:
            self._failed = error
            raise
        finally:
            self._ended.set()


class Watchdog:
    """Watches the calls of a loop.

    Its thread runs while the context is entered.
    """

    def __init__(self, seconds: float | None, stop: Stop, clock: Clock, interrupts: Interrupts):
        """It does not watch yet.

        Args:
            seconds: time limit of a call, in s; None for none.
            stop: stop of the robot.
            clock: clock of the loop.
            interrupts: interrupts of the loop, which interrupt a call.
        """
        self._seconds, self._stop, self._clock, self._interrupts = seconds, stop, clock, interrupts
        self._due: tuple[float, str] | None = None
        self._bit = ""
        self._end = threading.Event()
        by_thread = seconds is not None and not isinstance(clock, Simulated)
        self._thread = threading.Thread(target=self._watch, daemon=True) if by_thread else None

    def __enter__(self) -> "Watchdog":
        """Begin to watch."""
        if self._thread is not None:
            self._thread.start()
        return self

    def __exit__(self, kind, error, trace) -> None:
        """Stop watching."""
        self._end.set()
        if self._thread is not None:
            self._thread.join(PATIENCE)

    @contextlib.contextmanager
    def watching(self, what: str, more: float = 0.0) -> Iterator[None]:
        """A context in which a call is watched.

        Args:
            what: name of the call, for errors.
            more: additional time that it may take, in s, such as for waiting.

        Raises:
            RobotError: if the call took too long.
        """
        if self._seconds is None:
            yield
            return
        began = self._clock.now()
        self._due = time.monotonic() + self._seconds + more, what
        try:
            yield
        except Exception as error:
            if self._bit:
                raise RobotError(self._bit) from error
            raise
        finally:
            self._due = None
        if not self._bit and self._clock.now() - began > self._seconds + more:
            self._bit = self._why(what)
        if self._bit:
            raise RobotError(self._bit)

    def _why(self, what: str) -> str:
        return f"robot: {what} took longer than the {self._seconds:g} s of the watchdog, which stopped it"

    def _watch(self) -> None:
        while not self._end.wait((self._seconds or 0.0) / LOOKS):
            due = self._due
            if due is not None and time.monotonic() > due[0]:
                self._bit = self._why(due[1])
                with contextlib.suppress(Exception):  # kept, and raised when the loop stops the robot
                    self._stop()
                self._interrupts.break_off(self._bit)
                return
