"""Resampling of weighted draws."""

import numpy as np


def weights(log: np.ndarray) -> np.ndarray:
    """Normalised weights from their logarithms, shape [N]."""
    weight = np.exp(log - log.max())
    return weight / weight.sum()


def systematic(rng: np.random.Generator, weight: np.ndarray, count: int) -> np.ndarray:
    """Indices of `count` draws, each as often as its weight says to within one, from a single uniform number."""
    points = (np.arange(count) + rng.random()) / count
    return np.minimum(np.searchsorted(np.cumsum(weight), points), len(weight) - 1)
