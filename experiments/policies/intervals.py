"""Intervals of returns: training seeds and places are both resampled, as either could have been others."""

import numpy as np
from jaxtyping import Float

RESAMPLED = 2000
LEVEL = 0.95


def mean(values: Float[np.ndarray, "seeds places"]) -> tuple[float, float, float]:
    """The mean of policies' returns, and its bootstrap interval.

    Seeds are resampled, and places, which are the same for all seeds. One policy has no seeds to resample.
    """
    return _summary(values.mean(), _means(np.random.default_rng(0), values))


def difference(
    one: Float[np.ndarray, "seeds places"], other: Float[np.ndarray, "others places"]
) -> tuple[float, float, float]:
    """Mean of one minus mean of the other, at the same places, and its bootstrap interval.

    Raises:
        ValueError: for different numbers of places.
    """
    if one.shape[1] != other.shape[1]:
        raise ValueError(f"difference: expected the same places, got {one.shape[1]} and {other.shape[1]}")
    rng = np.random.default_rng(0)
    at = rng.integers(one.shape[1], size=(RESAMPLED, one.shape[1]))
    return _summary(one.mean() - other.mean(), _means(rng, one, at) - _means(rng, other, at))


def text(found: tuple[float, float, float], places: int = 2) -> str:
    """A mean with its interval."""
    middle, low, high = found
    return f"{middle:.{places}f} [{low:.{places}f}, {high:.{places}f}]"


def _means(rng: np.random.Generator, values: np.ndarray, at: np.ndarray | None = None) -> np.ndarray:
    """Means of resampled values, shape [RESAMPLED]."""
    seeds, places = values.shape
    at = rng.integers(places, size=(RESAMPLED, places)) if at is None else at
    counts = lambda index, n: (index[..., None] == np.arange(n)).sum(axis=1) / index.shape[1]
    of_seeds = counts(rng.integers(seeds, size=(RESAMPLED, seeds)), seeds)
    return np.einsum("bs,sp,bp->b", of_seeds, values, counts(at, places))


def _summary(middle: float, means: np.ndarray) -> tuple[float, float, float]:
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(middle), float(low), float(high)
