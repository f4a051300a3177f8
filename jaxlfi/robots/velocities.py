"""Velocities of a robot that does not measure them: differences of what it measures, through a low-pass filter.

The difference of two successive measurements over the time between them is the mean velocity between them, half of that
time ago. A first-order low-pass filter of time constant T then takes off noise, and adds a delay of about T. Before
there are two measurements the robot is taken to be at rest.
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
        """Nothing has been measured.

        Args:
            filter: time constant of the low-pass filter, in s; 0 for none.
            turning: whether the signal is an angle, whose difference is the shorter way round.
        """
        self._filter, self._turning = filter, turning
        self._last: tuple[float, float] | None = None
        self._velocity: float | None = None

    def __call__(self, time: float, value: float) -> float:
        """The velocity when a sample was taken; of one that is not known, or no later one, that of the last."""
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
    """By how much an estimate is late if the velocity changes steadily, in s.

    Args:
        interval: between two samples, in s.
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
        filter: time constant, in s.
        turning: whether the signal is an angle that may wrap after a turn.
    """

    of: str
    filter: float
    turning: bool = False


class WithVelocities:
    """A robot with velocities that are estimated (`jaxlfi.robots.robot.Robot`)."""

    def __init__(self, robot: Robot, clock: Clock, signals: Sequence[str], estimated: Mapping[str, Estimated]):
        """Nothing has been measured.

        Args:
            robot: which gives the signals that are not estimated, in their order.
            clock: the loop's, by which measurements have an age.
            signals: of an observation, in their order.
            estimated: by name, some of the signals; each the derivative of one that is not.
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
