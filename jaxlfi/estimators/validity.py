"""Validity: the probability that a simulation succeeds, learnt from all attempts.

Networks learn from simulations that succeeded. If success depends on the parameters, it selects them just as the
proposals do; and an estimator that does not depend on the proposals (a likelihood, the atomic losses) does not account
for this selection either. The posterior given that the observation is valid, p(theta | x, valid), is then the learnt
density times P(valid | theta).
"""

from typing import cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.base import Network, untrained
from jaxlfi.estimators.dataset import Dataset
from jaxlfi.estimators.likelihood import Likelihood
from jaxlfi.estimators.mdn import ACTIVATIONS, Dense
from jaxlfi.estimators.training import fit
from jaxlfi.fields import option


class Success(struct.PyTreeNode):
    """The outcome of a simulation, 1 for success and 0 for failure: a Bernoulli variable with a given logit."""

    logit: Float[Array, "*batch"]

    def log_prob(self, x: Float[Array, "*batch one"]) -> Float[Array, "*batch"]:
        """Log-probability of an outcome, 1 for success."""
        return jax.nn.log_sigmoid(jnp.where(x[..., 0] > 0.5, self.logit, -self.logit))


class SuccessNetwork(nn.Module):
    """A multilayer perceptron from parameters to the probability of success."""

    hidden: tuple[int, ...]

    @nn.compact
    def __call__(self, theta: Float[Array, "*batch dim"]) -> Success:
        """The probability for each parameter vector."""
        h = theta
        for units in self.hidden:
            h = ACTIVATIONS["tanh"](Dense(units)(h))
        return Success(Dense(1)(h)[..., 0])


class SuccessLikelihood(Likelihood):
    """The likelihood of an outcome, as if it were a summary."""

    hidden: tuple[int, ...] = option(default=(32, 32), low=1, help="units per hidden layer")

    def module(self, dim: int) -> nn.Module:
        """The Flax network of one ensemble member."""
        return SuccessNetwork(self.hidden)


ESTIMATOR = SuccessLikelihood(
    ensemble_size=4,
    epochs=0,
    steps=1000,
    batch_size=100,
    learning_rate=5e-3,
    schedule="cosine",
    validation=0.2,
    warm_start=False,
    normaliser="none",
    noise_floor=0.0,
)
"""Four small networks, each with the weights of the epoch that was best on the held-out fifth of the attempts."""


class Validity(struct.PyTreeNode):
    """The probability that a simulation succeeds, given its parameters.

    Attributes:
        network: likelihood network of the outcome.
        failures: number of failures among the attempts it has learnt from; without any, everything succeeds.
    """

    network: Network
    failures: Int[Array, "*batch"]

    def log_prob(self, theta: Float[Array, "*n dim"]) -> Float[Array, "*n"]:
        """Logarithm of the probability, at parameters in inference space."""
        learnt = cast(Likelihood, self.network.estimator).log_likelihood(self.network, jnp.ones(1), theta)
        return jnp.where(self.failures > 0, learnt, 0.0)

    def learnt(self, key: jax.Array, attempts: Dataset) -> "Validity":
        """The same, trained on all attempts so far; nothing is trained if all have succeeded.

        Args:
            key: consumed.
            attempts: parameters of all attempted simulations, whose summaries are 1 for success and 0 for failure.
        """
        failures = jnp.sum(attempts.valid & (attempts.x[:, 0] < 0.5))
        weights = attempts.valid.astype(jnp.float32)
        # As plain numbers: JAX's check for reused keys mistakes a branch under vmap for reuse.
        numbers, kind = jax.random.key_data(key), jax.random.key_impl(key)

        def trained() -> Network:
            own = jax.random.wrap_key_data(numbers, impl=kind)
            return fit(own, self.network, attempts, weights, attempts.capacity)[0]

        network = jax.lax.cond(failures > 0, trained, lambda: self.network)
        return Validity(network, failures)


def unknown(key: jax.Array, scale: Support, space: Space) -> Validity:
    """The state before anything is learnt: every simulation succeeds."""
    return Validity(untrained(key, ESTIMATOR, 1, scale, space), jnp.zeros((), jnp.int32))
