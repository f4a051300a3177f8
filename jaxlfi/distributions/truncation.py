"""Truncation: draws, mass and density of a distribution restricted to a box."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Sampler = Callable[[jax.Array, int], Float[Array, "n dim"]]
"""A function that draws from a distribution before truncation: (key, n) -> [n, D]."""

TRIES = 32
"""Largest number of candidates per draw. With a mass m inside, (1 - m)^32 of the draws find none: 3 % at m = 0.1."""
BLOCK = 8192
"""Number of draws made at a time, which bounds the memory of the fallback."""
MASS_DRAWS = 10_000
"""Number of Monte Carlo draws for a mass that has no closed form (1 % error at mass 0.5)."""


@runtime_checkable
class Place(Protocol):
    """Place in which draws are kept: a box, or its part where a prior is not zero (`jaxlfi.distributions.region`)."""

    @property
    def dim(self) -> int:
        """Number of parameters D."""
        ...

    def contains(self, theta: Float[Array, "*n dim"]) -> Bool[Array, "*n"]:
        """Whether each parameter vector lies inside."""
        ...

    def sample(self, key: jax.Array, n: int) -> Float[Array, "n dim"]:
        """`n` draws inside: uniform ones, or those of the prior."""
        ...


def rejection_sample(
    key: jax.Array, sample: Sampler, support: Place, n: int, fallback: Sampler | None = None
) -> Float[Array, "n dim"]:
    """`n` draws of a distribution truncated to the support, by rejection in bounded time.

    Every draw takes the first of up to `TRIES` candidates of its own that lies inside the box. If none does, because
    nearly all of the distribution lies outside, it is a draw of the fallback. How often that happens follows from
    `mass_inside`. Candidates are drawn for all draws at once until none is missing: a few times, if most of the mass is
    inside.

    Args:
        key: consumed.
        sample: sampler of the distribution before truncation.
        support: place in which draws are kept.
        n: number of draws.
        fallback: sampler of draws inside; by default `support.sample`: uniform draws, or those of the prior.
    """
    if n > BLOCK:
        keys = jax.random.split(key, -(-n // BLOCK))
        blocks = jax.lax.map(lambda key: rejection_sample(key, sample, support, BLOCK, fallback), keys)
        return blocks.reshape(-1, support.dim)[:n]
    # As plain numbers: JAX's check for reused keys mistakes loops, and branches under vmap, for reuse.
    numbers, kind = jax.random.key_data(key), jax.random.key_impl(key)
    key_of = lambda number: jax.random.fold_in(jax.random.wrap_key_data(numbers, impl=kind), number)

    def missing(state: tuple[Array, Array, Array]) -> Bool[Array, ""]:
        tried, _, found = state
        return (tried < TRIES) & ~jnp.all(found)

    def tried_again(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        tried, theta, found = state
        candidates = sample(key_of(tried), n)
        taken = ~found & support.contains(candidates)
        return tried + 1, jnp.where(taken[:, None], candidates, theta), found | taken

    start = jnp.asarray(0), jnp.zeros((n, support.dim)), jnp.zeros(n, bool)
    _, theta, found = jax.lax.while_loop(missing, tried_again, start)

    def filled() -> Array:
        return jnp.where(found[:, None], theta, (fallback or support.sample)(key_of(TRIES), n))

    # A branch: usually nothing is missing, and the fallback would take longer than all the rest.
    return jax.lax.cond(jnp.all(found), lambda: theta, filled)


def weighted_sample(
    key: jax.Array,
    candidates: Float[Array, "m dim"],
    log_weight: Float[Array, " m"],
    n: int,
    fallback: Sampler | None = None,
) -> Float[Array, "n dim"]:
    """`n` of the candidates, each at most once, with odds in proportion to their weights.

    They have the n largest log-weights with Gumbel noise (Efraimidis and Spirakis 2006). If there are many more
    candidates than draws, they are draws of the candidates' distribution times the weight.

    Args:
        key: consumed.
        candidates: candidates, shape [M, D].
        log_weight: log-weight of each candidate; NaN counts as no weight at all.
        n: number of draws, at most M.
        fallback: sampler of draws that replace those missing if fewer than n candidates have any weight; without one,
            candidates without weight do.
    """
    key_noise, key_fallback = (key, key) if fallback is None else jax.random.split(key)
    odds = jnp.where(jnp.isnan(log_weight), -jnp.inf, log_weight) + jax.random.gumbel(key_noise, log_weight.shape)
    best, rows = jax.lax.top_k(odds, n)
    if fallback is None:
        return candidates[rows]
    return jnp.where((best > -jnp.inf)[:, None], candidates[rows], fallback(key_fallback, n))


def mass_inside(sample: Sampler, support: Place) -> Float[Array, ""]:
    """The distribution's mass in the support, from `MASS_DRAWS` draws that are the same each time."""
    return jnp.mean(support.contains(sample(jax.random.key(0), MASS_DRAWS)))


def truncated_log_prob(
    log_prob: Float[Array, "*n"], theta: Float[Array, "*n dim"], support: Place, log_mass: Float[Array, ""]
) -> Float[Array, "*n"]:
    """Log-density of the truncated distribution at theta: log q - log mass inside the support, -inf outside.

    Args:
        log_prob: log q(theta) before truncation, shape [...].
        theta: parameters, shape [..., D].
        support: place to which it is truncated.
        log_mass: logarithm of q's mass in it.
    """
    return jnp.where(support.contains(theta), log_prob - log_mass, -jnp.inf)
