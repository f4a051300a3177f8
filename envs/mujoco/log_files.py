"""Files of recordings: raw times and signals, before they are converted (`logs`).

| file | times | signals |
|---|---|---|
| .npz | the array `times`, or `time [ms]` | arrays [T], or [T, n] for NAME[0] to NAME[n - 1]; `NAME [unit]` |
| .csv | the first column, headed "time [s]", or else the only one that is | columns headed "NAME [unit]" |
| .mcap, folder of a ROS 2 bag or a LeRobot data set | of each signal | by the names of their numbers |

An empty cell of a table is a missing sample, and a first column without a heading numbers its rows. The last kind needs
the extra `robotics`. One episode of a LeRobot data set is FOLDER#episode=3, and several are FOLDER#episodes=0-9. A name
that two topics share, such as the state and the action of one motor, follows that of the topic:
`observation.state/elbow` and `action/elbow`.
"""

import csv
import dataclasses
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxlfi.io import clocks, files
from jaxlfi.io.rollout import Rollout
from jaxlfi.io.units import is_unit, parse
from jaxlfi.robots import recording

HEADING = re.compile(r"\s*(?P<name>[^\[(]*(?:\[\d+\])?)\s*(?:[\[(](?P<unit>.*)[\])])?\s*")
TIMES = ("times", "time", "t", "timestamps", "timestamp", "stamp")
"""Names of times; a unit may follow, as in time_ms."""
TIME = "time"
"""Name of times among the units of a log."""
AXES = ("x", "y", "z", "w")
"""Names of components that mean nothing without that of their topic."""
WIDEST = 256
"""Largest number of values of a topic: point clouds and images are left out."""


@dataclasses.dataclass(frozen=True, eq=False)
class Recorded:
    """A recording as stored in its file.

    Attributes:
        times: numbers or NumPy's datetime64, shape [T].
        signals: by name, NaN where there is no sample, shape [T] each.
        name: of the file, for messages.
        units: of signals and, as "time", of times: "" if the file states none.
        faults: errors in the times of topics, in one line each.
        scales: factor and offset of signals that differ from the model's, applied after their units (`renaming`).
        by_us: whether jaxlfi recorded it, so that names and numbers are the model's.
    """

    times: np.ndarray
    signals: Mapping[str, np.ndarray]
    name: str
    units: Mapping[str, str]
    faults: tuple[str, ...] = ()
    scales: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    by_us: bool = False

    def in_order(self) -> "Recorded":
        """The same in order of time, with the first of several samples at one time; `faults` says what was wrong."""
        times = self.times.astype("M8[ns]").astype(np.int64) if self.times.dtype.kind == "M" else self.times
        if times.ndim != 1 or times.dtype.kind not in "iuf":
            return self  # refused later
        rows, fault = clocks.order(times)
        if not fault:
            return self
        rows = rows[np.diff(times[rows], prepend=np.nan).astype(bool)]
        signals = {name: np.asarray(values)[rows] for name, values in self.signals.items()}
        faults = (*self.faults, f"expected at least two increasing times, got {fault}")
        return dataclasses.replace(self, times=self.times[rows], signals=signals, faults=faults)


def recorded(path: str | Path) -> list[Recorded]:
    """The recordings of a file or folder: one, or several episodes of a data set.

    Raises:
        ValueError: for a file that is missing, damaged or no recording, in one line.
        ImportError: where the extra `robotics` is needed and not installed.
    """
    path = Path(path)
    by_us = recording.is_ours(path.with_name(path.name.partition("#")[0]))
    return [dataclasses.replace(one, by_us=by_us) for one in _recorded(path)]


def _recorded(path: Path) -> list[Recorded]:
    if path.suffix == ".npz":
        return [_of_arrays(files.read_arrays(path), str(path))]
    if path.suffix == ".csv":
        return [_of_table(path)]
    if path.suffix == ".mcap" or path.is_dir() or "#" in path.name:
        return list(_of_robotics(path))
    raise ValueError(
        f"log: expected NAME.npz, NAME.csv, NAME.mcap or the folder of a ROS 2 bag or a LeRobot data set, got {path}"
    )


def _of_arrays(arrays: Mapping[str, np.ndarray], where: str) -> Recorded:
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
    _check_sizes(arrays[clock], signals, where)
    return Recorded(arrays[clock], signals, where, known)


def _check_sizes(times: np.ndarray, signals: Mapping[str, np.ndarray], where: str) -> None:
    for name, values in signals.items():
        if values.shape != times.shape and times.ndim == 1:
            raise ValueError(
                f"{where}: {name}: expected a sample for each of {len(times)} times, got {list(values.shape)}"
            )


