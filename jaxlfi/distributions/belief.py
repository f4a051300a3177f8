"""Belief: a posterior mixture and the support it lives on, in one pytree."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncation import rejection_sample


@struct.dataclass
class Belief:
    """What is believed of the parameters after a round: p_(Theta) in the paper.

    Attributes:
        mixture: the posterior as a mixture of Gaussians (unbounded).
        support: the box Theta its draws are kept in.
        informed: whether the next proposals are drawn from the mixture, or else from the prior over the support. False
            before the first round, when there is no posterior yet and the mixture only has the right shape,
            and under a heuristic that always proposes from the prior (`Truncate`), whose mixture is the posterior.
            Heuristics that compare two posteriors (MODE) do so only where it is true.
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


Factor = Float[Array, "*batch"] | float


def clipped(key: jax.Array, belief: Belief, n: int, inflation: Factor = 1.0) -> Array:
    """`n` draws of the mixture, those outside the support moved to its nearest point (the paper's choice).

    Clipping puts atoms of probability on the bounds; `rejected` does not.

    Args:
        key: consumed.
        belief: what is drawn from.
        n: how many.
        inflation: how many times as wide as the mixture, about its mean.
    """
    return belief.support.clip(belief.mixture.inflated(inflation).sample(key, n))


def rejected(key: jax.Array, belief: Belief, n: int, inflation: Factor = 1.0) -> Array:
    """`n` draws of the mixture truncated to the support (`jaxlfi.distributions.truncation.rejection_sample`)."""
    return rejection_sample(key, belief.mixture.inflated(inflation).sample, belief.support, n)


def mixed(key: jax.Array, belief: Belief, n: int, inflation: Factor = 1.0) -> Array:
    """`n` draws: as by `clipped` for the mass that the mixture has outside the support, as by `rejected` for the rest.

    While much of the posterior lies beyond a bound, clipped draws on that bound show the network where it wants to go.
    Once all of it is inside, wide proposals are wanted, and would pile up on the bounds if they were clipped. The mass
    outside is that of the mixture itself, as wide as it is.
    """
    key_posterior, key_wide = jax.random.split(key)
    draws = belief.mixture.sample(key_posterior, n)
    inside = belief.support.contains(draws)[:, None]
    return jnp.where(inside, rejected(key_wide, belief, n, inflation), belief.support.clip(draws))


RESTRICTIONS = {"clip": clipped, "reject": rejected, "mixed": mixed}
"""Ways to keep *proposals* inside the support, by name (reading E). Draws of a posterior are never clipped."""
