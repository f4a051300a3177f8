"""Reading a table of records: what is a number, which column holds the times, and which records are missing.

It needs NumPy and no JAX, as processes that simulate do.
"""

import numpy as np

TIME_UNITS = ("second", "minute", "hour", "day", "week", "month", "year")
TIME_COLUMNS = (
    *("", "time", "times", "timestamp", "date", "datetime", "step", "index"),
    *TIME_UNITS,
    *(f"{unit}s" for unit in TIME_UNITS),
)
"""Headings, without a unit in brackets, of a first column that is not a channel where it increases; case does not
matter. pandas' index has an empty one. A small t is one, too, but no T, which may be a temperature."""

JITTER = 0.2
"""Fraction of a step by which the times of a regular recording may differ from a whole number of steps."""


def is_number(cell: str) -> bool:
    """Whether a cell of a table is a number."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def is_time(heading: str) -> bool:
    """Whether a first column of this heading has times or indices.

    Example:
        >>> is_time("Time (s)"), is_time("position")
        (True, False)
    """
    name = heading.partition("(")[0].partition("[")[0].strip()
    return name == "t" or name.lower() in TIME_COLUMNS


def missing_records(times: np.ndarray, length: int) -> np.ndarray | None:
    """Which records of a regular recording its times lack.

    Args:
        times: of the existing records, increasing, shape [R].
        length: expected number of records, T.

    Returns:
        True where a record is missing, shape [T]; None unless the times are those of T records at equal intervals, of
        which some between the first and the last are missing.

    Example:
        >>> missing_records(np.array([0.0, 0.5, 1.0, 2.5]), 6)
        array([False, False, False,  True,  True, False])
        >>> missing_records(np.array([0.0, 0.5, 1.0, 2.5]), 4) is None  # nothing is missing
        True
    """
    if not 2 < len(times) < length:
        return None
    steps = np.diff(times) * (length - 1) / (times[-1] - times[0])
    whole = np.rint(steps).astype(int)
    if whole.min() != 1 or whole.sum() + 1 != length or np.abs(steps - whole).max() > JITTER:
        return None
    missing = np.ones(length, bool)
    missing[np.concatenate([[0], np.cumsum(whole)])] = False
    return missing
