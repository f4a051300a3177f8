"""Losses of sequential neural posterior estimation by APT (Greenberg et al. 2019)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int


class Contrasts(struct.PyTreeNode):
    """The other rows of a minibatch that each row is compared with.

    Attributes:
        rows: row numbers, shape [M - 1, B].
        present: false where there were not enough rows of positive weight, shape [M - 1, B].
    """

    rows: Int[Array, "others batch"]
    present: Bool[Array, "others batch"]


def nll(log_prob: Float[Array, " batch"], weights: Float[Array, " batch"]) -> Float[Array, ""]:
    """Weighted mean of -log q(theta | x): the loss where theta is drawn from the prior.

    Args:
        log_prob: log q of each row, in nats. Rows of weight 0 may have any value.
        weights: nonnegative weight of each row, shape [B].

    Returns:
        The mean; 0 if all weights are 0.
    """
    return -_weighted_mean(log_prob, weights)


def contrast(key: jax.Array, weights: Float[Array, " batch"], atoms: int = 10) -> Contrasts:
    """Draw M - 1 distinct other rows for each row, without replacement, among those of positive weight.

    The R rows of positive weight are put on a circle in random order, and M - 1 distinct steps along it are drawn; a
    row's contrasts are the rows that many steps further. For each single row the set is thus uniformly distributed. If
    R < M, a row gets the R - 1 others.

    Args:
        key: consumed.
        weights: weight of each row, shape [B].
        atoms: M, the row's own theta included.

    Raises:
        ValueError: for fewer than 2 atoms, or more than rows.
    """
    batch = weights.shape[0]
    if not 2 <= atoms <= batch:
        raise ValueError(f"atoms: expected 2 up to the {batch} rows of a minibatch, got {atoms}")
    key_order, key_steps = jax.random.split(key)
    usable = weights > 0
    count = jnp.sum(usable)
    order = jnp.argsort(jnp.where(usable, jax.random.uniform(key_order, (batch,)), 2.0))
    place = jnp.argsort(order)
    number = jnp.arange(1, batch)
    steps = 1 + jnp.argsort(jnp.where(number < count, jax.random.uniform(key_steps, (batch - 1,)), 2.0))[: atoms - 1]
    rows = order[(place + steps[:, None]) % jnp.maximum(count, 1)]
    present = (steps < count)[:, None] & usable
    return Contrasts(rows, present)


def atomic(
    key: jax.Array,
    log_prob: Callable[[Float[Array, "atoms batch dim"]], Float[Array, "atoms batch"]],
    theta: Float[Array, "batch dim"],
    log_prior: Float[Array, " batch"],
    weights: Float[Array, " batch"],
    atoms: int = 10,
    combined: Float[Array, " batch"] | float = 0.0,
) -> Float[Array, ""]:
    """The atomic loss of APT: classify which of M theta generated x (Greenberg et al. 2019, section 3.2).

    The mean of -log [ (q_0 / p_0) / sum_j (q_j / p_j) ], with q_j = q(theta_j | x), p_j the prior's density, theta_0
    the row's own and the others drawn by `contrast`. For any proposal, the loss is minimised by the posterior
    under the prior p.

    The loss does not determine q where no theta was proposed, and elsewhere only up to a factor for each x (leakage).
    The combined loss of sbi (`use_combined_loss`) adds -log q of the rows that were drawn from the prior itself.

    Args:
        key: consumed.
        log_prob: log q of M parameter vectors for each row's x, such as `module.apply(params, x).log_prob`.
        theta: shape [B, D]. Rows that repeat a theta are atoms like any other, so avoid repeats (such as clipped
            draws). Rows of weight 0 may have any theta, but their x must be finite.
        log_prior: log-density of theta under the prior, up to a constant; zeros for a uniform one. Finite where the
            weight is positive.
        weights: nonnegative weight of each row, shape [B]. A row of weight 0 is not an atom of others either.
        atoms: M.
        combined: weight of a row's -log q, which is added to its atomic loss: 1 (as in sbi) for rows drawn from the
            prior and 0 for others, or 0 for the atomic loss alone.

    Returns:
        The weighted mean over rows; 0 if all weights are 0.

    Raises:
        ValueError: for fewer than 2 atoms, or more than rows.
    """
    contrasts = contrast(key, weights, atoms)
    usable = weights > 0
    theta = jnp.where(usable[:, None], theta, 0.0)
    log_prior = jnp.where(usable, log_prior, 0.0)
    own = jnp.arange(theta.shape[0])[None]
    rows = jnp.concatenate([own, contrasts.rows])
    log_q = log_prob(theta[rows])
    log_ratio = log_q - log_prior[rows]
    present = jnp.concatenate([jnp.ones_like(own, bool), contrasts.present])
    named = log_ratio[0] - jax.nn.logsumexp(jnp.where(present, log_ratio, -jnp.inf), axis=0)
    return nll(named + combined * log_q[0], weights)


def _weighted_mean(values: Float[Array, " batch"], weights: Float[Array, " batch"]) -> Float[Array, ""]:
    """The mean over rows of positive weight; the values of other rows have no effect."""
    total = jnp.sum(weights)
    sum_ = jnp.sum(weights * jnp.where(weights > 0, values, 0.0))
    return jnp.where(total > 0, sum_ / jnp.where(total > 0, total, 1.0), 0.0)
