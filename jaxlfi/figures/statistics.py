"""Mean, standard deviation and median of the values that are not NaN; NaN where there are none."""

import numpy as np


def mean(values: np.ndarray, axis: int | tuple[int, ...] | None = None) -> np.ndarray:
    """Mean of the values that are not NaN."""
    values = np.asarray(values, float)
    there = ~np.isnan(values)
    count = there.sum(axis)
    total = np.where(there, values, 0.0).sum(axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def sd(values: np.ndarray, axis: int | tuple[int, ...] | None = None) -> np.ndarray:
    """Sample standard deviation (n - 1) of the values that are not NaN; 0 for a single one."""
    values = np.asarray(values, float)
    there = ~np.isnan(values)
    count = there.sum(axis)
    centre = mean(values, axis)
    if axis is not None:
        centre = np.expand_dims(centre, axis)
    squares = np.where(there, (values - centre) ** 2, 0.0).sum(axis)
    return np.where(count > 0, np.sqrt(squares / np.maximum(count - 1, 1)), np.nan)


def median(values: np.ndarray) -> float:
    """Median of the values that are not NaN."""
    values = np.asarray(values, float)
    values = values[~np.isnan(values)]
    return float(np.median(values)) if values.size else float("nan")
