"""Stacking: weights of an ensemble's members by their predictions of simulations that none of them was trained on."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

PASSES = 200
"""Passes of expectation maximisation; the objective is concave, and little changes after fifty."""
PSEUDO_ROWS = 0.25
"""Pseudo-count of rows explained by each member: with very few rows, weights stay nearly equal."""
LEAST = 0.05
"""Weight below which a member is left out: a wide one of low weight still adds to the variance."""


def stacked(log_scores: Float[Array, "member row"], counts: Float[Array, " row"]) -> Float[Array, " member"]:
    """Log-weights that maximise the log score of the members' mixture (Yao et al. 2018).

    Args:
        log_scores: log-density of each row under each member, shape [E, N].
        counts: weight of each row, at most 1; rows of weight 0 may have any score, shape [N].

    Returns:
        Shape [E]; equal if no row has weight.

    Example:
        >>> scores = jnp.log(jnp.array([[0.5] * 40, [0.1] * 40]))
        >>> jnp.exp(stacked(scores, jnp.ones(40))).round(2).tolist()
        [1.0, 0.0]
    """
    members = len(log_scores)
    finite = jnp.all(jnp.isfinite(log_scores) | (log_scores == -jnp.inf), axis=0) & jnp.any(
        log_scores > -jnp.inf, axis=0
    )
    counts = jnp.where(finite, counts, 0.0)
    relative = jnp.exp(jnp.where(finite, log_scores - jnp.max(log_scores, axis=0), 0.0))

    def passed(_, weights):
        share = weights[:, None] * relative
        share = share / jnp.sum(share, axis=0)
        explained = PSEUDO_ROWS + jnp.sum(counts * share, axis=1)
        return explained / jnp.sum(explained)

    weights = jax.lax.fori_loop(0, PASSES, passed, jnp.full(members, 1 / members))
    return jax.nn.log_softmax(jnp.where(weights < LEAST, -jnp.inf, jnp.log(weights)))
