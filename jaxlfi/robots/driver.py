"""A driver: the interface of your own robot to any policy, a class with four methods.

    class Driver:
        def connect(self, signals, controls): ...     # names and units that a policy needs; refuse what there is not
        def observe(self): ...                        # what was measured last, by name, at once
        def act(self, controls): ...                  # controls by actuator; return at once
        def stop(self): ...                           # come to rest; called exactly once, last

`jaxlfi control POLICY --robot module:Driver` drives it; `jaxlfi.robots.server.serve_driver` serves it to a loop in
another process, `SocketDriver` is the other end of that.
"""

import dataclasses
import json
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np

from jaxlfi.io import units
from jaxlfi.io.serialise import json_safe
from jaxlfi.robots.clock import Clock
from jaxlfi.robots.robot import Command, Observation, RobotError

DONE = "controls"
"""Name of another controller's controls in the extras of an observation."""


@runtime_checkable
class Driver(Protocol):
    """A robot with named signals and actuators. If a method raises any exception, the robot is stopped.

    Only `connect` may block for long. A robot should stop by itself when no command arrives. A simulated robot may have
    a `simulated_clock`, which the loop then uses; a real one must not.
    """

    def connect(self, signals: Mapping[str, str], controls: Mapping[str, str]) -> Mapping[str, Any] | None:
        """Prepare the robot, or raise an error.

        Args:
            signals: names of the signals to measure, with the units to report them in.
            controls: names of the actuators, with the units of their commands; empty if the robot is only to be
                watched, and neither moved nor held.

        Returns:
            Information about the robot to record, as JSON values; None for nothing.
        """

    def observe(self) -> Observation | Mapping[str, float] | None:
        """The latest measurements by name, or None if there are none.

        An `Observation` with `values` by name also states when they were measured; plain numbers count as measured now.
        An unknown number is NaN. Further numbers are ignored.
        """

    def act(self, controls: Mapping[str, float]) -> None:
        """Command the actuators, until the next call."""

    def stop(self) -> None:
        """Come to rest, whatever happened before. May be called from another thread while another method hangs."""


@dataclasses.dataclass(frozen=True)
class Called:
    """A driver's name for a signal or an actuator, and how its numbers relate to the task's.

    The task's number is `scale` times the driver's, in the task's unit, plus `offset`.

    Attributes:
        name: name that the driver uses.
        unit: unit of the driver's numbers; "" for the task's.
        scale: factor, such as -1 for an axis that points the other way.
        offset: offset in the task's unit, such as the angle at which an encoder reads zero.

    Raises:
        ValueError: for an unknown unit, and a scale of zero.
    """

    name: str
    unit: str = ""
    scale: float = 1.0
    offset: float = 0.0

    def __post_init__(self):
        units.parse(self.unit)
        if not self.scale:
            raise ValueError(f"{self.name}: expected a scale other than 0, got 0")

    def factors(self, unit: str) -> tuple[float, float]:
        """Factor and offset from the driver's numbers to the task's.

        Args:
            unit: unit of the task's numbers; "" if it is not known.

        Raises:
            ValueError: for units of different quantities.

        Example:
            >>> Called("pan", "deg", scale=-1.0, offset=0.5).factors("rad")[0].__round__(5)
            -0.01745
        """
        if not self.unit:
            return self.scale, self.offset
        own, other = units.parse(self.unit), units.parse(unit)
        if unit and own.name != other.name:
            raise ValueError(f"{self.name}: expected a unit of {other.name}, got {self.unit}")
        factor = self.scale / other.factor
        return factor * own.factor, factor * (own.offset - other.offset) + self.offset


class Driven:
    """A driver as a robot, whose numbers are ordered (`jaxlfi.robots.robot.Robot`).

    Attributes:
        about: the driver's information about itself.
    """

    def __init__(
        self,
        driver: Driver,
        signals: Mapping[str, str],
        controls: Mapping[str, str],
        called: Mapping[str, Called] | None = None,
        watching: bool = False,
    ):
        """Connect.

        Args:
            driver: driver of the robot, which is stopped if it cannot be connected.
            signals: names and units of the numbers of an observation, in their order.
            controls: names and units of the controls, likewise.
            called: the driver's names of signals and actuators, where they differ from the task's.
            watching: another controller commands the robot, and its controls are observed as well.

        Raises:
            ValueError: for incompatible units.
        """
        self._driver, self._watching, self._number = driver, watching, -1
        try:
            self.about = self._connect(signals, controls, called or {})
        except BaseException:
            driver.stop()
            raise
        clock = getattr(driver, "simulated_clock", None)
        if clock is not None:
            self.simulated_clock: Clock = clock

    def _connect(
        self, signals: Mapping[str, str], controls: Mapping[str, str], called: Mapping[str, Called]
    ) -> dict[str, Any]:
        known = {name: called.get(name, Called(name)) for name in {**signals, **controls}}

        def rows(several: Mapping[str, str]) -> dict[str, tuple[str, float, float]]:
            return {name: (known[name].name, *known[name].factors(unit)) for name, unit in several.items()}

        self._signals, self._controls = rows(signals), rows(controls)
        asked, given = (
            {known[name].name: known[name].unit or unit for name, unit in several.items()}
            for several in (signals, controls)
        )
        if self._watching:  # if a signal has the same name, it is ambiguous
            for name, (own, factor, offset) in self._controls.items():
                self._controls[name] = ("" if own in asked else own), factor, offset
            asked, given = {**asked, **given, **asked}, {}
        about = self._driver.connect(asked, given) or {}
        try:
            json.dumps(json_safe(about), allow_nan=False)
            return dict(about)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"robot: expected a mapping for JSON as information about itself, got {str(about)[:60]}"
            ) from error

    def observe(self) -> Observation | None:
        """The latest observation, in the order of the signals."""
        found = self._driver.observe()
        if found is None:
            return None
        if not isinstance(found, Observation):
            self._number += 1
            found = Observation(found, self._number)
        if not isinstance(found.values, Mapping):
            raise RobotError(f"robot: expected numbers by name from observe, got {type(found.values).__name__}")
        values = _numbers(found.values, self._signals)
        if not self._watching:
            target = None if found.target is None else _numbers(found.target, self._controls)
            return dataclasses.replace(found, values=values, target=target)
        done = _numbers(found.values, self._controls, needed=False)
        return dataclasses.replace(found, values=values, target=done, extras={**found.extras, DONE: done})

    def act(self, command: Command) -> None:
        """Command the actuators from now on, unless the robot is only watched."""
        if not self._watching:
            parts = zip(self._controls.values(), command.target, strict=True)
            self._driver.act({name: float((value - offset) / factor) for (name, factor, offset), value in parts})

    def stop(self) -> None:
        """Come to rest, or stop watching."""
        self._driver.stop()


def _numbers(values: Any, wanted: Mapping[str, tuple[str, float, float]], needed: bool = True) -> np.ndarray:
    """Numbers in the wanted order, in the task's units."""
    if not isinstance(values, Mapping):
        raise RobotError(f"robot: expected numbers by name, got {type(values).__name__}")
    if needed and (missing := [name for name, _, _ in wanted.values() if name not in values]):
        raise RobotError(f"robot: expected a number of each signal, got none of {', '.join(missing)}")
    try:
        own = np.array([float(values.get(name, np.nan)) for name, _, _ in wanted.values()])
    except (TypeError, ValueError) as error:
        raise RobotError(f"robot: expected numbers by name, got others: {error}") from error
    factors = np.array([[factor, offset] for _, factor, offset in wanted.values()]).reshape(-1, 2)
    return factors[:, 0] * own + factors[:, 1]
