"""A mixture of Gaussians truncated to a box, also where next to nothing of it lies inside: its mass there, and draws.

Both come from points that are drawn dimension by dimension, each from its normal given the ones before, truncated to
the box (Geweke 1991; Hajivassiliou and McFadden 1998; Keane 1994): all of them lie inside, however far the mixture is
from it, and the mean of the products of the masses that truncation left is the mass inside. The dimensions that are
truncated most come first (Gibson, Glasbey and Elston 1994): the others then follow them to where the mass is.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr, ndtri
from jaxtyping import Array, Float

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support

CANDIDATES = 64
"""Number of weighted candidates that each draw is resampled from."""
POINTS = 1024
"""Points of each component that its mass inside is the mean weight of."""
TAIL = 4.0
"""Standard deviations from the mean beyond which the tail of a normal is drawn from as an exponential, and weighted."""


def truncated_mixture_draws(key: jax.Array, mixture: GaussianMixture, support: Support, n: int) -> Array:
    """`n` draws of a mixture truncated to the support, by importance resampling; rejection has no part in it.

    Each draw is one of `CANDIDATES` picked by weight: as good as exact where few dimensions are truncated.

    Args:
        key: consumed.
        mixture: of Gaussians.
        support: the box.
        n: number of draws.
    """
    key_candidates, key_pick = jax.random.split(key)
    theta, log_weight = candidates(key_candidates, mixture, support, (n, CANDIDATES))
    picked = jax.random.categorical(key_pick, log_weight)
    return jnp.take_along_axis(theta, picked[:, None, None], axis=1)[:, 0]


def candidates(
    key: jax.Array, mixture: GaussianMixture, support: Support, shape: tuple[int, ...]
) -> tuple[Float[Array, "*shape dim"], Float[Array, "*shape"]]:
    """Points inside a box, and the logarithms of the weights that make them draws of the truncated mixture.

    Components that have little mass in the box are chosen as rarely. The weight of a point is the product of the masses
    that truncation left, divided by what its component was favoured by.

    Args:
        key: consumed.
        mixture: of Gaussians.
        support: the box.
        shape: of the points.
    """
    key_component, key_uniform = jax.random.split(key)
    log_masses = jnp.sum(_marginal_log_masses(mixture, support), axis=-1)
    component = jax.random.categorical(key_component, mixture.logits + log_masses, shape=shape)
    uniform = jax.random.uniform(key_uniform, (*shape, support.dim), minval=1e-6, maxval=1.0)
    ordered = _ordered(mixture, support)

    def one(component: Array, uniform: Array) -> tuple[Array, Array]:
        order, mean, factor = jax.tree.map(lambda leaf: leaf[component], ordered)
        theta, log_weight, _ = _by_conditionals(order, mean, factor, support, uniform)
        return theta, log_weight - log_masses[component]

    for _ in shape:
        one = jax.vmap(one)
    return one(component, uniform)


@jax.jit  # a round asks for it more than once: it is traced once
def log_mass(mixture: GaussianMixture, support: Support) -> Float[Array, ""]:
    """Logarithm of the mass of a mixture in a box, however little it is; in one dimension in closed form.

    The points of each component are those of a lattice, so that the result is the same each time.

    Args:
        mixture: of Gaussians.
        support: the box.

    Example:
        >>> normal = GaussianMixture(jnp.zeros(1), jnp.zeros((1, 1)), jnp.ones((1, 1, 1)))
        >>> f"{float(log_mass(normal, Support([8.0], [10.0]))):.3f}"
        '-35.013'
    """
    lattice = jnp.asarray(_lattice(POINTS if support.dim > 1 else 1, support.dim))

    def of_component(order: Array, mean: Array, factor: Array) -> Array:
        point = lambda uniform: _by_conditionals(order, mean, factor, support, uniform)[2]
        return jax.nn.logsumexp(jax.vmap(point)(lattice)) - np.log(len(lattice))

    each = jax.vmap(of_component)(*_ordered(mixture, support))
    return jax.nn.logsumexp(jax.nn.log_softmax(mixture.logits) + each)


def _lattice(n: int, dim: int) -> np.ndarray:
    """`n` points spread evenly over the unit cube: multiples of the powers of a generalised golden ratio."""
    ratio = 1.5
    for _ in range(60):  # the root of ratio^(dim + 1) = ratio + 1
        ratio = (1 + ratio) ** (1 / (dim + 1))
    steps = ratio ** -np.arange(1.0, dim + 1)
    return ((0.5 + np.arange(n)[:, None] * steps) % 1.0).clip(1e-6, 1.0).astype(np.float32)


def _marginal_log_masses(mixture: GaussianMixture, support: Support) -> Float[Array, "comp dim"]:
    """Logarithm of each component's mass inside, dimension by dimension."""
    scales = mixture.marginal_scales
    low, high = (support.low - mixture.means) / scales, (support.high - mixture.means) / scales
    flip = low + high < 0
    return _log_interval(jnp.where(flip, -high, low), jnp.where(flip, -low, high))


