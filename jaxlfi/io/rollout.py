"""Rollouts as signals over time: what the file formats of robotics have in common.

`jaxlfi.io.lerobot` and `jaxlfi.io.mcap` read and write them. They depend on no task: a rollout has any number of
signals, of any rates, names and sizes.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

TOLERANCE = 1e-6
"""Tolerance in s of a time stamp at the beginning of its interval, as 7 times 0.16 is not 1.12."""


@dataclasses.dataclass(frozen=True, eq=False)
class Signal:
    """Vectors over time, such as joint angles, keypoints or actions.

    Attributes:
        times: time stamps in s, shape [N], at least one, not decreasing.
        values: booleans, integers or floats, shape [N, n].
        names: names of the n numbers.
        unit: unit of the numbers, or a tuple with that of each.
        duration: duration of a value in s, after which the signal is zero; by default a value lasts until the next.

    Raises:
        ValueError: if these do not fit together.

    Example:
        >>> action = Signal([0.0, 0.5], [[3.0], [4.0]], ("dx",), "m", duration=0.5)
        >>> action.held([-0.1, 0.0, 0.4, 0.9, 1.0]).ravel().tolist()
        [0.0, 3.0, 3.0, 4.0, 0.0]
    """

    times: np.ndarray
    values: np.ndarray
    names: tuple[str, ...]
    unit: str | tuple[str, ...] = ""
    duration: float | None = None

    def __post_init__(self):
        times, values = np.asarray(self.times, float), np.asarray(self.values)
        if values.ndim != 2 or values.dtype.kind not in "biuf" or not times.size or times.shape != values.shape[:1]:
            raise ValueError(
                f"values: expected a row of numbers for each of at least one time, here {times.size}, "
                f"got {values.dtype} of shape {list(values.shape)}"
            )
        if not np.isfinite(times).all() or (np.diff(times) < 0).any():
            raise ValueError("times: expected finite ones in order, got others")
        names = tuple(self.names)
        if len(names) != values.shape[1]:
            raise ValueError(f"names: expected {values.shape[1]}, one for each number, got {len(names)}")
        if not isinstance(self.unit, str) and len(self.unit) != values.shape[1]:
            raise ValueError(f"unit: expected one, or {values.shape[1]} for the numbers, got {len(self.unit)}")
        for name, value in (("times", times), ("values", values), ("names", names)):
            object.__setattr__(self, name, value)

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each number."""
        return (self.unit,) * len(self.names) if isinstance(self.unit, str) else tuple(self.unit)

    def held(self, times: Sequence[float]) -> np.ndarray:
        """The values in effect at other times [F], shape [F, n]; zero before the first one."""
        times = np.asarray(times, float) + TOLERANCE
        last = np.searchsorted(self.times, times, side="right") - 1
        acting = last >= 0
        if self.duration is not None:
            acting &= times < self.times[last] + self.duration
        values = np.zeros((times.size, self.values.shape[1]), self.values.dtype)
        values[acting] = self.values[last[acting]]
        return values

    def each(self, interval: float, count: int) -> np.ndarray:
        """The values of successive intervals, from time zero on, in each of which the signal is constant.

        Args:
            interval: length of an interval in s.
            count: number of intervals.

        Returns:
            One value for each interval, shape [count, n].

        Raises:
            ValueError: if an interval has no value, or several different ones.
        """
        if not interval > 0:
            raise ValueError(f"interval: expected a positive number of seconds, got {interval}")
        which = np.floor((self.times + TOLERANCE) / interval)
        chosen = []
        for k in range(count):
            inside = self.values[which == k]
            if not len(inside) or (inside != inside[0]).any():
                got = "several" if len(inside) else "none"
                raise ValueError(
                    f"expected one value from {k * interval:g} to {(k + 1) * interval:g} s, as of each of {count} "
                    f"intervals, got {got}"
                )
            chosen.append(inside[0])
        return np.stack(chosen)


@dataclasses.dataclass(frozen=True, eq=False)
class Rollout:
    """What was observed and done in one episode.

    Attributes:
        signals: signals by name, words with dots between them such as "observation.state" and "action".
        metadata: facts about the rollout that JSON can hold.
        task: description of the task in words.
        faults: faults of time stamps, one line each: samples that are out of order in their source. Here they are in
            order of time.

    Raises:
        ValueError: for names that not every format can hold.
    """

    signals: Mapping[str, Signal]
    metadata: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    task: str = ""
    faults: tuple[str, ...] = ()

    def __post_init__(self):
        for name in self.signals:
            if not name or any(letter.isspace() or letter == "/" for letter in name):
                raise ValueError(f"signals: expected names without spaces and slashes, got {name!r}")


def numbers(values: np.ndarray) -> list:
    """An array as lists that JSON can hold, in full precision; numbers that are not finite become null."""
    finite = values.astype(object) if values.dtype.kind != "f" else np.where(np.isfinite(values), values, None)
    return finite.tolist()


def array(lists: Any, dtype: str) -> np.ndarray:
    """The array that `numbers` wrote; null becomes NaN.

    Raises:
        ValueError: if it is not an array of that type.
    """
    try:
        kind = np.dtype(dtype)
        if kind.kind not in "biuf":
            raise TypeError(f"{dtype} is no type of numbers")
        read = np.asarray(lists, float if kind.kind == "f" else None)
        made = read.astype(kind)
        if kind.kind != "f" and ((read.dtype.kind == "b") != (kind.kind == "b") or (made != read).any()):
            raise TypeError(f"{read.dtype} cannot be {dtype}")
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"expected an array of {dtype}, got another or none") from error
    return made
