"""Draws of a mixture of Gaussians truncated to a box, also where next to nothing of it lies inside."""

import jax
import jax.numpy as jnp
from jax.scipy.special import log_ndtr, ndtri
from jaxtyping import Array, Float

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support

CANDIDATES = 64
"""Number of weighted candidates that each draw is resampled from."""
TAIL = 4.0
"""Standard deviations from the mean beyond which the tail of a normal is drawn from as an exponential, and weighted."""


def truncated_mixture_draws(key: jax.Array, mixture: GaussianMixture, support: Support, n: int) -> Array:
    """`n` draws of a mixture truncated to the support, by importance resampling; rejection has no part in it.

    Candidates are drawn dimension by dimension, each from its normal given the ones before, truncated to the box
    (Geweke 1991; Hajivassiliou and Keane): all lie inside, however far the mixture is from it. Components that have
    little mass in the box are chosen as rarely. The weight of a candidate is the product of the masses that truncation
    left, divided by what its component was favoured by, and each draw is one of `CANDIDATES` picked by weight, so that
    it is as good as exact where few dimensions are truncated.

    Args:
        key: consumed.
        mixture: of Gaussians.
        support: the box.
        n: number of draws.
    """
    key_component, key_uniform, key_pick = jax.random.split(key, 3)
    shape = (n, CANDIDATES)
    logits, log_share = _by_marginals(mixture, support)
    component = jax.random.categorical(key_component, logits, shape=shape)
    uniform = jax.random.uniform(key_uniform, (*shape, support.dim), minval=1e-6, maxval=1.0)

    def candidate(component: Array, uniform: Array) -> tuple[Array, Array]:
        mean, factor = mixture.means[component], mixture.scale_tril[component]

        def next_dimension(d: Array, drawn: tuple[Array, Array]) -> tuple[Array, Array]:
            z, log_weight = drawn
            given = mean[d] + factor[d] @ z  # entries of z from d on are still zero
            low, high = (support.low[d] - given) / factor[d, d], (support.high[d] - given) / factor[d, d]
            value, log_mass = _truncated_normal(uniform[d], low, high)
            return z.at[d].set(value), log_weight + log_mass

        nothing = jnp.zeros(support.dim), -log_share[component]
        z, log_weight = jax.lax.fori_loop(0, support.dim, next_dimension, nothing)
        return support.clip(mean + factor @ z), log_weight

    theta, log_weight = jax.vmap(jax.vmap(candidate))(component, uniform)
    picked = jax.random.categorical(key_pick, log_weight)
    return jnp.take_along_axis(theta, picked[:, None, None], axis=1)[:, 0]


def _by_marginals(mixture: GaussianMixture, support: Support) -> tuple[Array, Array]:
    """Logits to draw candidates' components by, and what they have in addition to the mixture's own.

    The mass inside, dimension by dimension: a component far from the box is rarely worth a candidate.
    """
    scales = mixture.marginal_scales
    one = lambda low, high: _truncated_normal(jnp.float32(0.5), low, high)[1]
    log_mass = jax.vmap(jax.vmap(one))((support.low - mixture.means) / scales, (support.high - mixture.means) / scales)
    log_share = jnp.sum(log_mass, axis=-1)
    return mixture.logits + log_share, log_share


def _truncated_normal(
    uniform: Float[Array, ""], low: Float[Array, ""], high: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """A draw by a uniform number of the standard normal truncated to [low, high], and the logarithm of its weight.

    The weight is the mass in there, and in the tail, where draws are exponential, the normal density over theirs.
    """
    flip = low + high < 0  # to the side of the upper tail, where small masses keep their precision
    near, far = jnp.where(flip, -high, low), jnp.where(flip, -low, high)
    log_beyond_near, log_beyond_far = log_ndtr(-jnp.stack([near, far]))
    log_mass = log_beyond_near + jnp.log1p(-jnp.exp(jnp.minimum(log_beyond_far - log_beyond_near, -1e-7)))
    beyond_near, beyond_far = jnp.exp(log_beyond_near), jnp.exp(log_beyond_far)
    middle = -ndtri(jnp.clip(beyond_near - uniform * (beyond_near - beyond_far), 1e-37, 1.0 - 1e-7))
    # Beyond a of a few standard deviations the density falls about as exp(-a (z - a)).
    rate = jnp.maximum(near, TAIL)
    all_beyond = -jnp.expm1(-rate * (far - near))
    excess = -jnp.log1p(-uniform * all_beyond) / rate
    log_ratio = jnp.log(all_beyond / rate) - 0.5 * (excess**2 + near**2 + jnp.log(2 * jnp.pi))
    value = jnp.clip(jnp.where(near > TAIL, near + excess, middle), near, far)
    return jnp.where(flip, -value, value), jnp.where(near > TAIL, log_ratio, log_mass)
