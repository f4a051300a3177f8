"""Extent: the part of an axis on which draws are shown, and its resolution, robust to a few distant outliers."""

import math

import numpy as np

REACH = 8.0
"""Distance from the densest half of the draws, in widths of that half, beyond which a draw is an outlier."""
MOST = 0.01
"""Largest fraction of the draws that is left out at either end."""
FEW = 20
"""Number of draws below which all are shown."""
ONE_PLACE = 1e-12
"""Largest width of draws, relative to their magnitude, at which they are drawn as if they were identical."""


def extent(draws: np.ndarray) -> tuple[float, float]:
    """Ends of the part of an axis that shows the draws, except a few outliers.

    Args:
        draws: finite draws, shape [n], n >= 1.

    Returns:
        Lower and upper end, which differ even if all draws are identical.

    Example:
        >>> bell = np.random.default_rng(0).normal(size=2000)
        >>> [round(end, 1) for end in extent(np.append(bell, 1e6))]
        [-3.9, 3.1]
    """
    ordered = np.sort(np.asarray(draws, float))
    count = len(ordered)
    low, high = _densest_half(ordered)
    near = REACH * (high - low) or math.inf
    most = max(int(MOST * count), int(count >= FEW))

    def end(values: np.ndarray, limit: float) -> float:
        """The lower end for values in ascending order: the first that is not an outlier, or the last one allowed."""
        return min(values[np.searchsorted(values, limit)], values[most])

    low, high = float(end(ordered, low - near)), -float(end(-ordered[::-1], -high - near))
    if high - low > ONE_PLACE * max(abs(low), abs(high)):
        return low, high
    half = 0.05 * abs(low) or 0.5
    return low - half, high + half


def cells(draws: np.ndarray, width: float, per_half: float, fewest: int, most: int) -> int:
    """Number of cells to divide a part of an axis into, so that the shape of the densest half of the draws is visible.

    Args:
        draws: finite draws, shape [n].
        width: width of the part of the axis.
        per_half: number of cells in the shortest interval that holds half of the draws.
        fewest: smallest number of cells.
        most: largest number of cells.
    """
    low, high = _densest_half(np.sort(np.asarray(draws, float)))
    wanted = per_half * width / (high - low) if high > low else 0.0
    return int(np.clip(wanted, fewest, most))


def _densest_half(ordered: np.ndarray) -> tuple[float, float]:
    """The shortest interval that holds half of the draws, in ascending order [n]."""
    half = len(ordered) - len(ordered) // 2
    with np.errstate(over="ignore"):
        place = int(np.argmin(ordered[half - 1 :] - ordered[: len(ordered) - half + 1]))
    return float(ordered[place]), float(ordered[place + half - 1])
