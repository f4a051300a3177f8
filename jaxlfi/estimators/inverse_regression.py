"""Estimates of the parameters by a linear model of the predictors: for more predictors than simulations.

A regression of a parameter on the pixels of a picture has a coefficient for each, and with fewer simulations than
pixels it mostly learns noise. Inverse regression goes the other way (Cook 2007): each predictor is regressed on the few
parameters, whose coefficients all simulations determine well. In this model, with independent normal errors and a
standard normal prior, the posterior mean is linear in the predictors, and errors of single regressions average out.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.estimators.averages import LONG, shrunk
from jaxlfi.estimators.axes import products
from jaxlfi.estimators.ridge import FOLDS

MANY = 128
"""Smallest number of predictors for which these estimates are used: more than a round has simulations."""
LEAST = 1e-3
"""Smallest standard deviation of a predictor's errors, for predictors that vary by about 1."""


class InverseRegression(struct.PyTreeNode):
    """Estimates of the parameters, and their products.

    Attributes:
        directions: shape [S, D]; estimates along them have unit variance.
        centre: offset that is subtracted from the estimates, shape [D].
    """

    directions: Float[Array, "*batch predictor dim"]
    centre: Float[Array, "*batch dim"]

    def __call__(self, z: Float[Array, "*n predictor"]) -> Float[Array, "*n both"]:
        """The D estimates, and the products of any two."""
        return _with_products(z @ self.directions - self.centre)

    @property
    def size(self) -> int:
        """Number of estimates and products."""
        dim = self.directions.shape[-1]
        return dim + dim * (dim + 1) // 2


def no_estimates(dim: int, predictors: int) -> InverseRegression:
    """The state before there are simulations."""
    return InverseRegression(jnp.zeros((predictors, dim)), jnp.zeros(dim))


def inverse_regression(
    z: Float[Array, "n predictor"], theta: Float[Array, "n dim"], counted: Bool[Array, " n"]
) -> tuple[InverseRegression, Float[Array, "n both"]]:
    """Fit the linear model to some rows, and invert it.

    Args:
        z: predictors, shape [N, S].
        theta: parameters, shape [N, D].
        counted: true for the rows that are used, shape [N].

    Returns:
        The estimates; and those of each row by the model of the other folds, with their products. Row i is in fold i
        modulo `FOLDS`. Otherwise a row's own parameters would leak into its estimate, the more so the more predictors.
    """
    rows, there = jnp.maximum(jnp.sum(counted), 1), counted[:, None]
    average = lambda v: jnp.sum(v, axis=0, where=there) / rows
    from_mean = theta - average(theta)
    standard = from_mean / jnp.maximum(jnp.sqrt(average(from_mean**2)), jnp.finfo(theta.dtype).eps)
    design = jnp.where(there, jnp.concatenate([standard, jnp.ones_like(theta[:, :1])], axis=1), 0.0)
    given = jnp.where(there, z, 0.0)
    fold = jnp.arange(len(z)) % FOLDS
    # The first model is fitted to all rows, the others to those in all folds but one, shape [1 + FOLDS, D + 1, S].
    kept = jnp.concatenate([jnp.ones((1, len(z))), fold != jnp.arange(FOLDS)[:, None]])
    others = kept[:, :, None] * design
    models = jax.scipy.linalg.solve(others.mT @ design + jnp.eye(design.shape[1]), others.mT @ given, assume_a="pos")
    variance = jnp.maximum(average((given - design @ models[0]) ** 2), LEAST**2)

    def inverted(model: Array) -> tuple[Array, Array]:
        response = shrunk(model[:-1], jnp.sqrt(variance), rows) if z.shape[-1] > LONG else model[:-1]  # [D, S]
        precision = (response / variance) @ response.T + jnp.eye(len(response))
        directions = jax.scipy.linalg.solve(precision, response / variance, assume_a="pos").T
        return directions, model[-1] @ directions

    directions, centres = jax.vmap(inverted)(models)
    by_all = given @ directions[0] - centres[0]
    deviation = jnp.maximum(jnp.sqrt(average(by_all**2)), jnp.finfo(theta.dtype).eps)
    by_fold = jnp.einsum("ns,ksd->nkd", given, directions[1:]) - centres[1:]
    by_others = jnp.take_along_axis(by_fold, fold[:, None, None], axis=1)[:, 0]
    found = InverseRegression(directions[0] / deviation, centres[0] / deviation)
    return found, _with_products(by_others / deviation)


def _with_products(estimates: Array) -> Array:
    return jnp.concatenate([estimates, products(estimates)], axis=-1)
