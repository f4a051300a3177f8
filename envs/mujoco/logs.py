"""What was recorded: controls and sensors over time, by name, in SI units and radians.

| file | times | signals |
|---|---|---|
| .npz | the array `times` (s) | arrays [T], or [T, n] for NAME[0] to NAME[n - 1] |
| .csv | the first column, headed "time [s]" | columns headed "NAME [unit]"; an empty cell is a missing sample |
| .mcap, folder of a LeRobot data set | of each signal | by the names of their numbers; needs the extra `robotics` |

Signals may have clocks of their own: in a table, a row then has empty cells (NaN) where a signal has no sample. Times
may begin anywhere; they are counted from the first one.
"""

import csv
import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxlfi.io import files

UNITS: Mapping[str, tuple[float, str]] = {
    **{unit: (1.0, unit) for unit in ("", "s", "m", "rad", "m/s", "rad/s", "m/s^2", "rad/s^2", "N", "N m", "V", "A")},
    **{"1": (1.0, ""), "Nm": (1.0, "N m"), "N*m": (1.0, "N m"), "ms": (1e-3, "s"), "us": (1e-6, "s")},
    **{"mm": (1e-3, "m"), "cm": (1e-2, "m"), "mm/s": (1e-3, "m/s"), "cm/s": (1e-2, "m/s")},
    **{"mN": (1e-3, "N"), "mN m": (1e-3, "N m"), "g": (9.80665, "m/s^2"), "rpm": (np.pi / 30, "rad/s")},
    **{"deg": (np.pi / 180, "rad"), "deg/s": (np.pi / 180, "rad/s"), "deg/s^2": (np.pi / 180, "rad/s^2")},
    **{"°": (np.pi / 180, "rad"), "°/s": (np.pi / 180, "rad/s")},
}
"""What a number in each unit of a heading is in SI units and radians, and in which; "g" is the acceleration."""
HEADING = re.compile(r"\s*(?P<name>[^\[(]*(?:\[\d+\])?)\s*(?:[\[(](?P<unit>[^\])]*)[\])])?\s*")
TIMES = ("times", "time", "t")


@dataclasses.dataclass(frozen=True, eq=False)
class Log:
    """A recording.

    Attributes:
        times: in s from the first one, increasing, shape [T].
        signals: by name, NaN where there is no sample, shape [T] each.
        name: of the file.
        units: of signals, where they are known, in SI units and radians.

    Raises:
        ValueError: for what is no recording.
    """

    times: Float[np.ndarray, " time"]
    signals: Mapping[str, Float[np.ndarray, " time"]]
    name: str = "log"
    units: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        times = np.asarray(self.times, float)
        if times.ndim != 1 or len(times) < 2 or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise ValueError(f"{self.name}: expected at least two increasing times, got others")
        signals = {name: np.asarray(values, float) for name, values in self.signals.items()}
        for name, values in signals.items():
            if values.shape != times.shape:
                raise ValueError(
                    f"{self.name}: {name}: expected a sample for each of {len(times)} times, got {list(values.shape)}"
                )
            if np.isinf(values).any() or np.isnan(values).all():
                raise ValueError(f"{self.name}: {name}: expected finite samples, got infinite ones or none at all")
        object.__setattr__(self, "times", times - times[0])
        object.__setattr__(self, "signals", signals)

    def samples(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Times and values of a signal's samples."""
        there = np.flatnonzero(np.isfinite(self.signals[name]))
        return self.times[there], self.signals[name][there]

    def held(self, name: str, times: np.ndarray) -> np.ndarray:
        """The last sample of a signal at other times, and before its first that one; shape that of `times`."""
        since, values = self.samples(name)
        last = np.searchsorted(since, times + 1e-9, side="right") - 1
        return values[np.maximum(last, 0)]

    def mean_held(self, name: str, times: np.ndarray, interval: float) -> np.ndarray:
        """Means of a held signal over intervals that begin at other times; shape that of `times`.

        Unlike its values they are continuous in the times: a delay by a part of a step makes a difference.
        """
        since, values = self.samples(name)
        before = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(since))])

        def integral(to: np.ndarray) -> np.ndarray:
            last = np.maximum(np.searchsorted(since, to, side="right") - 1, 0)
            return before[last] + values[last] * (to - since[last])

        return (integral(times + interval) - integral(times)) / interval


