"""Long recordings in short windows, each an episode with a start of its own (multiple shooting; Bock and Plitt 1984).

Simulations of a whole long recording take long, and their errors grow with time, so that the misfit has many minima. A
recording of many steps is cut into windows of a few periods of its motion, as many as a simulation can afford. Each is
the window with the most motion in its part of the recording, and begins where the recording does (`starts`). If there
are more samples than inference needs, only every n-th is compared. Controls are kept as they were recorded.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from jaxlfi.envs.mujoco import measured
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.plausible import say

LONG_STEPS, LONG_ROWS = 60_000, 30_000
"""Steps of a simulation, and rows of its recordings, above which recordings are cut."""
STEPS, ROWS = 10_000, 4_000
"""Steps and rows that all windows together have, approximately."""
MOST = 16
"""Largest number of windows by default."""
PERIODS = 2.0
"""Periods of the motion in a window."""
SLOW = 0.01
"""Seconds over which speeds are computed, as noise changes faster."""
LEAST_STEPS, SHORTEST, LONGEST = 50, 0.2, 5.0
"""Smallest number of steps, and smallest and largest duration in s, of a window."""
FEWEST, TRIED = 20, 1000
"""Smallest number of rows of a default window, and largest number of windows that are compared in a part."""


@dataclasses.dataclass(frozen=True)
class Window:
    """A part of a recording.

    Attributes:
        recording: its number.
        begin: in s of the recording.
        end: in s of the recording.
    """

    recording: int
    begin: float
    end: float


def wanted(model: mujoco.MjModel, logs: Sequence[Log], signals: Sequence[str]) -> bool:
    """Whether recordings are long enough to be cut, and have enough samples in a window."""
    if any(FEWEST * log.times[-1] / (len(log.times) - 1) > LONGEST for log in logs):
        return False
    steps = sum(log.times[-1] for log in logs) / model.opt.timestep
    rows = sum(len(_rows(log, signals)) for log in logs)
    return bool(steps > LONG_STEPS or rows > LONG_ROWS)


def windows_of(
    model: mujoco.MjModel,
    logs: Sequence[Log],
    signals: Sequence[str],
    noises: Mapping[str, float],
    count: int | None = None,
    duration: float | None = None,
) -> list[Window]:
    """Windows of recordings.

    Args:
        model: with a sensor for each signal.
        logs: recordings.
        signals: that are measured.
        noises: standard deviations of their noise.
        count: windows of each recording; by default as many as a simulation can afford.
        duration: of each, in s; by default a few periods of the motion.

    Raises:
        ValueError: for windows that the recordings do not hold, in one line.
    """
    step = model.opt.timestep
    if count is not None and (isinstance(count, bool) or not isinstance(count, int) or count < 1):
        raise ValueError(f"windows: expected a number of at least 1, got {count!r}")
    if duration is not None and not 2 * step <= duration < np.inf:
        raise ValueError(f"window: expected at least two steps of the model, {2 * step:g} s, got {duration!r}")
    found = []
    whole = sum(float(log.times[-1]) for log in logs)
    for number, log in enumerate(logs):
        total = float(log.times[-1])
        own = PERIODS * period(model, log, signals, noises) if duration is None else duration
        if duration is None:
            own = float(np.clip(own, max(SHORTEST, LEAST_STEPS * step), LONGEST))
            own = min(own, total / (count or 1))
        several = count
        if several is None:
            affordable = max(int(STEPS * step / own * total / whole), 1)
            several = max(min(int(total / own + 1e-9), affordable, max(round(MOST * total / whole), 1)), 1)
        if several * own > total * (1 + 1e-9):
            raise ValueError(
                f"windows: expected {several} of {own:g} s within {log.name}, which lasts {total:g} s; got more"
            )
        parts = np.linspace(0.0, total, several + 1)
        found += [_liveliest(number, log, signals, noises, *part, own) for part in itertools.pairwise(parts)]
    return found


def period(model: mujoco.MjModel, log: Log, signals: Sequence[str], noises: Mapping[str, float]) -> float:
    """The approximate period of a recording's motion, in s.

    It is estimated from the ratio of a signal's amplitude to its speed, as the median over signals that measure no
    forces.
    """
    found = []
    for name in signals:
        times, values = log.samples(name)
        if not measured.kinematic(model, name) or len(times) < 4 or not np.ptp(values) > 0:
            continue
        stride = max(round(SLOW / float(np.median(np.diff(times)))), 1)
        apart, variance = np.diff(times[::stride]), noises.get(name, 0.0) ** 2
        speed = np.mean((np.diff(values[::stride]) ** 2 - 2 * variance) / apart**2)
        moved = np.var(values) - variance
        if speed > 0 and moved > 0:
            found.append(2 * np.pi * float(np.sqrt(moved / speed)))
    return float(np.median(found)) if found else LONGEST


def cut(
    logs: Sequence[Log], windows: Sequence[Window], signals: Sequence[str], lead: float, late: Mapping[str, float]
) -> tuple[list[Log], list[float]]:
    """The recording of each window, and when in it the window begins.

    Args:
        logs: recordings.
        windows: of them.
        signals: that are measured.
        lead: time before and after a window whose controls may matter in it, in s.
        late: largest delays of signals that are measured late, in s.

    Raises:
        ValueError: for a window without samples, in one line.
    """
    rows = sum(len(_between(logs[one.recording], _rows(logs[one.recording], signals), one)) for one in windows)
    every = max(int(np.ceil(rows / ROWS)), 1)
    found: list[Log] = []
    begins = []
    for one in windows:
        log = logs[one.recording]
        first = _first(log, signals, one.begin - lead)
        last = int(np.searchsorted(log.times, one.end + lead + 1e-9, side="right"))
        part, times = slice(first, last), log.times[first:last]
        kept = {name: values[part].copy() for name, values in log.signals.items()}
        for name in signals:
            inside = (times >= one.begin + late.get(name, 0.0) - 1e-9) & (times <= one.end + 1e-9)
            there = np.flatnonzero(np.isfinite(kept[name]) & inside)
            compared = np.zeros(len(times), bool)
            compared[there[::every]] = True
            kept[name][~compared] = np.nan
        if sum(np.isfinite(kept[name]).sum() for name in signals) < 2:
            raise ValueError(f"window: expected samples in each of {one.end - one.begin:g} s of {log.name}, got none")
        found.append(_Part(times - times[0], kept, log.name, log.units))
        begins.append(float(one.begin - times[0]))
    return found, begins


def said(logs: Sequence[Log], windows: Sequence[Window], step: float, rows: int) -> None:
    """Report into how many windows recordings are cut, and why."""
    total = sum(float(log.times[-1]) for log in logs)
    name = logs[0].name if len(logs) == 1 else f"{len(logs)} recordings"
    lengths = [one.end - one.begin for one in windows]
    say(
        f"{name}: {total:.6g} s would be {total / step:.3g} steps of the model in each simulation: cut into "
        f"{len(windows)} windows of {np.median(lengths):.3g} s with the most motion, each with its own initial "
        f"state, and {rows} rows in all; set windows = N or window = SECONDS to change this"
    )


class _Part(Log):
    """Rows of a recording whose signals need not have samples in them."""

    def __post_init__(self):
        """Nothing is converted or checked again."""


def _liveliest(
    number: int,
    log: Log,
    signals: Sequence[str],
    noises: Mapping[str, float],
    low: float,
    high: float,
    duration: float,
) -> Window:
    """The window between two times in which signals vary most, relative to their noise or to their whole variance."""
    begins = np.linspace(low, max(high - duration, low), int(np.clip(2 * (high - low) / duration, 1, TRIED)))
    scores = np.zeros(len(begins))
    for name in signals:
        times, values = log.samples(name)
        sums = [np.concatenate([[0.0], np.cumsum((values - values.mean()) ** power)]) for power in (0, 1, 2)]
        first, last = np.searchsorted(times, begins - 1e-9), np.searchsorted(times, begins + duration + 1e-9)
        count, mean, square = (own[last] - own[first] for own in sums)
        variance = np.where(count > 1, square / np.maximum(count, 1) - (mean / np.maximum(count, 1)) ** 2, 0.0)
        scores += variance / max(noises.get(name, 0.0) ** 2, 1e-6 * float(np.var(values)), 1e-300)
    row = int(np.searchsorted(log.times, begins[int(np.argmax(scores))] + 1e-9, side="right")) - 1
    begin = float(log.times[row])
    return Window(number, begin, begin + duration)


def _rows(log: Log, signals: Sequence[str]) -> np.ndarray:
    return np.flatnonzero(np.isfinite([log.signals[name] for name in signals]).any(axis=0))


def _between(log: Log, rows: np.ndarray, one: Window) -> np.ndarray:
    return rows[(log.times[rows] >= one.begin) & (log.times[rows] <= one.end)]


def _first(log: Log, signals: Sequence[str], time: float) -> int:
    """The row from which all controls are known at a time and later."""
    before = int(np.searchsorted(log.times, time + 1e-9, side="right"))
    firsts = [max(before - 1, 0)]
    for name, values in log.signals.items():
        if name not in signals:
            there = np.flatnonzero(np.isfinite(values[:before]))
            firsts.append(int(there[-1]) if len(there) else 0)
    return min(firsts)
