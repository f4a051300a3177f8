"""Likelihood networks as estimators."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.estimators.likelihood import Likelihood
from jaxlfi.estimators.mdn import ACTIVATIONS, Dense
from jaxlfi.fields import option


class SummaryMixture(struct.PyTreeNode):
    """A mixture of Gaussians over summaries, parametrised by the Cholesky factors of its precisions.

    Like `jaxlfi.estimators.mdn.MixtureHead`, but with the factors' entries below the diagonal as a vector: there are
    many more summaries than parameters, and building the matrices took half of the training time.

    Attributes:
        logits: unnormalised log-weights, shape [..., K].
        means: shape [..., K, S].
        log_diagonal: logarithms of the factors' diagonals, shape [..., K, S].
        below: the factors' entries below the diagonal, row by row, shape [..., K, S (S - 1) / 2].
    """

    logits: Float[Array, "*batch comp"]
    means: Float[Array, "*batch comp obs"]
    log_diagonal: Float[Array, "*batch comp obs"]
    below: Float[Array, "*batch comp off"]

    def log_prob(self, x: Float[Array, "*batch obs"]) -> Float[Array, "*batch"]:
        """Log-density at x, one x for each mixture of the batch."""
        obs = x.shape[-1]
        rows, columns = np.tril_indices(obs, -1)
        # Products with constant matrices: gathers would become scatters in the gradient.
        at_column = (columns == np.arange(obs)[:, None]).astype(np.float32)
        to_row = (rows[:, None] == np.arange(obs)).astype(np.float32)
        offset = x[..., None, :] - self.means
        whitened = jnp.exp(self.log_diagonal) * offset + (self.below * (offset @ at_column)) @ to_row
        component = jnp.sum(self.log_diagonal - 0.5 * whitened**2, axis=-1) - 0.5 * obs * np.log(2 * np.pi)
        return jax.nn.logsumexp(jax.nn.log_softmax(self.logits) + component, axis=-1)


class SummaryNetwork(nn.Module):
    """A multilayer perceptron from parameters to a mixture over normalised summaries.

    Attributes:
        components: K.
        obs: S.
        hidden: units of each hidden layer.
        activation: name in `ACTIVATIONS`.
    """

    components: int
    obs: int
    hidden: tuple[int, ...]
    activation: str

    @nn.compact
    def __call__(self, theta: Float[Array, "*batch dim"]) -> SummaryMixture:
        """The mixture for each parameter vector."""
        h = theta
        for units in self.hidden:
            h = ACTIVATIONS[self.activation](Dense(units)(h))
        components, obs = self.components, self.obs
        sizes = np.array([1, obs, obs, obs * (obs - 1) // 2])
        parts = jnp.split(Dense(int(components * sizes.sum()))(h), np.cumsum(components * sizes)[:-1], axis=-1)
        logits, means, log_diagonal, below = (
            part.reshape(*theta.shape[:-1], components, size) for part, size in zip(parts, sizes, strict=True)
        )
        # As in the mixture density network: e^1 at the start, and standard deviations of at least e^-7.
        return SummaryMixture(logits[..., 0], means, jnp.clip(log_diagonal + 1.0, -7.0, 7.0), below)


class MixtureLikelihood(Likelihood):
    """A mixture density network of the summary given the parameters.

    Attributes:
        hidden: units of each hidden layer.
        activation: "relu", "tanh" or "silu".

    Example:
        >>> MixtureLikelihood(hidden=(64, 64), components=2).is_likelihood
        True
    """

    hidden: tuple[int, ...] = option(default=(50, 50), low=1, help="units per hidden layer")
    activation: str = option(default="tanh", choices=tuple(ACTIVATIONS), help="activation function")

    def check(self) -> "MixtureLikelihood":
        """Refuse settings that cannot work, by name; returns the settings."""
        super().check()
        if not self.hidden:
            raise ValueError("hidden: expected at least one layer, got none")
        return self

    def module(self, dim: int) -> nn.Module:
        """The Flax network of one ensemble member for S summaries."""
        return SummaryNetwork(self.components, dim, self.hidden, self.activation)
