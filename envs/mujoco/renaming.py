"""What a task's file says of a recording's signals: their names in the model, and units that the recording lacks.

[signals]
"q1" = "joint/shoulder/qpos"                             # by its name in the recording
"tau1" = { name = "actuator/shoulder", unit = "mN m" }    # overrides the recording's
"arm angle" = { unit = "deg" }                           # if the recording has none
time = { unit = "ms" }                                   # of times
"spare" = false                                          # is not read
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from jaxlfi.envs.mujoco.log_files import TIME, Recorded
from jaxlfi.envs.mujoco.parameters import near
from jaxlfi.io.units import parse


class Called(NamedTuple):
    """What a signal is called, and its unit.

    Attributes:
        name: in the model; None for its own.
        unit: in place of the recording's, or without a name where the recording says none; None for its own.
        read: whether it is.
    """

    name: str | None = None
    unit: str | None = None
    read: bool = True


def table_of(config: Mapping[str, Any]) -> dict[str, Called]:
    """The table `signals` of a task's file, by the names of the recording.

    Raises:
        ValueError: for other entries, and units that are not known, in one line.
    """
    found = {}
    for name, value in config.get("signals", {}).items():
        where = f"signals: {name!r}"
        if value is False:
            found[name] = Called(read=False)
            continue
        given = {"name": value} if isinstance(value, str) else value
        if not isinstance(given, dict) or not given or not given.keys() <= {"name", "unit"}:
            raise ValueError(f"{where}: expected a name, {{ name = NAME, unit = UNIT }} or false, got {value!r}")
        if wrong := [one for one in given.values() if not isinstance(one, str) or not one]:
            raise ValueError(f"{where}: expected words in quotes, got {wrong[0]!r}")
        try:
            parse(given.get("unit", ""))
        except ValueError as error:
            raise ValueError(f"{where}: unit: {error}") from error
        found[name] = Called(given.get("name"), given.get("unit"))
    return found


def renamed(several: Sequence[Recorded], called: Mapping[str, Called]) -> list[Recorded]:
    """Recordings with other names and units for some of their signals.

    A recording that has a signal by its new name already, as one that `jaxlfi design` planned, keeps it.

    Args:
        several: recordings.
        called: by their names; "time" is of the times, where no signal is called so.

    Raises:
        ValueError: for names that no recording has, and two signals that get one name, in one line.
    """
    known = {name for one in several for name in one.signals} | {TIME}
    for name, (new, _, read) in called.items():
        if read and not {name, new, str(new).removeprefix("actuator/").removeprefix("sensor/")} & known:
            raise ValueError(f"signals: expected a signal of the recordings {near(name, sorted(known))}, got {name!r}")
    return [_renamed(one, called) for one in several]


def _renamed(one: Recorded, called: Mapping[str, Called]) -> Recorded:
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
    return dataclasses.replace(one, signals=signals, units=units)
