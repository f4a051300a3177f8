"""Predictors without outliers: what makes a linear regression robust at little cost."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

FEWEST = 10
"""Predictors that tell which of them are wrong, at least."""
LARGEST = 1.5
"""Robust standard deviations that a predictor may be from its expected value (Huber 1964 recommends about as many)."""
TO_DEVIATION = 1.4826
"""A normal's standard deviation, in medians of its absolute deviations."""
LEAST = 1e-3
"""Robust standard deviation at least, where predictors vary by about 1."""
STEPS = 8
"""Of each iteration: a step leaves about as much of what is missing as the fraction of predictors that are clipped."""
ROUNDING = 10 * float(jnp.finfo(jnp.float32).eps)
"""Of the trace: what a matrix gains before it is inverted. Iterations end where they would without it."""


class Clipping(struct.PyTreeNode):
    """What predictors are expected to be at the parameters estimated from them, and how far from that they may be.

    An outlier moves a linear regression in proportion to its size. But D parameters are estimated from many predictors,
    most of which are not outliers, and these imply what the others should have been. The parameters are estimated by
    Huber's method in a linear model of the predictors, under a standard normal prior (Huber 1964).

    Attributes:
        response: change of the expected predictors with the standardised parameters, shape [S, D].
        offset: what they are expected to be at the parameters' mean, shape [S].
        limit: how far from what is expected they may be, shape [S].
    """

    response: Float[Array, "*batch predictor dim"]
    offset: Float[Array, "*batch predictor"]
    limit: Float[Array, "*batch predictor"]

    def __call__(self, z: Float[Array, "*n predictor"]) -> Float[Array, "*n predictor"]:
        """The predictors, clipped."""
        expected = self.expected(z)
        return expected + jnp.clip(z - expected, -self.limit, self.limit)

    def residuals(self, z: Float[Array, "*n predictor"]) -> Float[Array, "*n predictor"]:
        """How far the predictors are from what the others imply, in robust standard deviations."""
        return (z - self.expected(z)) * (LARGEST / self.limit)

    def expected(self, z: Float[Array, "*n predictor"]) -> Float[Array, "*n predictor"]:
        """What the predictors are expected to be at the parameters estimated from them."""
        dim = self.response.shape[-1]
        by_predictor = self.response * (LARGEST / self.limit[:, None]) ** 2
        covariance = preconditioner(self.response.T @ by_predictor + jnp.eye(dim))
        expected = lambda theta: theta @ self.response.T + self.offset
        away = lambda theta: jnp.clip(z - expected(theta), -self.limit, self.limit)
        nearer = lambda _, theta: theta + (away(theta) @ by_predictor - theta) @ covariance
        return expected(jax.lax.fori_loop(0, STEPS, nearer, jnp.zeros((*z.shape[:-1], dim), z.dtype)))


def no_clipping(dim: int, predictors: int) -> Clipping:
    """Before there are simulations."""
    return Clipping(jnp.zeros((predictors, dim)), jnp.zeros(predictors), jnp.ones(predictors))


def clipping(z: Float[Array, "n predictor"], theta: Float[Array, "n dim"], counted: Bool[Array, " n"]) -> Clipping:
    """The linear model of each predictor by some rows, by Huber's regression, and its limits.

    Args:
        z: predictors, shape [N, S].
        theta: parameters, shape [N, D].
        counted: the rows that count, shape [N].
    """
    rows, there = jnp.maximum(jnp.sum(counted), 1), counted[:, None]
    from_mean = theta - jnp.sum(theta, axis=0, where=there) / rows
    deviation = jnp.sqrt(jnp.sum(from_mean**2, axis=0, where=there) / rows)
    standard = from_mean / jnp.maximum(deviation, jnp.finfo(theta.dtype).eps)
    design = jnp.where(there, jnp.concatenate([standard, jnp.ones_like(theta[:, :1])], axis=1), 0.0)
    to_coefficients = preconditioner(design.T @ design + jnp.eye(design.shape[1])) @ design.T
    away = lambda found: jnp.where(there, z - design @ found, 0.0)

    def limit(found: Array) -> Array:
        usual = jnp.nanmedian(jnp.where(there, jnp.abs(away(found)), jnp.nan), axis=0)
        return LARGEST * jnp.maximum(TO_DEVIATION * jnp.nan_to_num(usual), LEAST)

    least_squares = to_coefficients @ jnp.where(there, z, 0.0)
    bound = limit(least_squares)
    nearer = lambda _, found: found + to_coefficients @ jnp.clip(away(found), -bound, bound)
    found = jax.lax.fori_loop(0, STEPS, nearer, least_squares)
    return Clipping(found[:-1].T, found[-1], limit(found))


def preconditioner(matrix: Float[Array, "dim dim"]) -> Float[Array, "dim dim"]:
    """About the inverse of a precision matrix; finite where parameters that act alike leave it singular in rounding."""
    lifted = matrix + ROUNDING * jnp.trace(matrix) * jnp.eye(len(matrix))
    return jax.scipy.linalg.solve(lifted, jnp.eye(len(matrix)), assume_a="pos")
