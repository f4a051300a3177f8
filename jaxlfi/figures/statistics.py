"""Mean, standard deviation, median and quartiles of the values that are not NaN; NaN where there are none."""

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


def quartiles(values: np.ndarray) -> np.ndarray:
    """Lower quartile, median and upper quartile over the first axis of the values that are not NaN, shape [3, ...]."""
    values = np.asarray(values, float)
    known = ~np.isnan(values).all(0)
    found = np.full((3, *values.shape[1:]), np.nan)
    found[:, known] = np.nanquantile(values[:, known], (0.25, 0.5, 0.75), axis=0)
    return found


def median(values: np.ndarray) -> float:
    """Median of the values that are not NaN."""
    values = np.asarray(values, float)
    values = values[~np.isnan(values)]
    return float(np.median(values)) if values.size else float("nan")
