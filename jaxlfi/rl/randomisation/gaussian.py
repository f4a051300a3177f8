"""A Gaussian distribution of parameters, p_phi in the papers of SimOpt and DROPO."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.rl.domains import Domain


class Gaussian(struct.PyTreeNode):
    """Parameters theta ~ N(mean, covariance) in inference space.

    Attributes:
        mean: mu, shape [D].
        covariance: Sigma, positive definite, shape [D, D].
    """

    mean: Float[Array, "*batch dim"]
    covariance: Float[Array, "*batch dim dim"]

    @property
    def deviation(self) -> Float[Array, "*batch dim"]:
        """Marginal standard deviations of the parameters."""
        return jnp.sqrt(jnp.diagonal(self.covariance, axis1=-2, axis2=-1))

    def sample(self, key: jax.Array, n: int) -> Float[Array, "n dim"]:
        """`n` draws, in inference space."""
        factor = jnp.linalg.cholesky(self.covariance)
        return self.mean + jax.random.normal(key, (n, len(self.mean))) @ factor.T

    def domain(self, key: jax.Array, space: Space, limits: Support, n: int) -> Domain:
        """`n` draws to train on, in natural units and clipped to a box, like those of a posterior."""
        return Domain(limits.clip(space.to_natural(self.sample(key, n))))


def divergence(new: Gaussian, old: Gaussian) -> Float[Array, ""]:
    """The Kullback-Leibler divergence KL(new || old), in nats.

    Example:
        >>> narrow, wide = (Gaussian(jnp.zeros(1), jnp.full((1, 1), variance)) for variance in (1.0, 4.0))
        >>> round(float(divergence(narrow, wide)), 4)  # ln 2 - 3/8
        0.3181
    """
    ours, theirs = jnp.linalg.cholesky(new.covariance), jnp.linalg.cholesky(old.covariance)
    scaled = jax.scipy.linalg.solve_triangular(theirs, ours, lower=True)
    shift = jax.scipy.linalg.solve_triangular(theirs, new.mean - old.mean, lower=True)
    log_volume = jnp.sum(jnp.log(jnp.diagonal(theirs)) - jnp.log(jnp.diagonal(ours)))
    return log_volume + 0.5 * (jnp.sum(scaled**2) + jnp.sum(shift**2) - len(new.mean))
