"""Mass and draws of a mixture of Gaussians truncated to a box, even if next to nothing of it lies inside.

Both come from points that are drawn dimension by dimension, each from its conditional normal given the previous
dimensions, truncated to the box (Geweke 1991; Hajivassiliou and McFadden 1998; Keane 1994). All points lie inside,
however far the mixture is from it, and the mass inside is the mean of the products of the masses that truncation left.
The dimensions that are truncated most come first (Gibson, Glasbey and Elston 1994): the others then follow them to
where the mass is.
"""

import functools
from statistics import NormalDist

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr, ndtri
from jaxtyping import Array, Float

from jaxlfi.distributions.mixture import GaussianMixture, lower_factor
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncation import Place

CANDIDATES = 64
"""Number of weighted candidates that each draw is resampled from."""
POINTS = 1024
"""Number of points of each component whose mean weight is its mass inside."""
MOMENT_POINTS = 4096
"""Number of points of each component over which moments are averaged."""
HALVINGS = 34
"""Number of bisections for a quantile: 2^-34 of the box is below float32's spacing, also for a narrow posterior."""
TAIL = 4.0
"""Distance from the mean, in standard deviations, beyond which a normal is drawn as an exponential and weighted."""


def truncated_mixture_draws(key: jax.Array, mixture: GaussianMixture, support: Support, n: int) -> Array:
    """`n` draws of a mixture truncated to the support, by importance resampling, without rejection.

    Each draw is one of `CANDIDATES` points picked by weight: practically exact if few dimensions are truncated.
    """
    key_candidates, key_pick = jax.random.split(key)
    theta, log_weight = candidates(key_candidates, mixture, support, (n, CANDIDATES))
    picked = jax.random.categorical(key_pick, log_weight)
    return jnp.take_along_axis(theta, picked[:, None, None], axis=1)[:, 0]


def candidates(
    key: jax.Array, mixture: GaussianMixture, support: Support, shape: tuple[int, ...]
) -> tuple[Float[Array, "*shape dim"], Float[Array, "*shape"]]:
    """Points inside a box, and the logarithms of the weights that make them draws of the truncated mixture.

    Components with little mass in the box are chosen correspondingly rarely. The weight of a point is the product of
    the masses that truncation left, divided by the factor by which its component was favoured.

    Args:
        key: consumed.
        mixture: mixture of Gaussians.
        support: the box.
        shape: shape of the array of points.
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


@jax.jit  # a round uses it more than once, and traces it once
def log_mass(mixture: GaussianMixture, support: Support) -> Float[Array, ""]:
    """Logarithm of the mass of a mixture in a box, however small; in one dimension in closed form.

    The points of each component lie on a lattice, so that the result is the same each time.

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


def rough_mass(mixture: GaussianMixture, place: Place) -> Float[Array, ""]:
    """Mass of a mixture in a place to a hundredth, the same each time: for records, as it compiles to very little.

    Example:
        >>> normal = GaussianMixture(jnp.zeros(1), jnp.zeros((1, 1)), jnp.ones((1, 1, 1)))
        >>> f"{float(rough_mass(normal, Support([1.0], [9.0]))):.2f}"  # exactly 0.1587
        '0.16'
    """
    normal = _normal_lattice(POINTS, mixture.means.shape[-1])
    points = mixture.means[:, None] + jnp.einsum("kij,nj->kni", mixture.scale_tril, normal)
    return jnp.sum(mixture.weights * jnp.mean(place.contains(points), axis=1))


