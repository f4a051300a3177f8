"""Checks of whether draws of a posterior can be trusted; if not, their intervals are not reported."""

import numpy as np

EXPLAINED = 5.0
"""Standard deviations by which the sum of squared residuals may exceed that of the noise."""
MOVED = 3.0
"""Smallest mean number of moves of a particle at the end: with fewer, copies of one particle are still together."""


class UntrustedError(RuntimeError):
    """A sampler did not find the posterior."""


def explained(misfit: float, size: int) -> bool:
    """Whether noise explains the residuals of the parameters that fit best.

    Args:
        misfit: half the sum of squared residuals, in standard deviations of the noise.
        size: number of recorded values.
    """
    return misfit <= 0.5 * (size + EXPLAINED * np.sqrt(2 * size))


def require_explained(misfit: float, size: int) -> None:
    """Refuse a best draw that noise does not explain: the study's model explains its truths, so the sampler lost them.

    Raises:
        UntrustedError: in one line.
    """
    if not explained(misfit, size):
        raise UntrustedError(f"expected squared residuals that sum to about {size}, got {2 * misfit:.0f} at the least")


def require_moved(moves: float) -> None:
    """Refuse particles that hardly move, as they are still where they were resampled.

    Raises:
        UntrustedError: in one line.
    """
    if moves < MOVED:
        raise UntrustedError(f"expected particles that move {MOVED:g} times at the end, got {moves:.1f}")
