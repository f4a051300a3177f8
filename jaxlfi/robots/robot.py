"""The interface of a robot that a policy can control."""

import dataclasses
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np


class RobotError(OSError):
    """A robot, or the way to it, failed."""


@dataclasses.dataclass(frozen=True)
class Observation:
    """What a robot has measured last.

    Attributes:
        values: numbers in the order and the units of the policy's schema, NaN where one is unknown, shape [O]; or by
            name, of a driver (`jaxlfi.robots.driver`).
        number: of the measurement; larger for a later one.
        age: time since it was made, in s, so that no two clocks need to agree.
        target: where the set-points are, shape [A], or by name, if the robot knows; else they are taken to be at the
            measured positions before the first command.
        extras: what else is to be logged, by name; the same names in every observation.
    """

    values: Any
    number: int
    age: float = 0.0
    target: Any = None
    extras: Mapping[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Command:
    """Where the set-points are to go within one control period.

    Attributes:
        slot: control period since the beginning, from 0 on.
        displacement: of the set-points, shape [A]; zero where they are to be held.
        target: where they are to be then, shape [A]. Who follows it does not drift from the loop if a command is lost.
    """

    slot: int
    displacement: np.ndarray
    target: np.ndarray


@runtime_checkable
class Robot(Protocol):
    """A robot with its sensors. Methods raise `RobotError`, or whatever they like, upon which the robot is stopped.

    None may block for long: while one does, nothing else is commanded. A robot should hold by itself, or stop, when no
    command comes. It may have an attribute `about`, a mapping of what is to be recorded of it; one that is simulated,
    and no arm that moves, may have a `simulated_clock`, on which `jaxlfi whip control` then waits.
    """

    def observe(self) -> Observation | None:
        """The latest observation, at once; None where there is none."""

    def act(self, command: Command) -> None:
        """Begin to move the set-points; return at once."""

    def stop(self) -> None:
        """Stop moving; called exactly once, last."""
