"""Belief: a posterior mixture and the support it lives on, in one pytree."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support


@struct.dataclass
class Belief:
    """What is believed of the parameters after a round: p_(Theta) in the paper.

    Attributes:
        mixture: the posterior as a mixture of Gaussians (unbounded).
        support: the box Theta its draws are kept in.
        informed: whether the next proposals are drawn from the mixture, or else from the prior over the support. False
            before the first round, when there is no posterior yet and the mixture is a stand-in of the right shape,
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


def rejected(key: jax.Array, belief: Belief, n: int, tries: int = 32) -> Array:
    """`n` draws of the mixture truncated to the support, by rejection with a bounded number of tries.

    Every draw has its own `tries` candidates and takes the first inside the box. Where none is (a mixture almost
    wholly outside its support), it is a uniform draw over the support, so that the time is bounded and the box is
    always respected.
    """
    key_candidates, key_fallback = jax.random.split(key)
    candidates = belief.mixture.sample(key_candidates, n * tries).reshape(n, tries, -1)
    inside = belief.support.contains(candidates)
    first = jnp.take_along_axis(candidates, jnp.argmax(inside, axis=1)[:, None, None], axis=1)[:, 0]
    return jnp.where(jnp.any(inside, axis=1)[:, None], first, belief.support.sample(key_fallback, n))


RESTRICTIONS = {"clip": clipped, "reject": rejected}
"""Ways to keep draws inside the support, by name (reading E)."""
