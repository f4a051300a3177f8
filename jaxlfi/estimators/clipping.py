"""Predictors without outliers: what makes a linear regression robust at little cost."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.estimators.ridge import ridge

LARGEST = 1.5
"""Robust standard deviations that a predictor may be from its expected value (Huber 1964, who has this range)."""
TO_DEVIATION = 1.4826
"""A normal's standard deviation, in medians of its absolute deviations."""


class Clipping(struct.PyTreeNode):
    """What predictors are expected to be at the parameters read from them, and how far from that they may be.

    A sensor that now and then reports anything moves a linear regression by as much as it is wrong. But D parameters
    are read from many predictors, of which most are right, and say what the others should have been.

    Attributes:
        reading: what the parameters are read by, shape [D, S].
        response: what the predictors are expected to be by the parameters, shape [S, D].
        offset: what they are expected to be where the reading is zero, shape [S].
        limit: how far from that they may be, shape [S].
    """

    reading: Float[Array, "*batch dim predictor"]
    response: Float[Array, "*batch predictor dim"]
    offset: Float[Array, "*batch predictor"]
    limit: Float[Array, "*batch predictor"]

    def __call__(self, z: Float[Array, "*n predictor"]) -> Float[Array, "*n predictor"]:
        """The predictors, clipped."""
        return self.about(z @ self.reading.T @ self.response.T + self.offset, z)

    def about(self, expected: Float[Array, "*n predictor"], z: Float[Array, "*n predictor"]) -> Array:
        """Predictors clipped to within the limits of what they are expected to be."""
        return expected + jnp.clip(z - expected, -self.limit, self.limit)


def no_clipping(dim: int, predictors: int) -> Clipping:
    """All predictors are zero."""
    zeros = jnp.zeros(predictors)
    return Clipping(jnp.zeros((dim, predictors)), jnp.zeros((predictors, dim)), zeros, zeros)


def clipping(
    z: Float[Array, "n predictor"],
    theta: Float[Array, "n dim"],
    counted: Bool[Array, " n"],
    regression: tuple[Float[Array, "dim predictor"], Float[Array, " dim"], Float[Array, "n dim"]],
) -> tuple[Clipping, Float[Array, "n predictor"]]:
    """Limits from some rows, and all rows clipped.

    The parameters of the rows that count are read by regressions fitted to the other folds: what a row is clipped to
    must not tell its parameters.

    Args:
        z: predictors, shape [N, S].
        theta: parameters, shape [N, D].
        counted: the rows that count, shape [N].
        regression: of the parameters on the predictors, by `ridge` over these rows.
    """
    reading, intercept, by_others = regression
    response, at_zero, _ = ridge(theta, z, counted)
    away = jnp.abs(z - theta @ response.T - at_zero)
    usual = jnp.nanmedian(jnp.where(counted[:, None], away, jnp.nan), axis=0)
    limit = LARGEST * TO_DEVIATION * jnp.nan_to_num(usual)
    found = Clipping(reading, response, response @ intercept + at_zero, limit)
    read = jnp.where(counted[:, None], by_others, z @ reading.T)
    return found, found.about(read @ response.T + found.offset, z)
