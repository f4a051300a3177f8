"""Private copies of arrays that users' functions and programs return. It needs only NumPy.

A simulator may reuse its work array for the next simulation, and a user an observation: everything from outside is
copied as it arrives. Missing numbers, masked or pandas' NA, become NaN, and never the number beneath the mask.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

CODES = 2**31 - 1
"""The largest outcome; larger ones stand for no reason of any task."""


def array(value: Any) -> np.ndarray:
    """A private copy of numbers, NaN where they are missing.

    Raises:
        ValueError: for rows of several lengths.

    Example:
        >>> array(np.ma.array([1, 99], mask=[False, True])).tolist()
        [1.0, nan]
    """
    if isinstance(value, np.ma.MaskedArray):
        return _unmasked(value)
    if isinstance(value, list | tuple) and _holds_masked(value):
        return np.array([array(part) for part in value])
    found = np.array(value)
    return _of_table(value, found) if found.dtype == object else found


def copied(value: Any) -> Any:
    """The same value with copies of all NumPy arrays in it, masks included; lists and tuples are searched.

    Example:
        >>> rows = [np.zeros(2)]
        >>> copied(rows)[0] is rows[0]
        False
    """
    if isinstance(value, np.ndarray):
        return value.copy()
    return type(value)(map(copied, value)) if type(value) in (list, tuple) else value


def missing(value: Any) -> int:
    """How many of an array's entries are masked or NA.

    Example:
        >>> missing(np.ma.array([1, 99], mask=[False, True])), missing([1.0, float("nan")])
        (1, 0)
    """
    if isinstance(value, np.ma.MaskedArray):
        return int(np.ma.count_masked(value))
    if isinstance(value, list | tuple):
        return sum(map(missing, value)) if _holds_masked(value) else 0
    plain = np.asarray(value) if hasattr(value, "isna") else None
    if plain is None or plain.dtype != object:
        return 0
    return int(np.sum(np.asarray(value.isna())))


def outcomes(value: Any) -> np.ndarray:
    """Outcomes as given: booleans (true: valid), or whole numbers (0: valid) as int64.

    Raises:
        ValueError: for anything else: 1.0 may mean "valid" or "failed for the first reason".

    Example:
        >>> outcomes([0, 2]).tolist(), outcomes(True).tolist()
        ([0, 2], True)
    """
    missed = missing(value) > 0
    found = np.array(0.0 if missed else value)
    if found.dtype.kind not in "biu":
        got = described(value) if missed or found.ndim else repr(found.item())
        raise ValueError(f"expected true or false, or a whole number (0: valid), as outcome, got {got}")
    if found.dtype == bool:
        return found
    limited = np.minimum(found, CODES) if found.dtype == np.uint64 else found  # int64 has no room for all of these
    return np.clip(limited.astype(np.int64), -1, CODES)


def places(rows: Any) -> list[Any]:
    """The place in memory of each element of a list, or None: equal places hold the same numbers.

    None is for elements that cannot be written to, whose numbers do not change either.
    """
    return [_place(row) for row in rows] if isinstance(rows, list | tuple) else []


def require_own_rows(value: Any) -> None:
    """Refuse a list that holds one work array for every record, with the numbers of the last record only.

    Raises:
        ValueError: saying to append a copy.
    """
    found = places(value)
    if len(found) > 1 and found[0] is not None and len(set(found)) == 1:
        raise ValueError(
            f"expected a separate array for each record, got the same one {len(found)} times, with the last record's "
            "numbers: append a copy"
        )


def described(value: Any) -> str:
    """The type and shape of an array in words."""
    if missing(value):
        return "a masked array"
    found = np.asarray(value)
    return f"{found.dtype} of shape {list(found.shape)}"


def _place(row: Any) -> tuple | None:
    if isinstance(row, list):
        return id(row), None, None
    if isinstance(row, np.ndarray):
        found = row
    elif hasattr(row, "__array__"):
        found = np.asarray(row)
    else:
        try:
            found = np.asarray(memoryview(row))  # ctypes' arrays and bytearrays
        except (TypeError, ValueError):
            return None
    if found.size == 0 or found.ndim == 0 or not found.flags.writeable:
        return None
    return found.__array_interface__["data"][0], found.strides, found.shape


def _holds_masked(value: Sequence[Any]) -> bool:
    return any(
        isinstance(part, np.ma.MaskedArray) or (isinstance(part, list | tuple) and _holds_masked(part))
        for part in value
    )


def _unmasked(value: Any) -> np.ndarray:
    if not np.ma.is_masked(value):
        return np.array(value.data)
    if value.dtype.kind not in "biufc":
        return np.array(value.astype(object).filled(None))
    return value.astype(np.result_type(value.dtype, np.float32)).filled(np.nan)


def _of_table(value: Any, found: np.ndarray) -> np.ndarray:
    """A pandas table with columns of numbers, some of them NA, as floats; anything else as NumPy converts it."""
    kinds = getattr(value, "dtypes", None)
    if kinds is None or not hasattr(value, "to_numpy"):
        return found
    kinds = [kinds] if isinstance(kinds, np.dtype) or not hasattr(kinds, "__iter__") else kinds
    if not all(getattr(kind, "kind", "O") in "biuf" for kind in kinds):
        return found
    return value.to_numpy(dtype=float, na_value=np.nan)
