"""The bootstrap interval of a mean over runs."""

import numpy as np
from jaxtyping import Float

RESAMPLES = 2000
"""Bootstrap resamples."""


def bootstrap_interval(values: Float[np.ndarray, " n"], level: float = 0.95) -> tuple[float, float]:
    """Percentile bootstrap interval of a mean, with a fixed seed.

    Args:
        values: one per run, shape [n].
        level: of the interval.

    Example:
        >>> low, high = bootstrap_interval(np.arange(10.0))
        >>> low < 4.5 < high
        True
    """
    rng = np.random.default_rng(0)
    means = np.mean(rng.choice(values, (RESAMPLES, len(values))), axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)
