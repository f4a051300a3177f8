"""Intervals of returns: training seeds and places are both resampled, as both are random samples."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

RESAMPLED = 2000
LEVEL = 0.95


def mean(values: Float[np.ndarray, "seeds places"]) -> tuple[float, float, float]:
    """The mean of policies' returns, and its bootstrap interval.

    Seeds are resampled, and so are places, which all seeds share. A single policy has no seeds to resample.
    """
    rng = np.random.default_rng(0)
    return _summary(values.mean(), _means(rng, values, _shares(rng, values.shape[1])))


def difference(
    one: Float[np.ndarray, "seeds places"], other: Float[np.ndarray, "others places"]
) -> tuple[float, float, float]:
    """The mean of one minus the mean of the other, at the same places, and its bootstrap interval."""
    return contrast([one], [other])


def contrast(plus: Sequence[np.ndarray], minus: Sequence[np.ndarray]) -> tuple[float, float, float]:
    """The mean over some domains' policies minus that over others', at the same places, and its bootstrap interval.

    Seeds of different entries are resampled separately. The results of the same policies on several objects therefore
    have to be one entry, their mean over the objects.

    Raises:
        ValueError: for different numbers of places.
    """
    counts = {values.shape[1] for values in (*plus, *minus)}
    if len(counts) != 1:
        raise ValueError(f"places: expected the same everywhere, got {sorted(counts)} of them")
    rng = np.random.default_rng(0)
    of_places = _shares(rng, counts.pop())
    resampled = lambda entries: np.mean([_means(rng, values, of_places) for values in entries], axis=0)
    middle = lambda entries: np.mean([values.mean() for values in entries])
    return _summary(middle(plus) - middle(minus), resampled(plus) - resampled(minus))


def text(found: tuple[float, float, float], places: int = 2) -> str:
    """A mean with its interval."""
    middle, low, high = found
    return f"{middle:.{places}f} [{low:.{places}f}, {high:.{places}f}]"


def _shares(rng: np.random.Generator, n: int) -> np.ndarray:
    """Weights of n values in bootstrap resamples: the fraction of draws that each receives, shape [RESAMPLED, n]."""
    return rng.multinomial(n, np.full(n, 1 / n), RESAMPLED) / n


def _means(rng: np.random.Generator, values: np.ndarray, of_places: np.ndarray) -> np.ndarray:
    """Means of resampled seeds at resampled places, shape [RESAMPLED]."""
    return np.einsum("bp,bp->b", _shares(rng, len(values)) @ values, of_places)


def _summary(middle: float, means: np.ndarray) -> tuple[float, float, float]:
    low, high = np.quantile(means, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(middle), float(low), float(high)
