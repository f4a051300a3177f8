"""Estimates the noise of a recorded signal from the signal itself."""

import numpy as np

ORDER = 4
LEAST = 20
"""Samples that an estimate needs."""
_OF_WHITE = np.sqrt(70.0)
"""Standard deviation of fourth differences of white noise of standard deviation 1: of 1, -4, 6, -4, 1."""
_MEDIAN_TO_DEVIATION = 1.4826


def standard_deviation(values: np.ndarray) -> float:
    """The standard deviation of white noise on a smooth signal, by the median of its fourth differences.

    Differences of that order leave nothing of a signal that is nearly a cubic over five samples; the median keeps
    contacts and other jumps out.

    Args:
        values: samples at equal intervals, shape [T]; missing ones (NaN) are left out.

    Raises:
        ValueError: for too few samples.
    """
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    if len(values) < LEAST:
        raise ValueError(
            f"expected at least {LEAST} samples to estimate its noise from, got {len(values)}: state its noise"
        )
    differences = np.diff(values, ORDER)
    return float(_MEDIAN_TO_DEVIATION * np.median(np.abs(differences - np.median(differences))) / _OF_WHITE)
