"""A normal approximation of a density, checked and corrected by adaptive importance sampling.

Least squares assumes that simulations are linear in the parameters. Draws from a wider proposal, with importance
weights, have the true moments, and their effective sample size shows whether these can be trusted. While it is small,
the next proposal takes its moments from the weighted draws (Oh and Berger 1992; Cappe et al. 2004).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp
from scipy.stats import multivariate_t

DRAWS = 256
"""Draws from each proposal."""
TIMES = 4
"""Largest number of proposals."""
ENOUGH = 0.25
"""Effective sample size that moments need, as a fraction of the draws."""
WIDER = 1.2
"""Factor by which a proposal is wider than the moments so far, besides its heavier tails."""
DEGREES = 5
"""Degrees of freedom of the proposal, a Student's t, whose tails are heavier than a normal's."""


class Moments(NamedTuple):
    """Moments of a density over K variables that is known up to a constant.

    Attributes:
        mean: shape [K].
        covariance: shape [K, K].
        log_mass: logarithm of the density's integral.
        counted: effective sample size, as a fraction of the draws.
        draws: number of draws made.
    """

    mean: Float[np.ndarray, " k"]
    covariance: Float[np.ndarray, "k k"]
    log_mass: float
    counted: float
    draws: int


def moments(
    rng: np.random.Generator, log_density: Callable[[Float[np.ndarray, "n k"]], Float[np.ndarray, " n"]], k: int
) -> Moments:
    """Moments of a density that is close to a standard normal one.

    If the effective sample size stays below `ENOUGH`, they cannot be trusted (`Moments.counted`).

    Args:
        rng: of the draws.
        log_density: logarithm of the density up to a constant; -inf where the density is 0.
        k: K.

    Example:
        >>> found = moments(np.random.default_rng(0), lambda y: -0.5 * ((y[:, 0] - 0.5) / 0.8) ** 2, 1)
        >>> bool(abs(found.mean[0] - 0.5) < 0.15 and abs(found.covariance[0, 0] / 0.64 - 1) < 0.3)
        True
    """
    mean, covariance = np.zeros(k), np.eye(k)
    for time in range(1, TIMES + 1):
        proposal = multivariate_t(mean, WIDER**2 * covariance, DEGREES)
        y = np.reshape(proposal.rvs(DRAWS, random_state=rng), (DRAWS, k))
        excess = log_density(y) - np.reshape(proposal.logpdf(y), DRAWS)
        if not np.isfinite(excess).any():
            return Moments(mean, covariance, -np.inf, 0.0, time * DRAWS)
        counted = effective_size(excess) / DRAWS
        log_mass = float(logsumexp(excess)) - np.log(DRAWS)
        weights = np.exp(power_for(excess, ENOUGH * DRAWS) * (excess - excess.max()))
        weights /= weights.sum()
        mean = weights @ y
        covariance = (y - mean).T @ (weights[:, None] * (y - mean)) + 1e-9 * np.eye(k)
        if counted >= ENOUGH:
            break
    return Moments(mean, covariance, log_mass, counted, time * DRAWS)


def effective_size(excess: Float[np.ndarray, " n"]) -> float:
    """Effective sample size of draws whose weights have these logarithms (Kish 1965)."""
    return float(np.exp(2 * logsumexp(excess) - logsumexp(2 * excess)))


def power_for(excess: Float[np.ndarray, " n"], size: float) -> float:
    """The power of the weights, at most one, that leaves at least this effective sample size."""
    power = 1.0
    while effective_size(power * excess) < size and power > 1e-6:
        power *= 0.8
    return power
