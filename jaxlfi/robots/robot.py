"""The interface of a robot that a policy can control."""

import dataclasses
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np


class RobotError(OSError):
    """A robot, or the connection to it, failed."""


@dataclasses.dataclass(frozen=True)
class Observation:
    """A robot's latest measurement.

    Attributes:
        values: numbers in the order and the units of the policy's schema, NaN where one is unknown, shape [O]; or by
            name, from a driver (`jaxlfi.robots.driver`).
        number: number of the measurement; larger for a later one.
        age: time since the measurement, in s, so that no two clocks need to agree.
        target: current set-points, shape [A], or by name, if the robot knows them; else they are taken to be the
            measured positions before the first command.
        extras: further data to be logged, by name; the same names in every observation.
    """

    values: Any
    number: int
    age: float = 0.0
    target: Any = None
    extras: Mapping[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Command:
    """Set-points to be reached within one control period.

    Attributes:
        slot: index of the control period, from 0.
        displacement: displacement of the set-points, shape [A]; zero where they are to be held.
        target: set-points after it, shape [A]. A robot that follows them does not drift from the loop if a command is
            lost.
    """

    slot: int
    displacement: np.ndarray
    target: np.ndarray


@runtime_checkable
class Robot(Protocol):
    """A robot with its sensors. If a method raises `RobotError` or any other exception, the robot is stopped.

    No method may block for long: while one does, nothing else is commanded. A robot should hold or stop by itself when
    no command arrives. It may have an attribute `about`, a mapping of information to record. A simulated robot, but no
    arm that moves, may have a `simulated_clock`, on which `jaxlfi whip control` then waits.
    """

    def observe(self) -> Observation | None:
        """The latest observation, at once; None if there is none."""

    def act(self, command: Command) -> None:
        """Begin to move the set-points; return at once."""

    def stop(self) -> None:
        """Stop moving; called exactly once, last."""
