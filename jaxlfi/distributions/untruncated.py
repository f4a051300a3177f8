"""Undo the truncation at a box in Gaussians that a network learnt from truncated draws.

A mixture of Gaussians fitted to draws inside a box has the moments of those draws, and a posterior that leans on a
bound ends there. Truncated to the box, as a posterior is, such a mixture is cut off a second time: an exponential
distribution comes out a fifth too narrow, a half-normal one a seventh. Here each component is replaced by one whose
part inside the box has the moments that the component has as a whole.
"""

import jax
import jax.numpy as jnp
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

from jaxlfi.distributions.decomposition import svd
from jaxlfi.distributions.mixture import GaussianMixture, lower_factor
from jaxlfi.distributions.support import Support

STEPS = 30
"""Number of fixed-point steps; after 30 a half-normal's deviation is within 1 % (20 leave 2 %)."""
WIDEST = 2.25
"""Largest factor by which a normal may become wider: what a uniform distribution needs, to 4 %."""
FARTHEST = 2.5
"""Largest shift of its mean, in its standard deviations."""
NEAREST = 1.2
"""Distance of a mean from a bound, in standard deviations, below which hardly any truncated normal has such moments."""


@jax.jit  # otherwise it would be a hundred small programs
def untruncated(mixture: GaussianMixture, support: Support) -> GaussianMixture:
    """The mixture whose components, truncated to the box, have the moments and weights of those given.

    Exact if one dimension of a component reaches a bound, or several that are independent. Otherwise each bound is
    removed as if it were alone, as expectation propagation adds them (Minka 2001; Cunningham, Hennig and Lacoste-Julien
    2011). Components whose means lie outside are left as they are.

    Args:
        mixture: mixture fitted to draws inside the box.
        support: the box.

    Example:
        >>> half = GaussianMixture(jnp.zeros(1), jnp.array([[0.798]]), jnp.array([[[0.603]]]))  # of a half-normal
        >>> whole = untruncated(half, Support([0.0], [9.0]))
        >>> f"{float(whole.means[0, 0]):.1f} {float(whole.scale_tril[0, 0, 0]):.2f}"
        '0.0 0.99'
    """
    means, scale_tril = jax.vmap(lambda mean, factor: _without_bounds(mean, factor, support))(
        mixture.means, mixture.scale_tril
    )
    found = mixture.replace(means=means, scale_tril=scale_tril)
    # A component fitted to draws inside has all its weight inside; a stray one has only what the box leaves of it.
    strays = jnp.minimum(_log_masses(mixture, support) - jnp.log(ndtr(NEAREST)), 0.0)
    return found.replace(logits=mixture.logits + jnp.sum(strays - _log_masses(found, support), axis=-1))


def cavity(
    mean: Float[Array, "*n"], deviation: Float[Array, "*n"], low: Float[Array, "*n"], high: Float[Array, "*n"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Mean and deviation of the normal distribution that, truncated to [low, high], has those given.

    For moments that no truncated normal has, it is the normal within the limits above whose moments are nearest.
    """
    a, b = (low - mean) / deviation, (high - mean) / deviation
    inside = jnp.clip(jnp.minimum(-a, b), 0.0, 1.0)
    a, b = jnp.minimum(a, -NEAREST), jnp.maximum(b, NEAREST)

    def step(_: int, normal: tuple[Array, Array]) -> tuple[Array, Array]:
        shift, log_scale = normal
        moved, variance = _moments(shift, jnp.exp(log_scale), a, b)
        log_scale = jnp.minimum(log_scale - 0.5 * jnp.log(variance), jnp.log(WIDEST))
        return jnp.clip(shift - moved, -FARTHEST, FARTHEST), log_scale

    shift, log_scale = jax.lax.fori_loop(0, STEPS, step, (jnp.zeros_like(a), jnp.zeros_like(a)))
    return mean + deviation * inside * shift, deviation * jnp.exp(inside * jnp.maximum(log_scale, 0.0))


def _moments(mean: Array, deviation: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Mean and variance of a normal truncated to [low, high], with some mass inside."""
    a, b = (low - mean) / deviation, (high - mean) / deviation
    density = lambda z: jnp.exp(-0.5 * z * z) / jnp.sqrt(2 * jnp.pi)
    times = lambda z: jnp.clip(z, -10.0, 10.0) * density(z)  # 0 at a bound that is infinitely far
    mass = jnp.maximum(ndtr(b) - ndtr(a), 1e-6)
    shift = (density(a) - density(b)) / mass
    variance = 1 + (times(a) - times(b)) / mass - shift**2
    return mean + deviation * shift, deviation**2 * jnp.maximum(variance, 1e-3)


def _without_bounds(
    mean: Float[Array, " dim"], factor: Float[Array, "dim dim"], support: Support
) -> tuple[Float[Array, " dim"], Float[Array, "dim dim"]]:
    """Mean and factor of a Gaussian divided by the normal factor that each bound amounts to."""
    deviation = jnp.linalg.norm(factor, axis=-1)
    wanted, wider = cavity(mean, deviation, support.low, support.high)
    # The factor in a dimension is exp(slope u - precision u^2 / 2), with u the distance from the mean.
    slope, precision = (mean - wanted) / wider**2, 1 / deviation**2 - 1 / wider**2
    axes, values, _ = svd(factor.T @ (precision[:, None] * factor))
    left = jnp.maximum(1 - values, 1 / WIDEST**2)
    moved = factor @ (axes @ (-(axes.T @ (factor.T @ slope)) / left))
    return mean + moved, lower_factor(factor @ (axes / jnp.sqrt(left)))


def _log_masses(mixture: GaussianMixture, support: Support) -> Float[Array, "comp dim"]:
    """Log-mass of each component between the bounds of each dimension."""
    deviation = jnp.linalg.norm(mixture.scale_tril, axis=-1)
    mass = ndtr((support.high - mixture.means) / deviation) - ndtr((support.low - mixture.means) / deviation)
    return jnp.log(jnp.maximum(mass, 1e-6))
