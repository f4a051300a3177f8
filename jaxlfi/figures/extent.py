"""Extent: which part of an axis draws are shown on, and how finely, also where a few of them lie far away."""

import math

import numpy as np

REACH = 8.0
"""Distance from the densest half of the draws, in widths of that half, beyond which a draw is far away."""
MOST = 0.01
"""Largest fraction of the draws that is left out at either end."""
FEW = 20
"""So few draws are all shown."""
ONE_PLACE = 1e-12
"""Width of draws, relative to their magnitude, up to which they are drawn as if they were all in one place."""


def extent(draws: np.ndarray) -> tuple[float, float]:
    """Ends of the part of an axis that shows the draws: all of them, but for a few that are far away.

    Args:
        draws: finite, shape [n], n >= 1.

    Returns:
        Lower and upper end, the lower one below the upper one; around draws that are all in one place.

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
        """The lower end, of values in ascending order: the first that is not far away."""
        return min(values[np.searchsorted(values, limit)], values[most])

    low, high = float(end(ordered, low - near)), -float(end(-ordered[::-1], -high - near))
    if high - low > ONE_PLACE * max(abs(low), abs(high)):
        return low, high
    half = 0.05 * abs(low) or 0.5
    return low - half, high + half


def cells(draws: np.ndarray, width: float, per_half: float, fewest: int, most: int) -> int:
    """How many cells to divide a part of an axis into, so that the densest half of the draws is seen to have a shape.

    Args:
        draws: finite, shape [n].
        width: of the part of the axis.
        per_half: cells to the shortest interval that holds half of the draws.
        fewest: cells at least.
        most: cells at most.
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
