"""Recordings: controls and sensors over time, by name, in SI units and radians.

`log_files` says which files are read. Units are those of `jaxlfi.io.units`. Signals may have clocks of their own: in a
table, a row then has empty cells (NaN) where a signal has no sample. Times may begin anywhere; they are counted from
the first one.
"""

import dataclasses
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxlfi.envs.mujoco import log_files
from jaxlfi.envs.mujoco.log_files import TIME, Recorded
from jaxlfi.io import clocks
from jaxlfi.io.units import Unit, parse

NANOSECONDS = (1e6, 1e9)
"""Intervals between integers that are taken for nanoseconds, as recorders use them, unless a unit is given."""


class RecordingWarning(UserWarning):
    """A recording is changed as it is read, or looks wrong."""


@dataclasses.dataclass(frozen=True, eq=False)
class Log:
    """A recording, which is converted to SI units and radians when it is made.

    Attributes:
        times: in s from the first one, increasing, shape [T]. They may be given in the unit that `units` says, or as
            NumPy's datetime64.
        signals: by name, NaN where there is no sample, shape [T] each.
        name: of the file.
        units: of signals and, as "time", of times, if known: first those of the given numbers, then SI units.

    Raises:
        ValueError: for what is not a recording, and units that are not known.

    Example:
        >>> log = Log([0, 10, 20], {"angle": [0.0, 90.0, 180.0]}, units={"time": "ms", "angle": "deg"})
        >>> float(log.times[-1]), log.signals["angle"].round(3).tolist(), log.units["angle"]
        (0.02, [0.0, 1.571, 3.142], 'rad')
    """

    times: Float[np.ndarray, " time"]
    signals: Mapping[str, Float[np.ndarray, " time"]]
    name: str = "log"
    units: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        given = {name: self._unit(name, text) for name, text in self.units.items()}
        of_times = parse("") if TIME in self.signals else given.pop(TIME, parse(""))
        times, clock = _seconds(np.asarray(self.times), of_times, self.name)
        signals = {}
        for name, recorded in self.signals.items():
            values = np.asarray(recorded, float)
            if values.shape != times.shape:
                raise ValueError(
                    f"{self.name}: {name}: expected a sample for each of {len(times)} times, got {list(values.shape)}"
                )
            if np.isinf(values).any() or np.isnan(values).all():
                raise ValueError(f"{self.name}: {name}: expected finite samples, got infinite ones or none at all")
            unit = given.get(name, parse(""))
            signals[name] = unit.factor * values + unit.offset
        known = ({} if TIME in signals else {TIME: clock}) | {name: unit.name for name, unit in given.items()}
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "signals", signals)
        object.__setattr__(self, "units", {name: unit for name, unit in known.items() if unit})

    def _unit(self, name: str, text: str) -> Unit:
        try:
            return parse(text)
        except ValueError as error:
            raise ValueError(f"{self.name}: {name}: {error}") from error

    def samples(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Times and values of a signal's samples."""
        there = np.flatnonzero(np.isfinite(self.signals[name]))
        return self.times[there], self.signals[name][there]

    def held(self, name: str, times: np.ndarray) -> np.ndarray:
        """The last sample of a signal at other times, or its first before that; shape of `times`."""
        since, values = self.samples(name)
        last = np.searchsorted(since, times + 1e-9, side="right") - 1
        return values[np.maximum(last, 0)]

    def mean_held(self, name: str, times: np.ndarray, interval: float, late: np.ndarray | None = None) -> np.ndarray:
        """Means of a held signal over intervals that begin at other times; shape of `times`.

        Unlike its values, they are continuous in the times: a delay by a fraction of a step makes a difference.

        Args:
            name: of the signal.
            times: in s.
            interval: in s.
            late: delay with which each row acts, in s, shape [T]; no row acts before the one before it.
        """
        since, values = self.samples(name)
        if late is not None:
            since = np.maximum.accumulate(since + late[np.isfinite(self.signals[name])])
        before = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(since))])

        def integral(to: np.ndarray) -> np.ndarray:
            last = np.maximum(np.searchsorted(since, to, side="right") - 1, 0)
            return before[last] + values[last] * (to - since[last])

        return (integral(times + interval) - integral(times)) / interval


def read(path: str | Path) -> Log:
    """Read a recording.

    Raises:
        ValueError: for a file that is missing, damaged or no recording, and several episodes, in one line.
        ImportError: where the extra `robotics` is needed and not installed.
    """
    several = read_all(path)
    if len(several) > 1:
        raise ValueError(f"log: expected one recording, got {len(several)} episodes of {path}")
    return several[0]


def read_all(path: str | Path) -> list[Log]:
    """Read a recording, or several episodes of a data set.

    Raises:
        ValueError: for a file that is missing, damaged or no recording, in one line.
        ImportError: where the extra `robotics` is needed and not installed.
    """
    return [log_of(one) for one in log_files.recorded(path)]


def log_of(one: Recorded) -> Log:
    """A recording in SI units and radians, with the signs and zeros of the model.

    Raises:
        ValueError: for times that do not increase, and units that are not known, in one line.
    """
    if one.faults:
        raise ValueError(f"{one.name}: {one.faults[0]}")
    log = Log(one.times, one.signals, one.name, one.units)
    scaled = {name: scale * log.signals[name] + offset for name, (scale, offset) in one.scales.items()}
    return dataclasses.replace(log, signals={**log.signals, **scaled}) if scaled else log


def _seconds(times: np.ndarray, unit: Unit, where: str) -> tuple[Float[np.ndarray, " time"], str]:
    """Times in s from the first one, and their unit, "s", where it is known.

    Raises:
        ValueError: for times that do not increase, in one line that names the rows.
    """
    if times.dtype.kind == "M":
        _check_increasing(times.astype("M8[ns]").astype(np.int64), where)
        times, unit = (times - times[:1]).astype("m8[ns]").astype(np.int64), parse("ns")
    if unit.name not in ("", "s"):
        raise ValueError(f"{where}: expected times in a unit of time, got {unit.name}")
    if times.ndim != 1 or len(times) < 2 or times.dtype.kind not in "iuf":
        raise ValueError(
            f"{where}: expected at least two increasing times, got {times.dtype} of shape {list(times.shape)}"
        )
    _check_increasing(times, where)
    step = float(np.median(np.diff(times)))
    if times.dtype.kind in "iu" and not unit.name and NANOSECONDS[0] <= step < NANOSECONDS[1]:
        unit = parse("ns")
        text = f"{where}: times are integers {step:.6g} apart without a unit: read as ns, {1e-9 * step:.3g} s apart"
        warnings.warn(text, RecordingWarning, stacklevel=4)
    return unit.factor * (times - times[0]).astype(float), unit.name


def _check_increasing(times: np.ndarray, where: str) -> None:
    if len(times) < 2 or times.dtype.kind not in "iuf":
        return  # refused later
    if times.dtype.kind == "f":
        resolution = float(np.spacing(np.abs(times[np.isfinite(times)]).max(initial=0.0)))
        if np.isfinite(times).all() and resolution > 0.1 * float(np.ptp(times)) / (len(times) - 1):
            raise ValueError(
                f"{where}: expected times that distinguish rows, got {times.dtype} of about {times[0]:.6g}, which has "
                f"steps of {resolution:.3g}: save them in double precision, or relative to the first one"
            )
    if fault := clocks.order(times).fault:
        raise ValueError(f"{where}: expected at least two increasing times, got {fault}")