def weighted_points(
    mixture: GaussianMixture, support: Support
) -> tuple[Float[Array, "points dim"], Float[Array, " points"]]:
    """Points inside a box, and the logarithms of the weights that make them those of the truncated mixture.

    They are the same each time, `MOMENT_POINTS` of each component on a lattice. Weighted means over them are moments of
    the truncated mixture to a few thousandths of a standard deviation.

    Args:
        mixture: mixture of Gaussians.
        support: the box.

    Example:
        >>> normal = GaussianMixture(jnp.zeros(1), jnp.zeros((1, 1)), jnp.ones((1, 1, 1)))
        >>> points, log_weight = weighted_points(normal, Support([0.0], [9.0]))
        >>> f"{float(jnp.average(points[:, 0], weights=jnp.exp(log_weight))):.3f}"  # sqrt(2 / pi) = 0.798
        '0.798'
    """
    lattice = jnp.asarray(_even_lattice(MOMENT_POINTS, support.dim))

    def of_component(order: Array, mean: Array, factor: Array) -> tuple[Array, Array]:
        return jax.vmap(lambda uniform: _by_conditionals(order, mean, factor, support, uniform)[:2])(lattice)

    theta, log_weight = jax.vmap(of_component)(*_ordered(mixture, support))
    log_weight = log_weight + jax.nn.log_softmax(mixture.logits)[:, None]
    return theta.reshape(-1, support.dim), jax.nn.log_softmax(log_weight.ravel())


def truncated_quantiles(
    mixture: GaussianMixture, support: Support, levels: Float[Array, " levels"]
) -> Float[Array, "levels dim"]:
    """Quantiles of each dimension of a mixture truncated to a box, shape [levels, D].

    Given the other dimensions, each dimension is a truncated normal in every component. Its CDF is the mean of these
    normals' CDFs over points of the other dimensions, and is inverted by bisection. In one dimension it is the closed
    form, in two the mean is a sum over a fine grid, in more over a lattice. So quantiles are monotone in the level.

    Args:
        mixture: mixture of Gaussians.
        support: the box.
        levels: masses in [0, 1].

    Example:
        >>> normal = GaussianMixture(jnp.zeros(1), jnp.zeros((1, 1)), jnp.ones((1, 1, 1)))
        >>> f"{float(truncated_quantiles(normal, Support([0.0], [9.0]), jnp.array([0.5]))[0, 0]):.3f}"
        '0.674'
    """

    def of_dimension(d: Array) -> Array:
        mean, scale, log_weight = _conditional_normals(mixture, support, d)
        low, high = support.low[d], support.high[d]
        log_all = _log_between((low - mean) / scale, (high - mean) / scale)
        weight = jax.nn.softmax(log_weight)

        def below(value: Array) -> Array:
            return jnp.sum(weight * jnp.exp(_log_between((low - mean) / scale, (value - mean) / scale) - log_all))

        def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
            middle = 0.5 * (ends[0] + ends[1])
            less = jax.lax.map(below, middle, batch_size=32) < levels
            return jnp.where(less, middle, ends[0]), jnp.where(less, ends[1], middle)

        ends = jnp.full_like(levels, low), jnp.full_like(levels, high)
        return 0.5 * sum(jax.lax.fori_loop(0, HALVINGS, halve, ends))

    return jax.lax.map(of_dimension, jnp.arange(support.dim)).T


def _conditional_normals(mixture: GaussianMixture, support: Support, d: Array) -> tuple[Array, Array, Array]:
    """One dimension as normals truncated to the box: means, scales and the logarithms of their weights, shape [M]."""
    dim = support.dim
    points = _even_lattice(POINTS if dim > 1 else 1, dim - 1)
    lattice = jnp.asarray(np.concatenate([points, np.full((len(points), 1), 0.5, np.float32)], axis=1))

    def of_component(order: Array, mean: Array, factor: Array) -> tuple[Array, Array, Array]:
        def point(uniform: Array) -> tuple[Array, Array, Array]:
            z, _, log_mass = _conditionals(order, mean, factor, support, uniform)
            return mean[-1] + factor[-1, :-1] @ z[:-1], factor[-1, -1], log_mass

        return jax.vmap(point)(lattice)

    means, scales, log_weights = jax.vmap(of_component)(*_ordered(mixture, support, last=d))
    log_weights = log_weights + jax.nn.log_softmax(mixture.logits)[:, None]
    return means.ravel(), scales.ravel(), log_weights.ravel()


def _lattice(n: int, dim: int) -> np.ndarray:
    """`n` points spread evenly over the unit cube: multiples of the powers of a generalised golden ratio."""
    ratio = 1.5
    for _ in range(60):  # the root of ratio^(dim + 1) = ratio + 1
        ratio = (1 + ratio) ** (1 / (dim + 1))
    steps = ratio ** -np.arange(1.0, dim + 1)
    return ((0.5 + np.arange(n)[:, None] * steps) % 1.0).clip(1e-6, 1.0).astype(np.float32)


