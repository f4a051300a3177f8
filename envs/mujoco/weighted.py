"""Adaptive multiple importance sampling: a density that is not Gaussian, learnt by evaluating it.

Draws are made in batches, each from the mixture of Gaussians that fits all earlier draws best, with heavier tails. All
batches are combined: the weight of a draw is its density divided by the mean of all batches' proposal densities
(Cornuet, Marin, Mira and Robert 2012). As long as a few draws hold nearly all of the weight, weights are tempered by a
power below one, so that mixtures narrow step by step.
"""

import functools
from collections.abc import Callable, Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.special import log_softmax, logsumexp
from scipy.stats import multivariate_t

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.mixture_fit import fit_mixture
from jaxlfi.envs.mujoco.importance import DEGREES, WIDER, effective_size, power_for
from jaxlfi.io.executables import quickly

DRAWS = 256
"""Draws in a batch."""
BATCHES = 24
"""Largest number of batches."""
ENOUGH = 384
"""Effective sample size that all draws together need."""
LEAST = 64
"""Effective sample size that tempering keeps for the fit of a mixture."""
HOPELESS = 0.1
"""Tempering power of the weights at half of the batches below which sampling stops there."""
FIRST = 1.5
"""Factor by which the first proposal is wider than the given Gaussian."""
PICKED, ITERATIONS = 1024, 30
"""Number of draws that a mixture is fitted to, and of iterations of the fit."""
COMPONENTS = 2
"""Components of a mixture: with more, tails are lost by chance; a single one cannot follow a curved ridge."""


class Learnt(NamedTuple):
    """A learnt density over K variables.

    Attributes:
        mixture: mixture of Gaussians that is nearest to the density.
        size: effective sample size of the draws; below `ENOUGH` the mixture cannot be trusted.
        draws: number of draws made.
    """

    mixture: GaussianMixture
    size: float
    draws: int


class _Proposal(NamedTuple):
    """A mixture of Student's t; fields [C], [C, K], [C, K, K]."""

    log_weights: np.ndarray
    means: np.ndarray
    factors: np.ndarray

    def draws(self, rng: np.random.Generator, n: int) -> Float[np.ndarray, "n k"]:
        which = rng.choice(len(self.means), n, p=np.exp(self.log_weights))
        steps = rng.standard_normal((n, self.means.shape[1])) / np.sqrt(rng.chisquare(DEGREES, (n, 1)) / DEGREES)
        return self.means[which] + np.einsum("nij,nj->ni", self.factors[which], steps)

    def log_prob(self, y: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
        parts = [
            weight + np.reshape(multivariate_t.logpdf(y, mean, factor @ factor.T, DEGREES), len(y))
            for weight, mean, factor in zip(*self, strict=True)
        ]
        return logsumexp(parts, axis=0)


_fitted = jax.jit(functools.partial(fit_mixture, components=COMPONENTS, iterations=ITERATIONS))


def learnt(
    rng: np.random.Generator,
    log_density: Callable[[Float[np.ndarray, "n k"]], Float[np.ndarray, " n"]],
    correlation: Float[np.ndarray, "k k"],
    counted: Callable[[range], Iterable[int]] = iter,
) -> Learnt:
    """The mixture of Gaussians nearest to a density whose variables are about 0, with deviations of about 1.

    Args:
        rng: of the draws.
        log_density: logarithm of the density up to a constant; -inf where the density is 0.
        correlation: of the variables, as far as it is known.
        counted: iterates over the batches, as a progress bar does.

    Example:
        >>> banana = lambda y: -0.5 * ((y[:, 0] / 0.8) ** 2 + ((y[:, 1] - 0.5 * y[:, 0] ** 2) / 0.2) ** 2)
        >>> found = learnt(np.random.default_rng(0), banana, np.eye(2))
        >>> spread = np.sqrt(np.diagonal(found.mixture.covariance))
        >>> bool(found.size > ENOUGH and abs(spread[0] / 0.8 - 1) < 0.1 and abs(spread[1] / 0.495 - 1) < 0.2)
        True
    """
    k = len(correlation)
    mixture = GaussianMixture(jnp.zeros(1), jnp.zeros((1, k)), jnp.asarray(np.linalg.cholesky(correlation)[None]))
    proposals, y, log, size, wider = [], np.zeros((0, k)), np.zeros(0), 0.0, FIRST
    for batch in counted(range(BATCHES)):
        proposals.append(_proposal(mixture, wider))
        new, wider = proposals[-1].draws(rng, DRAWS), WIDER
        y, log = np.concatenate([y, new]), np.concatenate([log, log_density(new)])
        excess = log - logsumexp([one.log_prob(y) for one in proposals], axis=0)
        if not np.isfinite(excess).any():
            break
        size, power = effective_size(excess), power_for(excess, LEAST)
        mixture = _mixture(batch, y, np.exp(power * (excess - excess.max())))
        if size >= ENOUGH or (batch == BATCHES // 2 and power < HOPELESS):
            break
    return Learnt(mixture, size, len(y))


def _proposal(mixture: GaussianMixture, wider: float) -> _Proposal:
    logits, means, factors = (np.asarray(one, float) for one in (mixture.logits, mixture.means, mixture.scale_tril))
    there = np.isfinite(logits)
    return _Proposal(log_softmax(logits[there]), means[there], wider * factors[there])


def _mixture(batch: int, y: Float[np.ndarray, "n k"], weights: Float[np.ndarray, " n"]) -> GaussianMixture:
    """The maximum-likelihood mixture of a fixed number of draws, resampled systematically by their weights."""
    total = np.cumsum(weights)
    picked = y[np.searchsorted(total, (np.arange(PICKED) + 0.5) / PICKED * total[-1])]
    key = jax.random.fold_in(jax.random.key(0), batch)
    return quickly(_fitted, key, jnp.asarray(picked, jnp.float32), jnp.ones(PICKED))[0]
