"""Products of scores along principal axes, which make a linear regression quadratic at little cost."""

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.distributions.decomposition import svd

BEYOND_DIM, MOST = 1, 8
"""Number of axes in excess of the parameters, and the largest number of axes."""
LARGEST_SCORE = 2.5
"""Scores are clipped at this many standard deviations before they are multiplied."""
LEAST_SPREAD = 1e-3
"""Smallest standard deviation along an axis that is used, relative to that of the first."""


class Axes(struct.PyTreeNode):
    """The R leading principal axes of some predictors.

    Simulations that differ in D parameters vary along little more than D axes, and nonlinearly along them as long as
    they are far apart.

    Attributes:
        directions: shape [S, R]; scores along them have unit variance.
        centre: scores of the mean, shape [R].
    """

    directions: Float[Array, "*batch predictor axis"]
    centre: Float[Array, "*batch axis"]

    def beside(self, z: Float[Array, "*n predictor"]) -> Float[Array, "*n both"]:
        """The predictors, and the products of any two scores."""
        return jnp.concatenate([z, products(z @ self.directions - self.centre)], axis=-1)

    @property
    def size(self) -> int:
        """Number of predictors and products."""
        predictors, axes = self.directions.shape[-2:]
        return predictors + axes * (axes + 1) // 2


def products(scores: Float[Array, "*n axis"]) -> Float[Array, "*n product"]:
    """Products of any two clipped scores."""
    bounded = jnp.clip(scores, -LARGEST_SCORE, LARGEST_SCORE)
    one, other = np.triu_indices(scores.shape[-1])
    return bounded[..., one] * bounded[..., other]


def no_axes(predictors: int, count: int) -> Axes:
    """`count` axes whose scores are zero."""
    return Axes(jnp.zeros((predictors, count)), jnp.zeros(count))


def principal_axes(z: Float[Array, "n predictor"], counted: Bool[Array, " n"], count: int) -> Axes:
    """The leading axes of some rows.

    Args:
        z: predictors, shape [N, S].
        counted: true for the rows that are used, shape [N].
        count: number R of axes.
    """
    rows = jnp.maximum(jnp.sum(counted), 1)
    mean = jnp.sum(z, axis=0, where=counted[:, None]) / rows
    _, singular, right = svd(jnp.where(counted[:, None], z - mean, 0.0))
    spread = singular[:count] / jnp.sqrt(rows)
    unit = right[:count].T * jnp.where(spread > LEAST_SPREAD * spread[0], 1 / spread, 0.0)
    directions = jnp.zeros((z.shape[-1], count)).at[:, : len(spread)].set(unit)
    return Axes(directions, mean @ directions)
