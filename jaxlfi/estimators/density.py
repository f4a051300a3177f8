"""Densities: q_phi(theta | x) for one x, before truncation."""

from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float


@runtime_checkable
class Density(Protocol):
    """A density over inference space: a mixture of Gaussians, or an ensemble of conditional densities."""

    def log_prob(self, theta: Float[Array, "*n dim"]) -> Float[Array, "*n"]:
        """Log-density at theta."""
        ...

    def sample(self, key: jax.Array, n: int) -> Float[Array, "n dim"]:
        """`n` independent draws."""
        ...


class EnsembleDensity(struct.PyTreeNode):
    """The mixture of an ensemble's conditional densities.

    Attributes:
        each: the networks' outputs for one x, stacked along a leading axis of length E: a pytree with `log_prob` and
            `sample` of parameters as the networks see them.
        shift: offset from the networks' parameters to inference space, shape [D].
        scale: factor of the same map, shape [D].
        log_weights: normalised log-weights of the networks, shape [E].
    """

    each: Any
    shift: Float[Array, "*batch dim"]
    scale: Float[Array, "*batch dim"]
    log_weights: Float[Array, "*batch member"]

    def log_prob(self, theta: Float[Array, "*n dim"]) -> Float[Array, "*n"]:
        """Log-density at theta: the weighted mean of the networks' densities."""
        inner = (theta - self.shift) / self.scale
        log_each = jax.vmap(lambda q: q.log_prob(inner))(self.each)
        log_weights = self.log_weights.reshape(-1, *[1] * (log_each.ndim - 1))
        return jax.nn.logsumexp(log_each + log_weights, axis=0) - jnp.sum(jnp.log(self.scale))

    def sample(self, key: jax.Array, n: int) -> Float[Array, "n dim"]:
        """`n` independent draws, each from a network chosen at random; some may be outside any support."""
        keys = jax.random.split(key, len(self.log_weights) + 1)
        draws = jax.vmap(lambda key, q: q.sample(key, n))(keys[:-1], self.each)
        # Not in turn: a caller who takes the first of several draws inside a box would favour the first network.
        choice = jax.random.categorical(keys[-1], self.log_weights, shape=(n,))
        return self.shift + self.scale * draws[choice, jnp.arange(n)]
