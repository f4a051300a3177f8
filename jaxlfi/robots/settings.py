"""Settings of a robot: the table `robot` of a task file, which policies trained from it carry with them.

[robot]
watchdog = 0.1                      # time limit of a driver call, in s, after which the robot is stopped
holds = 3                           # control periods in a row without a usable observation; then the robot is stopped
max_age = 0.02                      # largest age of an observation, in s; by default a control period
record = ["tip"]                    # signals that inference needs and the policy does not see
ignored_terminations = ["fallen"]   # not ending episodes here, as the robot does not measure them
units = { tip = "m" }               # units of signals that the policy does not see; those of a MuJoCo model are known

[robot.limits]                      # limits of signals, such as the workspace, beyond which the robot is stopped
"arm angle" = [-2.0, 2.0]

[robot.controls]                    # within the limits that the policy was trained with
motor = { limits = [-0.04, 0.04], rate = 2.0 }      # limits of the control, and of its change per second

[robot.velocities]                  # estimated, where the robot does not measure them
"joint/arm/qvel" = { of = "arm angle", filter = 0.02 }      # time constant of a low-pass filter, in s

[robot.names]                       # the driver's names and units of signals and actuators
"arm angle" = { name = "shoulder_pan.pos", unit = "deg", scale = -1.0, offset = 0.5 }
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from jaxlfi.io import units
from jaxlfi.robots.driver import Called

KEY = "robot"
"""Key of the settings in a policy's schema and in a task's file."""


@dataclasses.dataclass(frozen=True)
class Velocity:
    """A signal that is estimated from another one, as its derivative.

    Attributes:
        of: the signal that is differentiated.
        filter: time constant of the low-pass filter in s; None for half a control period.
    """

    of: str
    filter: float | None = None


@dataclasses.dataclass(frozen=True)
class Settings:
    """The table `robot`; see above.

    Attributes:
        limits: smallest and largest allowed value by signal.
        controls: limits and rate by actuator, None where the policy's are kept.
        velocities: estimated velocities, by the name of the signal.
        names: the driver's names and units, by the task's names.
        record: further signals to record.
        units: units of signals that policies do not see.
        watchdog: time limit of a driver call, in s.
        holds: largest number of consecutive control periods without a usable observation.
        max_age: largest age of an observation, in s.
        ignored_terminations: names of terminations that do not end episodes on this robot.
    """

    limits: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    controls: Mapping[str, tuple[tuple[float, float] | None, float | None]] = dataclasses.field(default_factory=dict)
    velocities: Mapping[str, Velocity] = dataclasses.field(default_factory=dict)
    names: Mapping[str, Called] = dataclasses.field(default_factory=dict)
    record: tuple[str, ...] = ()
    units: Mapping[str, str] = dataclasses.field(default_factory=dict)
    watchdog: float | None = None
    holds: int | None = None
    max_age: float | None = None
    ignored_terminations: tuple[str, ...] = ()

    @property
    def further(self) -> tuple[str, ...]:
        """Signals that are measured even if a policy does not see them."""
        sources = (one.of for one in self.velocities.values())
        return tuple(dict.fromkeys((*self.limits, *self.record, *sources)))


def of_table(table: Mapping[str, Any]) -> Settings:
    """The settings in a table.

    Raises:
        ValueError: for unknown keys and invalid values, in one line.

    Example:
        >>> of_table({"limits": {"arm angle": [-2, 2]}}).limits
        {'arm angle': (-2.0, 2.0)}
    """
    kinds = {one.name for one in dataclasses.fields(Settings)}
    _keys(table, kinds, "robot")
    found: dict[str, Any] = {"limits": _each(table, "limits", _pair)}
    found["controls"] = _each(table, "controls", _control)
    found["velocities"] = _each(table, "velocities", _velocity)
    found["names"] = _each(table, "names", _called)
    found["units"] = _each(table, "units", _unit)
    for name in ("watchdog", "max_age"):
        if name in table:
            found[name] = _number(table[name], f"robot: {name}", above=0.0)
    if "holds" in table:
        if isinstance(table["holds"], bool) or not isinstance(table["holds"], int) or table["holds"] < 0:
            raise ValueError(f"robot: holds: expected a whole number of at least 0, got {table['holds']!r}")
        found["holds"] = table["holds"]
    for key, what in {"record": "signals", "ignored_terminations": "terminations"}.items():
        found[key] = _names(table.get(key, []), key, what)
    return Settings(**found)


def _names(value: Any, key: str, what: str) -> tuple[str, ...]:
    if not isinstance(value, Sequence) or isinstance(value, str) or not all(isinstance(one, str) for one in value):
        raise ValueError(f"robot: {key}: expected names of {what}, got {value!r}")
    return tuple(value)


def _each(table: Mapping[str, Any], key: str, of: Callable[[Any, str], Any]) -> dict[str, Any]:
    found = table.get(key, {})
    if not isinstance(found, Mapping):
        raise ValueError(f"robot: {key}: expected a table, got {found!r}")
    return {name: of(value, f"robot: {key}: {name}") for name, value in found.items()}


def _keys(table: Any, known: set[str], where: str) -> None:
    if not isinstance(table, Mapping):
        raise ValueError(f"{where}: expected a table, got {table!r}")
    if unknown := sorted(set(table) - known):
        raise ValueError(f"{where}: expected keys among {', '.join(sorted(known))}, got {', '.join(unknown)}")


def _number(value: Any, where: str, above: float = -math.inf) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not above < value < math.inf:
        raise ValueError(f"{where}: expected a number{'' if above < 0 else f' above {above:g}'}, got {value!r}")
    return float(value)


def _pair(value: Any, where: str) -> tuple[float, float]:
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise ValueError(f"{where}: expected [LOW, HIGH], got {value!r}")
    low, high = (_number(one, where) for one in value)
    if not low < high:
        raise ValueError(f"{where}: expected LOW below HIGH, got {value!r}")
    return low, high


def _control(value: Any, where: str) -> tuple[tuple[float, float] | None, float | None]:
    _keys(value, {"limits", "rate"}, where)
    limits = _pair(value["limits"], f"{where}: limits") if "limits" in value else None
    return limits, _number(value["rate"], f"{where}: rate", above=0.0) if "rate" in value else None


def _velocity(value: Any, where: str) -> Velocity:
    _keys(value, {"of", "filter"}, where)
    if not isinstance(value.get("of"), str):
        raise ValueError(f"{where}: expected the signal that it is the derivative of, as of = NAME, got {value!r}")
    seconds = value.get("filter")
    if seconds is not None and _number(seconds, f"{where}: filter") < 0:
        raise ValueError(f"{where}: filter: expected at least 0 s, got {seconds!r}")
    return Velocity(value["of"], None if seconds is None else float(seconds))


def _unit(value: Any, where: str) -> str:
    if not isinstance(value, str) or not units.is_unit(value):
        raise ValueError(f"{where}: expected a unit such as rad, deg/s, mm, N m or ms, got {value!r}")
    return value


def _called(value: Any, where: str) -> Called:
    _keys(value, {"name", "unit", "scale", "offset"}, where)
    texts = {key: value[key] for key in ("name", "unit") if key in value}
    if "name" not in value or not all(isinstance(text, str) for text in texts.values()):
        raise ValueError(f"{where}: expected name = NAME of the driver and its unit, got {value!r}")
    numbers = {key: _number(value[key], f"{where}: {key}") for key in ("scale", "offset") if key in value}
    try:
        return Called(texts["name"], texts.get("unit", ""), **numbers)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
