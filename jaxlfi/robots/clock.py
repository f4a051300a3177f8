"""Clocks of a control loop: the system's, and a simulated one, which does not wait."""

import time
from typing import Protocol


class Clock(Protocol):
    """A clock that never goes back."""

    def now(self) -> float:
        """Seconds since a fixed moment."""

    def sleep_until(self, moment: float) -> None:
        """Return at that moment, or at once if it has passed."""


class Monotonic:
    """The system's monotonic clock."""

    def now(self) -> float:
        """Seconds since a fixed moment."""
        return time.monotonic()

    def sleep_until(self, moment: float) -> None:
        """Return at that moment, or at once if it has passed."""
        if (left := moment - time.monotonic()) > 0:
            time.sleep(left)


class Simulated:
    """A clock on which sleeping takes no time: for simulated robots, and for tests.

    Example:
        >>> clock = Simulated()
        >>> clock.sleep_until(0.16)
        >>> clock.pass_by(0.02)
        >>> clock.now()
        0.18
    """

    def __init__(self):
        """It begins at 0 s."""
        self._now = 0.0

    def now(self) -> float:
        """Seconds since it was made."""
        return self._now

    def sleep_until(self, moment: float) -> None:
        """Advance to that moment, unless it has passed."""
        self._now = max(self._now, moment)

    def pass_by(self, seconds: float) -> None:
        """Let time pass, as work would."""
        self._now += seconds