def _of_table(path: Path) -> Recorded:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: expected a CSV file, got one that is missing or no text") from error
    if len(rows) < 3:
        raise ValueError(f"{path}: expected a line of headings and two of numbers, got {len(rows)} lines")
    clock = _clock(rows[0], path)
    places = [place for place, text in enumerate(rows[0]) if place != clock and (place or text.strip())]
    headings = [_heading(rows[0][place], path) for place in places]
    if len({name for name, _ in headings}) < len(headings):
        raise ValueError(f"{path}: expected each heading once, got {', '.join(name for name, _ in headings)}")
    table = np.full((len(rows) - 1, len(rows[0])), np.nan)
    for number, row in enumerate(rows[1:]):
        if len(row) != len(rows[0]):
            raise ValueError(f"{path}: line {number + 2}: expected {len(rows[0])} cells, got {len(row)}")
        try:
            table[number] = [float(cell) if cell.strip() else np.nan for cell in row]
        except ValueError as error:
            raise ValueError(f"{path}: line {number + 2}: expected numbers, got {','.join(row)[:60]!r}") from error
    times = _integers([row[clock] for row in rows[1:]])
    return Recorded(
        table[:, clock] if times is None else times,
        {name: table[:, place] for (name, _), place in zip(headings, places, strict=True)},
        str(path),
        {TIME: _time_unit(rows[0][clock]) or ""} | dict(headings),
    )


def _clock(headings: Sequence[str], path: Path) -> int:
    """The column of the times: the first, or else the only one with a heading for times."""
    found = [place for place, text in enumerate(headings) if _time_unit(text) is not None]
    if not found or (found[0] and len(found) > 1):
        raise ValueError(f"{path}: expected times in the first column, headed 'time [s]', got {headings[0]!r}")
    return found[0]


def _integers(cells: Sequence[str]) -> np.ndarray | None:
    """Cells as integers, which keep all digits of a clock in ns; None if some are not integers."""
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
    """The same for a name in which brackets need not hold a unit."""
    match = HEADING.fullmatch(text)
    if match and match["unit"] and match["name"].strip() and is_unit(match["unit"]):
        return match["name"].strip(), match["unit"].strip()
    return text, ""


def _time_unit(text: str) -> str | None:
    """The unit, or "", of a heading of times; None for other headings."""
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


def _of_robotics(path: Path) -> Iterator[Recorded]:
    from jaxlfi.io import lerobot, mcap

    folder, numbers = lerobot.selected(path)
    if folder.suffix == ".mcap" or mcap.is_bag(folder):
        yield _of_rollout(mcap.read(folder), str(path), {})
        return
    known = {TIME: "s"}  # if the frame rate confirms it
    if numbers is None or len(numbers) == 1:
        yield _of_rollout(lerobot.read(folder, None if numbers is None else numbers[0]), str(path), known)
        return
    for number, rollout in zip(numbers, lerobot.read_several(folder, numbers), strict=True):
        yield _of_rollout(rollout, f"{folder}{lerobot.EPISODE}{number}", known)


def _of_rollout(rollout: Rollout, where: str, known: Mapping[str, str]) -> Recorded:
    narrow = {topic: signal for topic, signal in rollout.signals.items() if len(signal.names) <= WIDEST}
    if not narrow:
        raise ValueError(f"{where}: expected topics of at most {WIDEST} numbers, got {', '.join(rollout.signals)}")
    named = {topic: [_named(heading) for heading in signal.names] for topic, signal in narrow.items()}
    topics = Counter(name for several in named.values() for name in {name for name, _ in several})
    times = np.unique(np.concatenate([signal.times for signal in narrow.values()]))
    signals: dict[str, np.ndarray] = {}
    units, faults = dict(known), list(rollout.faults)
    for topic, signal in narrow.items():
        if fault := clocks.order(signal.times, "sample").fault:
            faults.append(f"{topic}: expected one sample at a time, got {fault}")
        rows, first = np.unique(np.searchsorted(times, signal.times), return_index=True)
        for (name, own), values, unit in zip(named[topic], signal.values[first].T, signal.units, strict=True):
            column = np.full(len(times), np.nan)
            column[rows] = values
            called = name if topics[name] == 1 and name not in AXES else f"{topic}/{name}"
            _add(signals, {called: column}, where)
            units[called] = own or unit
    return Recorded(times, signals, where, units, tuple(faults))
