"""Velocities of a robot that does not measure them: low-pass filtered differences of its measurements.

The difference of two successive measurements, divided by the time between them, is the mean velocity between them, and
lags by half of that time. A first-order low-pass filter of time constant T then reduces noise, and adds a delay of
about T. Before the second measurement, the robot is taken to be at rest.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from jaxlfi.robots.clock import Clock
from jaxlfi.robots.robot import Command, Observation, Robot


class Differences:
    """The derivative of a signal, from one sample to the next.

    Example:
        >>> estimate = Differences(filter=0.0)
        >>> [round(estimate(time, 3.0 * time), 6) for time in (0.0, 0.1, 0.25)]
        [0.0, 3.0, 3.0]
    """

    def __init__(self, filter: float, turning: bool = False):
        """Nothing has been measured yet.

        Args:
            filter: time constant of the low-pass filter, in s; 0 for none.
            turning: whether the signal is an angle, whose difference is the shorter way round.
        """
        self._filter, self._turning = filter, turning
        self._last: tuple[float, float] | None = None
        self._velocity: float | None = None

    def __call__(self, time: float, value: float) -> float:
        """The velocity at a sample; for a sample that is unknown or not later than the last, the last velocity."""
        if self._last is None or time <= self._last[0] or not math.isfinite(value):
            if self._last is None and math.isfinite(value):
                self._last = time, value
            return self._velocity or 0.0
        before, last = self._last
        difference = math.remainder(value - last, 2 * math.pi) if self._turning else value - last
        raw, passed = difference / (time - before), time - before
        part = 1.0 if self._velocity is None or not self._filter else 1 - math.exp(-passed / self._filter)
        self._velocity = (self._velocity or 0.0) + part * (raw - (self._velocity or 0.0))
        self._last = time, value
        return self._velocity


def lag(interval: float, filter: float) -> float:
    """The delay of an estimate if the velocity changes at a constant rate, in s.

    Args:
        interval: time between two samples, in s.
        filter: time constant of the low-pass filter, in s; 0 for none.

    Example:
        >>> estimate = Differences(filter=0.05)
        >>> velocity = [estimate(time, time**2) for time in np.arange(0.0, 3.0, 0.1)][-1]     # of 2 t
        >>> [round(float(2.9 - velocity / 2), 6), round(lag(0.1, 0.05), 6)]
        [0.065652, 0.065652]
    """
    return interval / 2 + (interval / math.expm1(interval / filter) if filter else 0.0)


@dataclasses.dataclass(frozen=True)
class Estimated:
    """How a velocity is estimated.

    Attributes:
        of: the signal that is differentiated.
        filter: time constant of the low-pass filter, in s.
        turning: whether the signal is an angle that may wrap after a turn.
    """

    of: str
    filter: float
    turning: bool = False


class WithVelocities:
    """A robot with estimated velocities (`jaxlfi.robots.robot.Robot`)."""

    def __init__(self, robot: Robot, clock: Clock, signals: Sequence[str], estimated: Mapping[str, Estimated]):
        """Nothing has been measured yet.

        Args:
            robot: robot that gives the signals that are not estimated, in their order.
            clock: clock of the loop, from which measurements are dated by their age.
            signals: signals of an observation, in their order.
            estimated: estimated signals by name, each the derivative of one that is measured.
        """
        self._robot, self._clock, self._signals = robot, clock, tuple(signals)
        self._measured = {name: i for i, name in enumerate(one for one in signals if one not in estimated)}
        self._of = {name: one.of for name, one in estimated.items()}
        self._estimates = {name: Differences(one.filter, one.turning) for name, one in estimated.items()}

    def observe(self) -> Observation | None:
        """The latest observation, with velocities."""
        found = self._robot.observe()
        if found is None:
            return None
        taken = self._clock.now() - found.age
        values = {name: float(found.values[place]) for name, place in self._measured.items()}
        values |= {name: estimate(taken, values[self._of[name]]) for name, estimate in self._estimates.items()}
        return dataclasses.replace(found, values=np.array([values[name] for name in self._signals]))

    def act(self, command: Command) -> None:
        """As the robot does."""
        self._robot.act(command)

    def stop(self) -> None:
        """As the robot does."""
        self._robot.stop()
