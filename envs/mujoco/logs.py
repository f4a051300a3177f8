"""Recordings: controls and sensors over time, by name, in SI units and radians.

| file | times | signals |
|---|---|---|
| .npz | the array `times`, or `time [ms]` | arrays [T], or [T, n] for NAME[0] to NAME[n - 1]; `NAME [unit]` |
| .csv | the first column, headed "time [s]" | columns headed "NAME [unit]"; an empty cell is a missing sample |
| .mcap, folder of a LeRobot data set | of each signal | by the names of their numbers; needs the extra `robotics` |

Units are those of `jaxlfi.io.units`; an episode of a LeRobot data set is FOLDER#episode=3. Signals may have clocks of
their own: in a table, a row then has empty cells (NaN) where a signal has no sample. Times may begin anywhere; they are
counted from the first one.
"""

import csv
import dataclasses
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxlfi.io import files
from jaxlfi.io.units import Unit, is_unit, parse

HEADING = re.compile(r"\s*(?P<name>[^\[(]*(?:\[\d+\])?)\s*(?:[\[(](?P<unit>.*)[\])])?\s*")
TIMES = ("times", "time", "t", "timestamps", "timestamp", "stamp")
"""What times are called; a unit may follow, as in time_ms."""
TIME = "time"
"""What times are called among the units of a log."""
NANOSECONDS = (1e6, 1e9)
"""Integers that are so far apart are taken for nanoseconds, as recorders have them, where nothing says otherwise."""


class RecordingWarning(UserWarning):
    """A recording is read otherwise than it stands, or looks wrong."""


@dataclasses.dataclass(frozen=True, eq=False)
class Log:
    """A recording, which is converted to SI units and radians when it is made.

    Attributes:
        times: in s from the first one, increasing, shape [T]. They may be given in the unit that `units` says, or as
            NumPy's datetime64.
        signals: by name, NaN where there is no sample, shape [T] each.
        name: of the file.
        units: of signals and, as "time", of times, where they are known: those of the given numbers, then SI units.

    Raises:
        ValueError: for what is no recording, and units that are not known.

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
        """The last sample of a signal at other times, and before its first that one; shape that of `times`."""
        since, values = self.samples(name)
        last = np.searchsorted(since, times + 1e-9, side="right") - 1
        return values[np.maximum(last, 0)]

    def mean_held(self, name: str, times: np.ndarray, interval: float, late: np.ndarray | None = None) -> np.ndarray:
        """Means of a held signal over intervals that begin at other times; shape that of `times`.

        Unlike its values they are continuous in the times: a delay by a part of a step makes a difference.

        Args:
            name: of the signal.
            times: in s.
            interval: in s.
            late: how much later than at its time each row acts, in s, shape [T]; none before the row before it.
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
        ValueError: for a file that is missing, damaged or no recording, in one line.
        ImportError: where the extra `robotics` is needed and not installed.
    """
    path = Path(path)
    if path.suffix == ".npz":
        return _of_arrays(files.read_arrays(path), str(path))
    if path.suffix == ".csv":
        return _of_table(path)
    if path.suffix == ".mcap" or path.is_dir() or "#" in path.name:
        return _of_robotics(path)
    raise ValueError(f"log: expected NAME.npz, NAME.csv, NAME.mcap or the folder of a LeRobot data set, got {path}")


def _seconds(times: np.ndarray, unit: Unit, where: str) -> tuple[Float[np.ndarray, " time"], str]:
    """Times in s from the first one, and their unit, "s", where it is known.

    Raises:
        ValueError: for what is no increasing times, in one line that names the rows.
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
        return  # which is refused for that
    if times.dtype.kind == "f":
        if len(rows := np.flatnonzero(~np.isfinite(times))):
            got = f"{times[rows[0]]} in row {rows[0] + 1}{_more(rows)}"
            raise ValueError(f"{where}: expected at least two increasing times, got {got}")
        resolution = float(np.spacing(np.abs(times).max()))
        if resolution > 0.1 * float(np.ptp(times)) / (len(times) - 1):
            raise ValueError(
                f"{where}: expected times that tell rows apart, got {times.dtype} of about {times[0]:.6g}, which has "
                f"steps of {resolution:.3g}: save them in double precision, or from the first one on"
            )
    if len(rows := np.flatnonzero(times[1:] <= times[:-1])):
        row = rows[0] + 1
        raise ValueError(
            f"{where}: expected at least two increasing times, got {times[row]:.12g} in row {row + 1} after "
            f"{times[row - 1]:.12g}{_more(rows)}"
        )


def _more(rows: np.ndarray) -> str:
    return f", and in {len(rows) - 1} more rows likewise" if len(rows) > 1 else ""