def _ordered(mixture: GaussianMixture, support: Support) -> tuple[Array, Array, Array]:
    """The dimensions of each component, those of the least mass inside first: order, means and Cholesky factors."""
    order = jnp.argsort(_marginal_log_masses(mixture, support), axis=-1)
    rows = jax.vmap(lambda factor, order: factor[order])(mixture.scale_tril, order)
    upper = jnp.linalg.qr(jnp.swapaxes(rows, -1, -2), mode="r")
    signs = jnp.where(jnp.diagonal(upper, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
    return order, jnp.take_along_axis(mixture.means, order, axis=-1), jnp.swapaxes(signs[..., None] * upper, -1, -2)


def _by_conditionals(
    order: Array, mean: Array, factor: Array, support: Support, uniform: Array
) -> tuple[Array, Array, Array]:
    """A point inside the box by uniform numbers, the logarithm of its weight, and that of the mass left on its way.

    Both have the same mean but for the exponential tails, whose last one the mass is without.
    """
    box = Support(support.low[order], support.high[order])

    def next_dimension(d: Array, drawn: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        z, log_weight, _ = drawn
        given = mean[d] + factor[d] @ z  # entries of z from d on are still zero
        low, high = (box.low[d] - given) / factor[d, d], (box.high[d] - given) / factor[d, d]
        value, log_own, log_mass = _truncated_normal(uniform[d], low, high)
        return z.at[d].set(value), log_weight + log_own, log_weight + log_mass

    nothing = jnp.zeros(support.dim), jnp.zeros(()), jnp.zeros(())
    z, log_weight, log_mass = jax.lax.fori_loop(0, support.dim, next_dimension, nothing)
    theta = jnp.zeros(support.dim).at[order].set(mean + factor @ z)
    return support.clip(theta), log_weight, log_mass


@jax.jit
def _log_interval(near: Float[Array, "*n"], far: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Logarithm of the standard normal's mass in an interval, by its ends on the side of the upper tail."""
    log_near, log_far = log_ndtr(-jnp.stack([near, far]))
    return log_near + jnp.log1p(-jnp.exp(jnp.minimum(log_far - log_near, -1e-7)))


@jax.jit
def _truncated_normal(
    uniform: Float[Array, ""], low: Float[Array, ""], high: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """A draw by a uniform number of the standard normal truncated to [low, high], its weight, and the mass in there.

    Both as logarithms. The weight is the mass, and in the tail, where draws are exponential, the normal density over
    theirs.
    """
    flip = low + high < 0  # to the side of the upper tail, where small masses keep their precision
    near, far = jnp.where(flip, -high, low), jnp.where(flip, -low, high)
    log_mass = _log_interval(near, far)
    beyond = jnp.exp(log_ndtr(-near)) - uniform * jnp.exp(log_mass)
    middle = -ndtri(jnp.clip(beyond, 1e-37, 1.0 - 1e-7))
    # Beyond a of a few standard deviations the density falls about as exp(-a (z - a)).
    rate = jnp.maximum(near, TAIL)
    all_beyond = -jnp.expm1(-rate * (far - near))
    excess = -jnp.log1p(-uniform * all_beyond) / rate
    log_ratio = jnp.log(all_beyond / rate) - 0.5 * (excess**2 + near**2 + jnp.log(2 * jnp.pi))
    value = jnp.clip(jnp.where(near > TAIL, near + excess, middle), near, far)
    return jnp.where(flip, -value, value), jnp.where(near > TAIL, log_ratio, log_mass), log_mass