def _even_lattice(n: int, dim: int) -> np.ndarray:
    """As `_lattice`, with its first dimension divided evenly: in one dimension, the midpoint rule."""
    first = (0.5 + np.arange(n, dtype=np.float32)[:, None]) / n
    return np.concatenate([first, _lattice(n, max(dim - 1, 0))], axis=1)[:, :dim]


@functools.cache
def _normal_lattice(n: int, dim: int) -> np.ndarray:
    """Points spread evenly over the standard normal distribution."""
    inverse = np.vectorize(NormalDist().inv_cdf)
    return inverse(np.clip(_even_lattice(n, dim).astype(float), 1e-6, 1 - 1e-6)).astype(np.float32)


def _marginal_log_masses(mixture: GaussianMixture, support: Support) -> Float[Array, "comp dim"]:
    """Logarithm of each component's mass inside, dimension by dimension."""
    scales = mixture.marginal_scales
    return _log_between((support.low - mixture.means) / scales, (support.high - mixture.means) / scales)


def _log_between(low: Float[Array, "*n"], high: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Logarithm of the standard normal's mass between two numbers."""
    flip = low + high < 0
    return _log_interval(jnp.where(flip, -high, low), jnp.where(flip, -low, high))


def _ordered(mixture: GaussianMixture, support: Support, last: Array | None = None) -> tuple[Array, Array, Array]:
    """Components with their dimensions sorted, least mass inside first: order, means and Cholesky factors."""
    masses = _marginal_log_masses(mixture, support)
    order = jnp.argsort(masses if last is None else masses.at[:, last].set(jnp.inf), axis=-1)
    rows = jax.vmap(lambda factor, order: factor[order])(mixture.scale_tril, order)
    return order, jnp.take_along_axis(mixture.means, order, axis=-1), lower_factor(rows)


def _by_conditionals(
    order: Array, mean: Array, factor: Array, support: Support, uniform: Array
) -> tuple[Array, Array, Array]:
    """A point inside the box from uniform numbers, the logarithm of its weight, and that of the mass left on its way.

    The two have the same mean. They differ only in the exponential tail of the last dimension, which the mass is
    without.
    """
    z, log_weight, log_mass = _conditionals(order, mean, factor, support, uniform)
    theta = jnp.zeros(support.dim).at[order].set(mean + factor @ z)
    return support.clip(theta), log_weight, log_mass


def _conditionals(
    order: Array, mean: Array, factor: Array, support: Support, uniform: Array
) -> tuple[Array, Array, Array]:
    """As `_by_conditionals`, with the point as independent normal numbers in the order of the dimensions."""
    box = Support(support.low[order], support.high[order])

    def next_dimension(d: Array, drawn: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        z, log_weight, _ = drawn
        given = mean[d] + factor[d] @ z  # entries of z from d on are still zero
        low, high = (box.low[d] - given) / factor[d, d], (box.high[d] - given) / factor[d, d]
        value, log_own, log_mass = _truncated_normal(uniform[d], low, high)
        return z.at[d].set(value), log_weight + log_own, log_weight + log_mass

    nothing = jnp.zeros(support.dim), jnp.zeros(()), jnp.zeros(())
    return jax.lax.fori_loop(0, support.dim, next_dimension, nothing)


@jax.jit
def _log_interval(near: Float[Array, "*n"], far: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Logarithm of the standard normal's mass in an interval, by its ends on the side of the upper tail."""
    log_near, log_far = log_ndtr(-jnp.stack([near, far]))
    return log_near + jnp.log1p(-jnp.exp(jnp.minimum(log_far - log_near, -1e-7)))


@jax.jit
def _truncated_normal(
    uniform: Float[Array, ""], low: Float[Array, ""], high: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """A draw, from a uniform number, of the standard normal truncated to [low, high], its log-weight, and the log-mass.

    The weight is the mass inside or, in the tail, where draws are exponential, the normal density over theirs.
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
