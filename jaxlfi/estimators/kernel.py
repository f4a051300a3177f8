"""Kernel ridge regression of the parameters on summaries, for simulations that are spread over a whole prior."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.estimators.ridge import FOLDS

LENGTHS = np.array([0.1, 0.3, 1.0, 3.0], np.float32)
"""Squared lengths of the Gaussian kernel, relative to the mean squared distance between two rows."""
PENALTIES = np.logspace(-3, 1, 9).astype(np.float32)
"""Noise variances relative to the kernel's; with thousands of rows, less would exceed the precision of float32."""
MOST_ROWS = 2000
"""Largest number of rows that a regression is fitted to: its time grows with their cube."""
CHOICE_ROWS = 250
"""Number of rows from which kernel length and penalty are chosen."""
TOGETHER = 1000
"""Number of rows predicted at once, so that a hundred thousand fit in memory."""


class KernelRidge(struct.PyTreeNode):
    """Predictions mu_d + sum_n w_nd k_d(z, z_n) of D parameters.

    The kernel is the sum of a Gaussian, a constant and a linear one, so that where rows are few or far, predictions are
    those of a linear regression.

    Attributes:
        rows: predictors z_n of the rows that it was fitted to, shape [N, S].
        weights: w, zero for rows that are not used, shape [N, D].
        squared_length: squared length of each parameter's Gaussian kernel, shape [D].
        mean: mean of the parameters, shape [D].
    """

    rows: Float[Array, "*batch row predictor"]
    weights: Float[Array, "*batch row dim"]
    squared_length: Float[Array, "*batch dim"]
    mean: Float[Array, "*batch dim"]

    def __call__(self, z: Float[Array, "*n predictor"]) -> Float[Array, "*n dim"]:
        """The predicted parameters."""
        near = lambda z: lambda squared_length, weights: kernel(z[None], self.rows, squared_length)[0] @ weights
        one = lambda z: jax.vmap(near(z))(self.squared_length, self.weights.T)
        found = jax.lax.map(one, z.reshape(-1, z.shape[-1]), batch_size=TOGETHER)
        return self.mean + found.reshape(*z.shape[:-1], -1)


def unfitted_kernel(rows: int, predictors: int, dim: int) -> KernelRidge:
    """The state before there are simulations: all predictions are zero."""
    return KernelRidge(jnp.zeros((rows, predictors)), jnp.zeros((rows, dim)), jnp.ones(dim), jnp.zeros(dim))


def kernel(a: Float[Array, "n predictor"], b: Float[Array, "m predictor"], squared_length: Array) -> Array:
    """exp(-|a - b|^2 / 2 l^2) + 1 + a'b / S, shape [N, M]."""
    products = a @ b.T
    distances = jnp.sum(a**2, axis=1)[:, None] + jnp.sum(b**2, axis=1) - 2 * products
    return jnp.exp(-0.5 * jnp.maximum(distances, 0.0) / squared_length) + 1 + products / a.shape[-1]


def kernel_ridge(
    z: Float[Array, "cap predictor"], y: Float[Array, "cap dim"], valid: Bool[Array, " cap"], most: int = MOST_ROWS
) -> tuple[KernelRidge, Float[Array, "cap dim"]]:
    """The regression of y on z.

    For each column of y, the length of the kernel and the penalty minimise the leave-one-out error of the first
    `CHOICE_ROWS` rows.

    Args:
        z: predictors of about unit variance, shape [C, S].
        y: targets, shape [C, D].
        valid: true for the rows that are used, the first ones, shape [C].
        most: largest number of rows that the regression is fitted to, the last ones that are valid.

    Returns:
        The regression; and the prediction of each row, shape [C, D]. A row that it was fitted to is predicted by the
        regression of the other folds: the n-th of them is in fold n modulo `FOLDS`.
    """
    size = min(most, len(z))
    start = jnp.maximum(jnp.sum(valid) - size, 0)
    rows, own, fitted = (jax.lax.dynamic_slice_in_dim(v, start, size) for v in (z, y, valid))
    average = lambda v: jnp.sum(v, axis=0, where=fitted[:, None]) / jnp.maximum(jnp.sum(fitted), 1)
    mean, spread = average(own), 2 * jnp.sum(average((rows - average(rows)) ** 2))
    centred = jnp.where(fitted[:, None], own - mean, 0.0)
    length, penalty = _chosen(rows[:CHOICE_ROWS], centred[:CHOICE_ROWS], fitted[:CHOICE_ROWS], spread)

    def one(column):
        own, squared_length, penalty = column
        inverse = _inverse(rows, fitted, squared_length, penalty)
        weights = inverse @ own
        return weights, own - _left_out(inverse, weights)

    weights, by_others = jax.lax.map(one, (centred.T, length, penalty))
    found = KernelRidge(rows, weights.T, length, mean)
    predicted = found(z)
    of_fitted = jnp.where(fitted[:, None], mean + by_others.T, jax.lax.dynamic_slice_in_dim(predicted, start, size))
    return found, jax.lax.dynamic_update_slice_in_dim(predicted, of_fitted, start, axis=0)


def _inverse(rows: Array, fitted: Array, squared_length: Array, penalty: Array) -> Array:
    """(K + penalty I)^-1, in which rows that are not used are independent of all others."""
    both = fitted[:, None] & fitted
    matrix = jnp.where(both, kernel(rows, rows, squared_length), 0.0) + penalty * jnp.eye(len(rows))
    factor = jax.scipy.linalg.cho_factor(matrix, lower=True)
    return jax.scipy.linalg.cho_solve(factor, jnp.eye(len(rows)))


def _left_out(inverse: Float[Array, "n n"], weights: Float[Array, " n"]) -> Float[Array, " n"]:
    """Residuals of each fold by the regression fitted to the others: (A^-1)_BB^-1 (A^-1 y)_B for a fold B."""
    size = len(weights)
    more = -size % FOLDS
    padded = jnp.pad(inverse, ((0, more), (0, more))) + jnp.diag(jnp.arange(size + more) >= size)
    dealt = padded.reshape(-1, FOLDS, (size + more) // FOLDS, FOLDS)
    blocks = jnp.stack([dealt[:, fold, :, fold] for fold in range(FOLDS)])
    own = jnp.pad(weights, (0, more)).reshape(-1, FOLDS).T
    residuals = jnp.linalg.solve(blocks, own[..., None])[..., 0]
    return residuals.T.reshape(-1)[:size]


def _chosen(rows: Array, y: Array, fitted: Array, spread: Array) -> tuple[Array, Array]:
    """Squared length and penalty for each column of y, by leave-one-out error."""
    lengths = np.repeat(LENGTHS, len(PENALTIES)) * jnp.maximum(spread, 1e-6)
    penalties = jnp.asarray(np.tile(PENALTIES, len(LENGTHS)))

    def error(pair):
        inverse = _inverse(rows, fitted, *pair)
        left_out = inverse @ y / jnp.diagonal(inverse)[:, None]
        return jnp.sum(left_out**2, axis=0, where=fitted[:, None])

    best = jnp.argmin(jax.lax.map(error, (lengths, penalties)), axis=0)
    return lengths[best], penalties[best]
