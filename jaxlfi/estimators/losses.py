"""Training losses of a minibatch, by name."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from jaxlfi.estimators.atomic_loss import atomic, nll

ATOMS = 10
"""Largest number M of parameter vectors that the atomic loss compares for each simulation (the paper's appendix A)."""


class Rows(struct.PyTreeNode):
    """Simulations as the network sees them.

    A posterior network gives a density of parameters for a summary, a likelihood network one of summaries for
    parameters (`Estimator.rows`).

    Attributes:
        value: variables that q is a density of, shape [N, V].
        given: inputs of the network, shape [N, G].
        weights: weight of each row in the loss, shape [N].
        log_prior: log-density of the prior, up to a constant, shape [N].
        from_prior: 1 for rows drawn from the prior itself, in the first round, 0 for others, shape [N].
    """

    value: Float[Array, "*batch n value"]
    given: Float[Array, "*batch n given"]
    weights: Float[Array, "*batch n"]
    log_prior: Float[Array, "*batch n"]
    from_prior: Float[Array, "*batch n"]

    def take(self, rows: Int[Array, " m"]) -> "Rows":
        """Some of the rows."""
        return jax.tree.map(lambda leaf: leaf[rows], self)


@dataclasses.dataclass(frozen=True)
class Loss:
    """A loss for a minibatch, and one for the held-out simulations, where rows of weight 0 are padding.

    Attributes:
        training: (key, q, rows) -> loss. q has one conditional density for each row.
        held_out: the same for held-out simulations, normalised by the sum of their weights.
    """

    training: Callable[[jax.Array, Any, Rows], Array]
    held_out: Callable[[jax.Array, Any, Rows], Array]


def likelihood(key: jax.Array, q: Any, rows: Rows) -> Float[Array, ""]:
    """Weighted -log q: q learns the density of the values under the distribution of the weighted rows."""
    return -jnp.mean(rows.weights * q.log_prob(rows.value))


def held_out_likelihood(key: jax.Array, q: Any, rows: Rows) -> Float[Array, ""]:
    """The same, divided by the sum of the weights."""
    return nll(q.log_prob(rows.value), rows.weights)


def contrastive(key: jax.Array, q: Any, rows: Rows) -> Float[Array, ""]:
    """The atomic loss of APT (`jaxlfi.estimators.atomic_loss`): q learns the posterior under the prior."""
    return atomic(key, q.log_prob, rows.value, rows.log_prior, rows.weights, min(ATOMS, rows.value.shape[0]))


def combined(key: jax.Array, q: Any, rows: Rows) -> Float[Array, ""]:
    """The atomic loss plus -log q of the rows drawn from the prior, which keeps q small where nothing is proposed."""
    atoms = min(ATOMS, rows.value.shape[0])
    return atomic(key, q.log_prob, rows.value, rows.log_prior, rows.weights, atoms, rows.from_prior)


LOSSES: dict[str, Loss] = {
    "likelihood": Loss(likelihood, held_out_likelihood),
    "atomic": Loss(contrastive, contrastive),
    "combined": Loss(combined, combined),
}
"""Losses by name."""
