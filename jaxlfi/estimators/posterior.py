"""Posterior: q_phi(theta | x^r) truncated to a support, for mixture density networks and flows alike."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, ArrayLike, Float

from jaxlfi.distributions.arguments import as_key, require_count
from jaxlfi.distributions.mass import log_mass_inside, rare_draws
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.precision import single
from jaxlfi.distributions.region import Region, region
from jaxlfi.distributions.space import Space, SpaceName, is_natural
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncation import rejection_sample, truncated_log_prob
from jaxlfi.estimators.density import Density

MAX_DRAWS = 10_000_000
"""Draws that are made at once."""
MEAN_DRAWS = 4096
"""Number of draws that the posterior mean is estimated from (1.6 % of a standard deviation)."""
MAP_DRAWS = 1000
"""Number of draws among which the ascents towards the mode find their starts."""
MAP_STARTS = 16
"""Number of gradient ascents towards the mode, each from one of the draws of highest density."""
MAP_STEPS = 300
"""Steps of Adam in each ascent."""
MAP_RATE = 0.02
"""Adam's initial step size, as a fraction of half the support's width; it decays to zero."""
ROUNDING = 4 * float(jnp.finfo(jnp.float32).eps)
"""How far a bound in natural units can be off, relative to its size."""


class Posterior(struct.PyTreeNode):
    """The posterior of an observation: a density on a box, as a pytree.

    It is always the density truncated to the support, and zero where a prior that the task brings is zero. Draws are
    rejected until they lie inside, never moved there; where next to no mass is inside, they are picked by weight from
    draws of the mixture that do (`jaxlfi.distributions.mass`).
    Arguments and results are in natural units, or in inference space (logarithms of log parameters) where
    `space="inference"` is passed.

    Attributes:
        density: q before truncation, over inference space: a `GaussianMixture`, or a flow's density.
        mixture: the same as a mixture of Gaussians, which heuristics and proposals see: itself, or fitted to draws.
        support: the box, in inference space.
        log_mass_inside: logarithm of `mass_inside`, which may be too small for a number. Shape [].
        space: the map between natural units and inference space.
        prior: the task's own prior over inference space, or None; where it is zero, so is the posterior.
    """

    density: Density
    mixture: GaussianMixture
    support: Support
    log_mass_inside: Float[Array, "*batch"]
    space: Space = struct.field(pytree_node=False)
    prior: Any = struct.field(pytree_node=False, default=None)

    @property
    def mass_inside(self) -> Float[Array, "*batch"]:
        """Mass of q inside the support, where the prior is not zero; the rest has leaked. Shape []."""
        return jnp.exp(self.log_mass_inside)

    @property
    def region(self) -> Support | Region:
        """Where the posterior is not zero: the support, without the places where the prior is zero."""
        return region(self.support, self.prior)

    def sample(self, key: jax.Array, n: int, space: SpaceName = "natural") -> Float[Array, "n dim"]:
        """`n` independent draws, shape [n, D].

        Args:
            key: consumed; or a seed.
            n: number of draws.
            space: "natural" units, or "inference" space.

        Raises:
            ValueError: for what is no key, or a number that is not whole and from 1 to `MAX_DRAWS`.
        """
        require_count(n, "n", most=MAX_DRAWS)
        natural = is_natural(space)
        draws = _sample(as_key(key), self, int(n))
        return self.space.to_natural(draws) if natural else draws

    def log_prob(self, theta: ArrayLike | Sequence, space: SpaceName = "natural") -> Float[Array, "*n"]:
        """Log-density at theta, numbers of shape [..., D]; -inf outside the support.

        Raises:
            ValueError: for another number of parameters.
        """
        try:
            theta = jnp.asarray(theta, jnp.float32)
        except (ValueError, TypeError, OverflowError) as error:
            raise ValueError(f"theta: expected numbers of shape [..., {self.space.dim}], got {theta!r}") from error
        if theta.ndim == 0 or theta.shape[-1] != self.space.dim:
            raise ValueError(f"theta: expected shape [..., {self.space.dim}], got {list(theta.shape)}")
        return _log_prob(self, theta, is_natural(space))

    def mean(self, space: SpaceName = "natural") -> Float[Array, " dim"]:
        """The mean, over `MEAN_DRAWS` draws that are the same each time, shape [D]."""
        return jnp.mean(self.sample(jax.random.key(0), MEAN_DRAWS, space), axis=0)

    def map(self, space: SpaceName = "natural") -> Float[Array, " dim"]:
        """The point of the highest density inside the support (maximum a posteriori), shape [D].

        Found by gradient ascent from the draws of the highest density. The density over natural units and that over
        inference space have different maxima where a parameter is inferred as its logarithm: `space` chooses the
        density, and the units of the result.
        """
        draws = self.sample(jax.random.key(0), MAP_DRAWS, space="inference")
        return _maximum(self, draws, is_natural(space))

    def inner_draws(self, key: jax.Array, n: int) -> Float[Array, "n dim"]:
        """`n` draws in inference space, by rejection; pure, where `sample` is checked and compiled."""
        fallback = rare_draws(self.density, self.mixture, self.region)
        return rejection_sample(key, self.density.sample, self.region, n, fallback)

    def on(self, support: Support) -> "Posterior":
        """The same density truncated to another support, in inference space."""
        return truncated(self.density, self.mixture, support, self.space, self.prior)


def truncated(
    density: Density, mixture: GaussianMixture, support: Support, space: Space, prior: Any = None
) -> Posterior:
    """A density truncated to a support, and to where a prior is not zero, with the mass it has in there."""
    log_mass = log_mass_inside(density, mixture, region(support, prior))
    return Posterior(density, mixture, support, log_mass, space, prior)


# Compiled as wholes: operation by operation, a flow's density alone would be hundreds of small programs.


@functools.partial(jax.jit, static_argnums=2)
@single
def _sample(key: jax.Array, posterior: Posterior, n: int) -> Array:
    return posterior.inner_draws(key, n)


@functools.partial(jax.jit, static_argnums=2)
@single
def _log_prob(posterior: Posterior, theta: Array, natural: bool) -> Array:
    """Log-density over natural units or over inference space, at a point in the same."""
    box, space = posterior.support, posterior.space
    inner = space.to_inference(theta) if natural else theta
    if natural:  # a logarithm's rounding takes no point on a bound out of the support
        low, high = space.to_natural(box.low), space.to_natural(box.high)
        low, high = low - ROUNDING * jnp.abs(low), high + ROUNDING * jnp.abs(high)
        inside = jnp.all((theta >= low) & (theta <= high), axis=-1, keepdims=True)
        inner = jnp.where(inside, box.clip(inner), inner)
    finite = jnp.all(jnp.isfinite(inner), axis=-1)
    inner = jnp.where(finite[..., None], inner, posterior.support.centre)
    log_prob = posterior.density.log_prob(inner)
    log_prob = truncated_log_prob(log_prob, inner, posterior.region, posterior.log_mass_inside)
    log_jacobian = posterior.space.log_jacobian(inner) if natural else 0.0
    return jnp.where(finite, log_prob - log_jacobian, -jnp.inf)


@functools.partial(jax.jit, static_argnums=2)
@single
def _maximum(posterior: Posterior, draws: Array, natural: bool) -> Array:
    """The maximum of the density over natural units or over inference space, by ascent from the best of some draws."""
    box = posterior.support

    def objective(unit: Array) -> Array:
        theta = _of_unit(box, unit)
        return posterior.density.log_prob(theta) - (posterior.space.log_jacobian(theta) if natural else 0.0)

    draws = box.to_unit(draws)
    _, best = jax.lax.top_k(jax.vmap(objective)(draws), MAP_STARTS)
    adam = optax.adam(optax.cosine_decay_schedule(MAP_RATE, MAP_STEPS))
    moved = lambda unit, step: jnp.clip(unit + step, -1.0, 1.0)
    if posterior.prior is not None:
        moved = functools.partial(_moved_inside, lambda unit: posterior.region.contains(_of_unit(box, unit)))

    def ascend(start: Array) -> tuple[Array, Array]:
        def step(carry, _):
            unit, moments = carry
            updates, moments = adam.update(-jax.grad(objective)(unit), moments)
            return (moved(unit, updates), moments), None

        (unit, _), _ = jax.lax.scan(step, (start, adam.init(start)), length=MAP_STEPS)
        return unit, objective(unit)

    units, heights = jax.vmap(ascend)(draws[best])
    point = box.clip(_of_unit(box, units[jnp.argmax(heights)]))
    return posterior.space.to_natural(point) if natural else point


def _of_unit(box: Support, unit: Array) -> Array:
    """From [-1, 1]^D to the box."""
    return box.centre + 0.5 * box.width * unit


def _moved_inside(inside: Callable[[Array], Array], unit: Array, step: Array) -> Array:
    """As much of a step as leads to no place of zero density, one dimension after another."""

    def along(d: Array, unit: Array) -> Array:
        tried = unit.at[d].set(jnp.clip(unit[d] + jnp.nan_to_num(step[d]), -1.0, 1.0))
        return jnp.where(inside(tried), tried, unit)

    return jax.lax.fori_loop(0, unit.shape[-1], along, unit)
