"""When draws of a posterior cannot be trusted: nothing is said of their intervals then."""

import numpy as np

EXPLAINED = 5.0
"""Standard deviations by which the sum of squared residuals may exceed that of the noise."""
MOVED = 3.0
"""How often a particle must have moved at the end, on average: copies of one another are still together otherwise."""


class UntrustedError(RuntimeError):
    """A sampler did not find the posterior."""


def explained(misfit: float, size: int) -> bool:
    """Whether noise can leave such residuals of the parameters that fit best.

    Args:
        misfit: half the sum of squared residuals, in standard deviations of the noise.
        size: how many were recorded.
    """
    return misfit <= 0.5 * (size + EXPLAINED * np.sqrt(2 * size))


def require_explained(misfit: float, size: int) -> None:
    """Truths of a study are explained by its model: a sampler whose best draw is not has lost them.

    Raises:
        UntrustedError: in one line.
    """
    if not explained(misfit, size):
        raise UntrustedError(f"expected squared residuals that sum to about {size}, got {2 * misfit:.0f} at the least")


def require_moved(moves: float) -> None:
    """Particles that hardly move are where they were put.

    Raises:
        UntrustedError: in one line.
    """
    if moves < MOVED:
        raise UntrustedError(f"expected particles that move {MOVED:g} times at the end, got {moves:.1f}")
