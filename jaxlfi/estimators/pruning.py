"""Pruning: which of the small components of an ensemble's mixtures are kept.

A component of low weight may be undertrained: its mean and covariance are then arbitrary, and differ from network to
network. Or it represents the tail of a skewed posterior, and then the other networks have mass there, too. If tails are
dropped, each round simulates less of them than the last, and a posterior with a long tail can shrink to a fifth of its
width within ten rounds.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.normal_points import normal_points

CONFIRMED = 0.1
"""Weight that a component needs if other networks confirm it, relative to what it needs by itself."""
AGREEMENT = 0.5
"""Smallest agreement that counts as confirmation."""


def pruned(
    mixtures: GaussianMixture, least: Float[Array, ""] | float, log_weights: Float[Array, " member"]
) -> GaussianMixture:
    """Mixtures without their components of low weight that other networks do not confirm.

    Args:
        mixtures: stacked mixtures of E networks, logits [E, K].
        least: weight from which on a component is kept by itself; the heaviest always is.
        log_weights: log-weights of the networks, shape [E].

    Returns:
        The mixtures, in which dropped components have logits of -inf.

    Example:
        >>> two = lambda place: GaussianMixture(
        ...     jnp.log(jnp.array([0.95, 0.05])), jnp.array([[0.0], [place]]), jnp.array([[[1.0]], [[2.0]]])
        ... )
        >>> stack = lambda *mixtures: jax.tree.map(lambda *leaves: jnp.stack(leaves), *mixtures)
        >>> (pruned(stack(two(5.0), two(5.5)), 0.1, jnp.zeros(2)).weights > 0).tolist()  # a tail
        [[True, True], [True, True]]
        >>> (pruned(stack(two(5.0), two(-30.0)), 0.1, jnp.zeros(2)).weights > 0).tolist()  # strays
        [[True, False], [True, False]]
    """
    alone = jax.vmap(lambda one: one.prune(least))(mixtures)
    confirmed = (mixtures.weights >= CONFIRMED * least) & (agreement(mixtures, log_weights) >= AGREEMENT)
    return mixtures.replace(logits=jnp.where(confirmed, mixtures.logits, alone.logits))


def agreement(mixtures: GaussianMixture, log_weights: Float[Array, " member"]) -> Float[Array, "member comp"]:
    """To what extent the other networks have mass where a component lies: the mean of min(1, others / own) over it.

    Here `own` is the density of the component's network, and `others` the weighted mean of the other networks'. It is 1
    if all are the same, and 0 for a single network.
    """
    members, _, dim = mixtures.means.shape
    normal = normal_points(dim)
    points = mixtures.means[:, :, None] + jnp.einsum("ekij,nj->ekni", mixtures.scale_tril, normal)
    each = jax.vmap(lambda one: one.log_prob(points))(mixtures)
    itself = jnp.eye(members, dtype=bool)
    shares = jnp.where(itself, -jnp.inf, log_weights[:, None])
    # If only one network has any weight, the others are weighted equally for it.
    shares = jnp.where(jnp.any(jnp.isfinite(shares), axis=0) | itself, shares, -math.log(max(members - 1, 1)))
    shares = jax.nn.log_softmax(shares, axis=0) if members > 1 else shares
    others = jax.nn.logsumexp(each + shares[:, :, None, None], axis=0)
    own = each[jnp.arange(members), jnp.arange(members)]
    return jnp.mean(jnp.minimum(jnp.exp(others - own), 1.0), axis=-1)
