"""Time stamps that repeat, go back or are missing: the affected rows in words, and the order of the usable ones."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

SHOWN = 5
"""Largest number of rows of a kind that are listed."""


class Order(NamedTuple):
    """Samples in the order of their times.

    Attributes:
        rows: indices of the samples in order, without those that have no time, shape [N].
        fault: what is wrong with the times as recorded, in one line; "" if nothing is.
    """

    rows: Int[np.ndarray, " rows"]
    fault: str


def order(times: np.ndarray, row: str = "row", repeated: bool = False) -> Order:
    """The order of samples in time; samples with equal times keep their order.

    Args:
        times: time stamps, shape [T].
        row: word for a sample.
        repeated: whether a time may have several samples.

    Example:
        >>> order(np.array([0.0, 2.0, 2.0, 1.0, 3.0]))
        Order(rows=array([0, 3, 1, 2, 4]), fault='2 in row 3 after 2; row 3 repeats a time and row 4 goes back')
        >>> order(np.array([0, 1, np.inf])).fault
        'inf in row 3'
    """
    lost = np.flatnonzero(~np.isfinite(times)) if times.dtype.kind == "f" else np.zeros(0, int)
    if len(lost):
        kept = np.setdiff1d(np.arange(len(times)), lost)
        others = f"; {listed(lost, row)} have none" if len(lost) > 1 else ""
        return Order(kept[np.argsort(times[kept], kind="stable")], f"{times[lost[0]]} in {row} {lost[0] + 1}{others}")
    same = 1 + np.flatnonzero(times[1:] == times[:-1]) if not repeated else np.zeros(0, int)
    back = 1 + np.flatnonzero(times[1:] < times[:-1])
    rows = np.argsort(times, kind="stable")
    if not len(same) + len(back):
        return Order(rows, "")
    first = min([*same[:1], *back[:1]])
    text = f"{_number(times[first])} in {row} {first + 1} after {_number(times[first - 1])}"
    if len(same) + len(back) > 1:
        repeats = f"{listed(same, row)} repeat{_s(same)} a time" if len(same) else ""
        goes = f"{listed(back, row)} {'goes' if _s(back) else 'go'} back" if len(back) else ""
        text += f"; {' and '.join(part for part in (repeats, goes) if part)}"
    return Order(rows, text)


def listed(rows: Sequence[int] | np.ndarray, row: str = "row") -> str:
    """Rows in words, numbered from one.

    Example:
        >>> listed([2]), listed([2, 6, 8]), listed(range(9), "sample")
        ('row 3', 'rows 3, 7 and 9', 'samples 1, 2, 3, 4, 5 and 4 more')
    """
    numbers = [str(number + 1) for number in rows[:SHOWN]]
    if len(rows) > SHOWN:
        numbers.append(f"{len(rows) - SHOWN} more")
    text = f"{', '.join(numbers[:-1])} and {numbers[-1]}" if len(numbers) > 1 else numbers[0]
    return f"{row}{'s' if len(rows) > 1 else ''} {text}"


def _number(time: np.generic) -> str:
    """A time with all its digits, as times of a clock in ns differ only in the last ones."""
    return str(int(time)) if isinstance(time, np.integer) else f"{time:.15g}"


def _s(rows: np.ndarray) -> str:
    return "s" if len(rows) == 1 else ""
