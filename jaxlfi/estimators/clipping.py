"""Clipping of outliers among the predictors, which makes a linear regression robust at little cost."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

FEWEST = 10
"""Smallest number of predictors from which outliers among them can be recognised."""
LARGEST = 1.5
"""Largest distance of a predictor from its expected value, in robust standard deviations (close to Huber 1964)."""
TO_DEVIATION = 1.4826
"""A normal's standard deviation, in units of its median absolute deviation."""
LEAST = 1e-3
"""Smallest robust standard deviation, for predictors that vary by about 1."""
STEPS = 8
"""Number of steps of each iteration: a step multiplies the error by about the fraction of predictors clipped."""
ROUNDING = 10 * float(jnp.finfo(jnp.float32).eps)
"""Fraction of its trace added to a matrix before inversion. Iterations have the same fixed point without it."""


class Clipping(struct.PyTreeNode):
    """Expected values of the predictors at the parameters estimated from them, and the limits around these.

    An outlier moves a linear regression in proportion to its size. But D parameters are estimated from many predictors,
    most of which are not outliers, and these imply what the others should have been. The parameters are estimated by
    Huber's method in a linear model of the predictors, under a standard normal prior (Huber 1964).

    Attributes:
        response: change of the expected predictors with the standardised parameters, shape [S, D].
        offset: expected predictors at the parameters' mean, shape [S].
        limit: largest distance from the expected predictors, shape [S].
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
        """The expected predictors at the parameters estimated from them."""
        dim = self.response.shape[-1]
        by_predictor = self.response * (LARGEST / self.limit[:, None]) ** 2
        covariance = preconditioner(self.response.T @ by_predictor + jnp.eye(dim))
        expected = lambda theta: theta @ self.response.T + self.offset
        away = lambda theta: jnp.clip(z - expected(theta), -self.limit, self.limit)
        nearer = lambda _, theta: theta + (away(theta) @ by_predictor - theta) @ covariance
        return expected(jax.lax.fori_loop(0, STEPS, nearer, jnp.zeros((*z.shape[:-1], dim), z.dtype)))


def no_clipping(dim: int, predictors: int) -> Clipping:
    """The state before there are simulations."""
    return Clipping(jnp.zeros((predictors, dim)), jnp.zeros(predictors), jnp.ones(predictors))


def clipping(z: Float[Array, "n predictor"], theta: Float[Array, "n dim"], counted: Bool[Array, " n"]) -> Clipping:
    """A linear model of each predictor, fitted to some rows by Huber's regression, and its limits.

    Args:
        z: predictors, shape [N, S].
        theta: parameters, shape [N, D].
        counted: true for the rows that are used, shape [N].
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
    """Approximate inverse of a precision matrix; finite even if redundant parameters make it numerically singular."""
    lifted = matrix + ROUNDING * jnp.trace(matrix) * jnp.eye(len(matrix))
    return jax.scipy.linalg.solve(lifted, jnp.eye(len(matrix)), assume_a="pos")
