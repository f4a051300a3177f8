"""Belief: a posterior mixture and the support it lives on, in one pytree."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float
from scipy.special import chdtri

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.region import Region
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncation import TRIES, rejection_sample, weighted_sample


class Belief(struct.PyTreeNode):
    """The belief about the parameters after a round: p_(Theta) in the paper.

    Attributes:
        mixture: the posterior as a mixture of Gaussians (unbounded).
        support: the box Theta in which its draws are kept.
        informed: whether the next proposals are drawn from the mixture rather than from the prior over the support.
            False before the first round, when there is no posterior yet and the mixture only has the right shape, and
            under a heuristic that always proposes from the prior (`Truncate`), whose mixture is the posterior.
            Heuristics that compare two posteriors (MODE) do so only if it is true.
    """

    mixture: GaussianMixture
    support: Support
    informed: Bool[Array, "*batch"]


def uninformed(support: Support, components: int) -> Belief:
    """The belief before any simulation: a box, and equal components as wide as the box at its centre."""
    dim = support.dim
    return Belief(
        mixture=GaussianMixture(
            logits=jnp.zeros(components),
            means=jnp.broadcast_to(support.centre, (components, dim)),
            scale_tril=jnp.broadcast_to(jnp.diag(0.5 * support.width), (components, dim, dim)),
        ),
        support=support,
        informed=jnp.asarray(False),
    )


CANDIDATES = 32_768
"""Smallest number of draws from which those likely under a prior are chosen: in ten dimensions one in some hundreds."""

OUTSIDE = 1e-3
"""Mass of a posterior outside its region of highest density."""
LEVEL_DRAWS = 8192
"""Number of draws from which the density at the border of that region is estimated."""

Factor = Float[Array, "*batch"] | float
LogWeight = Callable[[Float[Array, "m dim"]], Float[Array, " m"]]


def clipped(
    key: jax.Array,
    belief: Belief,
    n: int,
    inflation: Factor = 1.0,
    log_weight: LogWeight | None = None,
    region: Region | None = None,
    before: Support | None = None,
) -> Array:
    """`n` draws of the mixture, with those outside the support moved to its nearest point (the paper's choice).

    Clipping puts atoms of probability on the bounds; `rejected` does not.

    Args:
        key: consumed.
        belief: belief to draw from.
        n: number of draws.
        inflation: factor by which draws are wider than the mixture, about its mean.
        log_weight: logarithm of a factor of the density, such as a prior, by which draws are chosen from many more.
        region: the part of the support in which draws are kept; all of it by default. Draws that are moved to a point
            outside it are redrawn and, if that does not help, drawn from the prior inside.
        before: the support of the previous round, for `mixed`.
    """
    sample = lambda key, n: belief.support.clip(belief.mixture.inflated(inflation).sample(key, n))
    if log_weight is not None:
        return _weighted(key, sample, log_weight, region or belief.support, n)
    draws = sample(key, n)
    if region is None:
        return draws
    again = rejection_sample(jax.random.fold_in(jax.random.clone(key), 1), sample, region, n)
    return jnp.where(region.contains(draws)[:, None], draws, again)


def rejected(
    key: jax.Array,
    belief: Belief,
    n: int,
    inflation: Factor = 1.0,
    log_weight: LogWeight | None = None,
    region: Region | None = None,
    before: Support | None = None,
) -> Array:
    """`n` draws of the mixture truncated to the support (`jaxlfi.distributions.truncation.rejection_sample`)."""
    sample, inside = belief.mixture.inflated(inflation).sample, region or belief.support
    if log_weight is None:
        return rejection_sample(key, sample, inside, n)
    return _weighted(key, sample, log_weight, inside, n)


def mixed(
    key: jax.Array,
    belief: Belief,
    n: int,
    inflation: Factor = 1.0,
    log_weight: LogWeight | None = None,
    region: Region | None = None,
    before: Support | None = None,
) -> Array:
    """`n` draws: as by `clipped` for the mass beyond bounds that move, as by `rejected` for the rest.

    While the support follows a posterior that lies beyond a bound, clipped draws on that bound show the network where
    the posterior lies. On a bound that stays, such as one of Phi, they would draw the posterior onto it, round by
    round. Once all of it is inside, wide proposals are wanted, and would pile up on the bounds if they were clipped.
    The mass outside is that of the mixture itself, neither inflated nor weighted.
    """
    key_posterior, key_wide = jax.random.split(key)
    draws = belief.mixture.sample(key_posterior, n)
    moved = belief.support.clip(draws)
    # If nothing is known of the previous support, all bounds count as moving.
    low, high = (jnp.inf, -jnp.inf) if before is None else (before.low, before.high)
    stays = ((moved > draws) & (belief.support.low >= low)) | ((moved < draws) & (belief.support.high <= high))
    inside = belief.support.contains(draws)
    wide = inside | jnp.any(stays, axis=-1)
    if region is not None:
        wide = wide | ~region.contains(moved)
    return jnp.where(wide[:, None], rejected(key_wide, belief, n, inflation, log_weight, region), moved)


def truncated_prior(
    key: jax.Array,
    belief: Belief,
    n: int,
    inflation: Factor = 1.0,
    log_weight: LogWeight | None = None,
    region: Region | None = None,
    before: Support | None = None,
) -> Array:
    """`n` draws of the prior within the support and the mixture's region of highest density.

    The region holds all but `OUTSIDE` of the mixture's mass (Deistler, Goncalves and Macke 2022). From such simulations
    of all rounds together, a network learns the posterior under the prior, which needs no correction: within the region
    the proposals are proportional to the prior. They are chosen from candidates that are as wide as a uniform
    distribution over the region of a Gaussian. The arguments are those of `clipped`.
    """
    key_level, key_draws = jax.random.split(key)
    mixture = belief.mixture.inflated(inflation)
    level = jnp.quantile(mixture.log_prob(mixture.sample(key_level, LEVEL_DRAWS)), OUTSIDE)
    dim = belief.support.dim
    # Uniform draws in a ball of radius r in D dimensions have a standard deviation of r / sqrt(D + 2).
    candidates = mixture.inflated(math.sqrt(chdtri(dim, OUTSIDE) / (dim + 2)))

    def flat(theta: Float[Array, "m dim"]) -> Float[Array, " m"]:
        weight = -candidates.log_prob(theta)
        if log_weight is not None:
            weight = weight + log_weight(theta)
        return jnp.where(mixture.log_prob(theta) >= level, weight, -jnp.inf)

    return _weighted(key_draws, candidates.sample, flat, region or belief.support, n)


def _weighted(
    key: jax.Array, sample: Callable[[jax.Array, int], Array], log_weight: LogWeight, inside: Support | Region, n: int
) -> Array:
    """`n` of many more draws, chosen by weight among those inside."""
    key_candidates, key_choice = jax.random.split(key)
    candidates = sample(key_candidates, max(CANDIDATES, TRIES * n))
    weight = jnp.where(inside.contains(candidates), log_weight(candidates), -jnp.inf)
    return weighted_sample(key_choice, candidates, weight, n, inside.sample)


RESTRICTIONS = {"clip": clipped, "reject": rejected, "mixed": mixed, "prior": truncated_prior}
"""Ways to keep *proposals* inside the support, by name (docs/paper.md, reading E).

Draws of a posterior are never clipped.
"""
