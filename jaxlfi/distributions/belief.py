"""Belief: a posterior mixture and the support it lives on, in one pytree."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool

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


def clipped(key: jax.Array, belief: Belief, n: int) -> Array:
    """`n` draws of the mixture, those outside the support moved to its nearest point (the paper's choice).

    Clipping puts atoms of probability on the bounds; `rejected` does not.
    """
    return belief.support.clip(belief.mixture.sample(key, n))


def rejected(key: jax.Array, belief: Belief, n: int) -> Array:
    """`n` draws of the mixture truncated to the support (`jaxlfi.distributions.truncation.rejection_sample`)."""
    return rejection_sample(key, belief.mixture.sample, belief.support, n)


RESTRICTIONS = {"clip": clipped, "reject": rejected}
"""Ways to keep *proposals* inside the support, by name (reading E). Draws of a posterior are never clipped."""