def read(path: Path) -> Log:
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
    if path.suffix == ".mcap" or path.is_dir():
        return _of_robotics(path)
    raise ValueError(f"log: expected NAME.npz, NAME.csv, NAME.mcap or the folder of a LeRobot data set, got {path}")


def _of_arrays(arrays: Mapping[str, np.ndarray], where: str) -> Log:
    known = [name for name in TIMES if name in arrays]
    if len(known) != 1:
        raise ValueError(f"{where}: expected one array of times, called {TIMES[0]!r}, got {sorted(arrays)}")
    signals: dict[str, np.ndarray] = {}
    for name, values in arrays.items():
        if name == known[0]:
            continue
        if values.dtype.kind not in "biuf" or values.ndim not in (1, 2):
            raise ValueError(
                f"{where}: {name}: expected numbers [T] or [T, n], got {values.dtype} {list(values.shape)}"
            )
        signals |= {name: values} if values.ndim == 1 else {f"{name}[{i}]": row for i, row in enumerate(values.T)}
    return Log(arrays[known[0]], signals, where)


def _of_table(path: Path) -> Log:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: expected a CSV file, got one that is missing or no text") from error
    if len(rows) < 3:
        raise ValueError(f"{path}: expected a line of headings and two of numbers, got {len(rows)} lines")
    names, factors, units = zip(*(_heading(text, path) for text in rows[0]), strict=True)
    if names[0].casefold() not in TIMES:
        raise ValueError(f"{path}: expected times in the first column, headed 'time [s]', got {rows[0][0]!r}")
    if len(set(names)) < len(names):
        raise ValueError(f"{path}: expected each heading once, got {', '.join(names)}")
    table = np.full((len(rows) - 1, len(names)), np.nan)
    for number, row in enumerate(rows[1:]):
        if len(row) != len(names):
            raise ValueError(f"{path}: line {number + 2}: expected {len(names)} cells, got {len(row)}")
        try:
            table[number] = [float(cell) if cell.strip() else np.nan for cell in row]
        except ValueError as error:
            raise ValueError(f"{path}: line {number + 2}: expected numbers, got {','.join(row)[:60]!r}") from error
    table *= factors
    known = {name: unit for name, unit in zip(names, units, strict=True) if unit}
    return Log(table[:, 0], dict(zip(names[1:], table[:, 1:].T, strict=True)), str(path), known)


def _heading(text: str, path: Path) -> tuple[str, float, str]:
    """A signal's name, what its unit is in SI units, and in which."""
    match = HEADING.fullmatch(text)
    name, unit = (match["name"].strip(), (match["unit"] or "").strip()) if match else ("", "")
    if not name or unit not in UNITS:
        raise ValueError(f"{path}: expected a heading as 'NAME [unit]' with a unit of {', '.join(UNITS)}, got {text!r}")
    return name, *UNITS[unit]


def _of_robotics(path: Path) -> Log:
    from jaxlfi.io import lerobot, mcap

    rollout = mcap.read(path) if path.suffix == ".mcap" else lerobot.read(path, None)
    times = np.unique(np.concatenate([signal.times for signal in rollout.signals.values()]))
    signals: dict[str, np.ndarray] = {}
    for signal in rollout.signals.values():
        rows = np.searchsorted(times, signal.times)
        for name, values in zip(signal.names, signal.values.T, strict=True):
            if name in signals:
                raise ValueError(f"{path}: expected each signal once, got {name!r} twice")
            signals[name] = np.full(len(times), np.nan)
            signals[name][rows] = values
    return Log(times, signals, str(path))