def _of_arrays(arrays: Mapping[str, np.ndarray], where: str) -> Log:
    clocks = {name: unit for name in arrays if (unit := _time_unit(name)) is not None}
    if len(clocks) != 1:
        raise ValueError(f"{where}: expected one array of times, called {TIMES[0]!r}, got {sorted(arrays)}")
    ((clock, unit),) = clocks.items()
    signals: dict[str, np.ndarray] = {}
    known = {TIME: unit}
    for heading, values in arrays.items():
        if heading == clock:
            continue
        if values.dtype.kind not in "biuf" or values.ndim not in (1, 2):
            raise ValueError(
                f"{where}: {heading}: expected numbers [T] or [T, n], got {values.dtype} {list(values.shape)}"
            )
        name, own = _named(heading)
        found = {name: values} if values.ndim == 1 else {f"{name}[{i}]": row for i, row in enumerate(values.T)}
        _add(signals, found, where)
        known |= dict.fromkeys(found, own)
    return Log(arrays[clock], signals, where, known)


def _of_table(path: Path) -> Log:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: expected a CSV file, got one that is missing or no text") from error
    if len(rows) < 3:
        raise ValueError(f"{path}: expected a line of headings and two of numbers, got {len(rows)} lines")
    clock = _time_unit(rows[0][0])
    if clock is None:
        raise ValueError(f"{path}: expected times in the first column, headed 'time [s]', got {rows[0][0]!r}")
    names, known = zip(*(_heading(text, path) for text in rows[0][1:]), strict=True) if len(rows[0]) > 1 else ((), ())
    if len(set(names)) < len(names):
        raise ValueError(f"{path}: expected each heading once, got {', '.join(names)}")
    table = np.full((len(rows) - 1, len(rows[0])), np.nan)
    for number, row in enumerate(rows[1:]):
        if len(row) != len(rows[0]):
            raise ValueError(f"{path}: line {number + 2}: expected {len(rows[0])} cells, got {len(row)}")
        try:
            table[number] = [float(cell) if cell.strip() else np.nan for cell in row]
        except ValueError as error:
            raise ValueError(f"{path}: line {number + 2}: expected numbers, got {','.join(row)[:60]!r}") from error
    times = _integers([row[0] for row in rows[1:]])
    return Log(
        table[:, 0] if times is None else times,
        dict(zip(names, table[:, 1:].T, strict=True)),
        str(path),
        {TIME: clock} | dict(zip(names, known, strict=True)),
    )


def _integers(cells: Sequence[str]) -> np.ndarray | None:
    """Cells as integers, which keep all digits of a clock in ns; None where some are none."""
    try:
        return np.array([int(cell) for cell in cells], np.int64)
    except (ValueError, OverflowError):
        return None


def _heading(text: str, path: Path) -> tuple[str, str]:
    """A signal's name, and its unit or ""."""
    match = HEADING.fullmatch(text)
    name, unit = (match["name"].strip(), (match["unit"] or "").strip()) if match else ("", "")
    if not name or not is_unit(unit):
        raise ValueError(
            f"{path}: expected a heading as 'NAME [unit]' with a unit of the SI, or one such as deg, rpm, mm, mN m and "
            f"ms, got {text!r}"
        )
    return name, unit


def _named(text: str) -> tuple[str, str]:
    """The same of a name in which brackets need not hold a unit."""
    match = HEADING.fullmatch(text)
    if match and match["unit"] and match["name"].strip() and is_unit(match["unit"]):
        return match["name"].strip(), match["unit"].strip()
    return text, ""


def _time_unit(text: str) -> str | None:
    """The unit, or "", of a heading of times; None of another heading."""
    match = HEADING.fullmatch(text)
    if match is None:
        return None
    name, unit = match["name"].strip().casefold(), (match["unit"] or "").strip()
    base, _, suffix = name.rpartition("_")
    if base in TIMES and not unit and is_unit(suffix) and parse(suffix).name == "s":
        return suffix
    return unit if name in TIMES else None


def _add(signals: dict[str, np.ndarray], found: Mapping[str, np.ndarray], where: str) -> None:
    if twice := [name for name in found if name in signals]:
        raise ValueError(f"{where}: expected each signal once, got {twice[0]!r} twice")
    signals |= found


def _of_robotics(path: Path) -> Log:
    from jaxlfi.io import lerobot, mcap

    folder, episode = lerobot.located(path)
    of_frames = path.suffix != ".mcap"
    rollout = lerobot.read(folder, episode) if of_frames else mcap.read(path)
    times = np.unique(np.concatenate([signal.times for signal in rollout.signals.values()]))
    signals: dict[str, np.ndarray] = {}
    known = {TIME: "s"} if of_frames else {}  # where the frame rate bears it out
    for topic, signal in rollout.signals.items():
        if len(same := np.flatnonzero(np.diff(signal.times) == 0)):
            row = same[0] + 1
            raise ValueError(
                f"{path}: {topic}: expected one sample at a time, got samples {row} and {row + 1} at "
                f"{signal.times[row]:.12g} s"
            )
        rows = np.searchsorted(times, signal.times)
        for heading, values, unit in zip(signal.names, signal.values.T, signal.units, strict=True):
            name, own = _named(heading)
            column = np.full(len(times), np.nan)
            column[rows] = values
            _add(signals, {name: column}, str(path))
            known[name] = own or unit
    return Log(times, signals, str(path), known)
