"""Weighted draws, and as many equally weighted ones as are wanted."""

import numpy as np


def weights(log: np.ndarray) -> np.ndarray:
    """Normalised, of logarithms, shape [N]."""
    weight = np.exp(log - log.max())
    return weight / weight.sum()


def systematic(rng: np.random.Generator, weight: np.ndarray, count: int) -> np.ndarray:
    """Places of `count` draws, each as often as its weight says, to within one: a single uniform number is drawn."""
    points = (np.arange(count) + rng.random()) / count
    return np.minimum(np.searchsorted(np.cumsum(weight), points), len(weight) - 1)
