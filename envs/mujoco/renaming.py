"""What a task's file says of a recording's signals: names in the model, units that the recording lacks, and signs.

[signals]
"q1" = "joint/shoulder/qpos"                             # by its name in the recording
"tau1" = { name = "actuator/shoulder", unit = "mN m" }    # overrides the recording's
"arm angle" = { unit = "deg" }                           # if the recording has none
"q2" = { name = "elbow angle", scale = -1.0, offset = 0.5 }  # counts the other way round, from another zero
time = { unit = "ms" }                                   # of times
"spare" = false                                          # is not read
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from jaxlfi.envs.mujoco.log_files import TIME, Recorded
from jaxlfi.envs.mujoco.parameters import near
from jaxlfi.envs.mujoco.plausible import say
from jaxlfi.io.units import is_unit, parse

WORDS, NUMBERS = ("name", "unit"), ("scale", "offset")
"""Keys of an entry."""


class Called(NamedTuple):
    """What a signal is called, its unit, and how its numbers relate to the model's.

    The model's number is `scale` times the recorded one, in the model's unit, plus `offset`, as in
    `jaxlfi.robots.driver.Called`.

    Attributes:
        name: in the model; None for its own.
        unit: with a name, in place of the recording's; without one, if the recording has none; None for its own.
        read: whether the signal is read.
        scale: such as -1 for an axis that points the other way.
        offset: in the model's unit, such as the angle of an encoder's zero.
    """

    name: str | None = None
    unit: str | None = None
    read: bool = True
    scale: float = 1.0
    offset: float = 0.0

    @property
    def rescales(self) -> bool:
        """Whether the model's number differs from the recorded one in the same unit."""
        return (self.scale, self.offset) != (1.0, 0.0)


def table_of(config: Mapping[str, Any]) -> dict[str, Called]:
    """The table `signals` of a task's file, by the names of the recording.

    Raises:
        ValueError: for invalid entries, and unknown units, in one line.
    """
    found = {}
    for name, value in config.get("signals", {}).items():
        where = f"signals: {name!r}"
        if value is False:
            found[name] = Called(read=False)
            continue
        given = {"name": value} if isinstance(value, str) else value
        if not isinstance(given, dict) or not given or not given.keys() <= {*WORDS, *NUMBERS}:
            raise ValueError(
                f"{where}: expected a name, {{ name = NAME, unit = UNIT, scale = NUMBER, offset = NUMBER }} or false, "
                f"got {value!r}"
            )
        found[name] = _called(name, given, where)
    return found


def _called(name: str, given: Mapping[str, Any], where: str) -> Called:
    if wrong := [given[key] for key in WORDS if key in given and (not isinstance(given[key], str) or not given[key])]:
        raise ValueError(f"{where}: expected words in quotes, got {wrong[0]!r}")
    try:
        parse(given.get("unit", ""))
    except ValueError as error:
        raise ValueError(f"{where}: unit: {error}") from error
    for key in NUMBERS:
        number = given.get(key, 1.0)
        if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number):
            raise ValueError(f"{where}: {key}: expected a number, got {number!r}")
    if not given.get("scale", 1.0):
        raise ValueError(f"{where}: scale: expected another number than 0, got 0")
    return Called(**given)


def renamed(several: Sequence[Recorded], called: Mapping[str, Called]) -> list[Recorded]:
    """Recordings with other names and units for some of their signals.

    A recording that has a signal by its new name already, as one that `jaxlfi design` planned, keeps it. One that
    jaxlfi recorded is in the model's names and numbers, and keeps them.

    Args:
        several: recordings.
        called: entries by the signals' names; "time" is for the times, unless a signal has that name.

    Raises:
        ValueError: for names that no recording has, two signals that get one name, and times that would be scaled, in
            one line.
    """
    known = {name for one in several for name in one.signals} | {TIME}
    for name, own in called.items():
        new = str(own.name or name)
        if own.read and not {name, new, new.removeprefix("actuator/").removeprefix("sensor/")} & known:
            raise ValueError(f"signals: expected a signal of the recordings {near(name, sorted(known))}, got {name!r}")
    return [_renamed(one, called) for one in several]


def _renamed(one: Recorded, called: Mapping[str, Called]) -> Recorded:
    if one.by_us:
        called = _without_changes(one, called)
    own = lambda name: called.get(name, Called())
    names = {name: own(name).name or name for name in one.signals if own(name).read}
    for new in names.values():
        if len(both := [name for name, other in names.items() if other == new]) > 1:
            raise ValueError(f"{one.name}: signals: expected one signal called {new}, got {' and '.join(both)}")
    signals = {new: one.signals[name] for name, new in names.items()}
    units = {
        names.get(name, name): own(name).unit or unit if own(name).name or not unit else unit
        for name, unit in one.units.items()
        if own(name).read
    }
    return dataclasses.replace(one, signals=signals, units=units, scales=_scales(one, names, units, called))


def _without_changes(one: Recorded, called: Mapping[str, Called]) -> dict[str, Called]:
    """The entries of signals that are not to be read; a line reports those that are not rescaled."""
    scaled = [name for name in one.signals if name in called and called[name].rescales]
    if scaled:
        say(
            f"{one.name}: {', '.join(scaled)}: scale and offset of [signals] are not applied, as the report beside the "
            "recording says that jaxlfi recorded it, in the model's numbers"
        )
    return {name: own for name, own in called.items() if not own.read}


def _scales(
    one: Recorded, names: Mapping[str, str], units: Mapping[str, str], called: Mapping[str, Called]
) -> dict[str, tuple[float, float]]:
    """Factors and offsets, by the new names, of signals that differ from the model's."""
    found = {}
    for name in called:
        if not called[name].rescales:
            continue
        scale, offset = called[name].scale, called[name].offset
        if name not in one.signals:
            if name == TIME:
                raise ValueError(f"signals: {name!r}: expected a unit only, got a scale or an offset of times")
            continue
        suffix = name.rpartition("_")[2]
        if offset and not units.get(names[name]) and len(suffix) > 1 and is_unit(suffix):
            raise ValueError(
                f"signals: {name!r}: offset: expected an explicit name and unit, since this column's unit is known "
                "only from its name; got no unit"
            )
        found[names[name]] = scale, offset
    return found
