"""The mass of any density inside a region, and draws from there if the mass is tiny."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.region import Region
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncated_mixture import candidates, log_mass, truncated_mixture_draws
from jaxlfi.distributions.truncation import MASS_DRAWS, Sampler, mass_inside

POINTS = 512
"""Number of weighted points from each of the mixture, the prior and the box for the estimate of a small mass."""
CANDIDATES = 32
"""Number of weighted candidates for each draw."""
WIDER = 1.25
"""Factor by which they are drawn wider than the mixture: the density's tails may be heavier."""
BLOCK = 256
"""Number of draws made at a time, which bounds the memory for their candidates."""


def log_mass_inside(density: Any, mixture: GaussianMixture, region: Support | Region) -> Float[Array, ""]:
    """Logarithm of the mass of a density in a region, even if it is tiny; the same each time.

    The mass of a mixture in a box needs no draws of it (`truncated_mixture.log_mass`). For any other density it is the
    share of its draws that lie inside, or an importance sampling estimate from points inside the box, whichever has the
    smaller variance: nearly always the second if no draw lies inside.

    Args:
        density: density over inference space, with `log_prob` and `sample`.
        mixture: mixture that is like the density inside the box.
        region: a box, or the part of one where a prior is not zero.
    """
    if isinstance(density, GaussianMixture) and isinstance(region, Support):
        return log_mass(density, region)
    box = region if isinstance(region, Support) else region.box
    share = mass_inside(density.sample, region)
    key_box, key_draws, key_prior = jax.random.split(jax.random.key(1), 3)
    sources = [mixture] if region is box else [mixture, _like(region.sample(key_prior, POINTS))]
    keys = jax.random.split(key_draws, len(sources))
    draws = [truncated_mixture_draws(key, one, box, POINTS) for key, one in zip(keys, sources, strict=True)]
    theta = jnp.concatenate([box.sample(key_box, POINTS), *draws])
    uniform = jnp.full(len(theta), -jnp.sum(jnp.log(box.width)))
    log_each = jnp.stack([uniform, *(one.log_prob(theta) - log_mass(one, box) for one in sources)])
    log_drawn = jax.nn.logsumexp(log_each, axis=0) - np.log(len(log_each))
    log_weight = jnp.where(region.contains(theta), density.log_prob(theta) - log_drawn, -jnp.inf)
    log_weight = jnp.where(jnp.isnan(log_weight), -jnp.inf, log_weight)
    estimate = jax.nn.logsumexp(log_weight) - np.log(len(theta))
    # Squared relative errors of the two: of a share, and of a mean of weights.
    of_share = jnp.where(share > 0, (1 - share) / jnp.maximum(share * MASS_DRAWS, 1e-30), jnp.inf)
    effective = jnp.exp(2 * jax.nn.logsumexp(log_weight) - jax.nn.logsumexp(2 * log_weight))
    of_estimate = jnp.where(effective > 0, 1 / effective - 1 / len(theta), jnp.inf)
    return jnp.where(of_estimate < of_share, estimate, jnp.log(share))


def _like(draws: Float[Array, "n dim"]) -> GaussianMixture:
    """A Gaussian with the mean and covariance of draws."""
    mean = jnp.mean(draws, axis=0)
    scale = jnp.maximum(jnp.std(draws, axis=0), 1e-6 * (1 + jnp.abs(mean)))
    z = (draws - mean) / scale
    covariance = z.T @ z / len(draws) + 1e-3 * jnp.eye(draws.shape[-1])
    return GaussianMixture(jnp.zeros(1), mean[None], (scale[:, None] * jnp.linalg.cholesky(covariance))[None])


def rare_draws(density: Any, mixture: GaussianMixture, region: Support | Region) -> Sampler:
    """A sampler of a density truncated to a region inside which next to none of its own draws lie.

    A mixture in a box is sampled by `truncated_mixture_draws`. For any other density each draw is one of `CANDIDATES`
    draws of the truncated mixture, picked by weight; if the prior is zero at all of these, it is one of as many draws
    of the prior.

    Args:
        density: density over inference space, with `log_prob`.
        mixture: mixture that is like the density inside the box.
        region: a box, or the part of one where a prior is not zero.
    """
    if isinstance(density, GaussianMixture) and isinstance(region, Support):
        return lambda key, n: truncated_mixture_draws(key, density, region, n)
    box = region if isinstance(region, Support) else region.box
    mixture = mixture.inflated(WIDER)

    def block(key: jax.Array, n: int) -> Array:
        key_mixture, key_anywhere, key_pick, key_other = jax.random.split(key, 4)
        theta, log_weight = candidates(key_mixture, mixture, box, (n, CANDIDATES))
        log_weight = log_weight + density.log_prob(theta) - mixture.log_prob(theta)
        near, found = _picked(key_pick, theta, jnp.where(region.contains(theta), log_weight, -jnp.inf))
        if isinstance(region, Support):
            return near
        theta = region.sample(key_anywhere, n * CANDIDATES).reshape(theta.shape)
        log_weight = density.log_prob(theta) - region.log_prior(theta)
        far, _ = _picked(key_other, theta, jnp.where(jnp.isfinite(log_weight), log_weight, -1e30))
        return jnp.where(found[:, None], near, far)

    def sample(key: jax.Array, n: int) -> Array:
        if n <= BLOCK:
            return block(key, n)
        keys = jax.random.split(key, -(-n // BLOCK))
        return jax.lax.map(lambda key: block(key, BLOCK), keys).reshape(-1, box.dim)[:n]

    return sample


def _picked(key: jax.Array, theta: Array, log_weight: Array) -> tuple[Array, Array]:
    """One of the candidates [N, M, D] for each draw, and whether any of them has weight."""
    log_weight = jnp.where(jnp.isnan(log_weight), -jnp.inf, log_weight)
    picked = jax.random.categorical(key, log_weight)
    return jnp.take_along_axis(theta, picked[:, None, None], axis=1)[:, 0], jnp.any(log_weight > -jnp.inf, axis=1)
