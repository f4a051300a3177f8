"""Ridge regression whose penalty is chosen by generalised cross-validation."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float

from jaxlfi.distributions.decomposition import svd

PENALTIES = np.logspace(0, 5, 11).astype(np.float32)
"""Ridge penalties, added to the inner products of predictors of unit variance; 1 weighs as much as one row."""
LEAST = 1e-5
"""Smallest variance of a regression's errors, for parameters that vary by about 1."""
LEAST_SIZE = 0.02
"""Fraction of the median error size that is added to each size before its logarithm is taken."""
FOLDS = 5
"""Number of folds, each of which is predicted by a regression fitted to the others."""


def ridge(
    x: Float[Array, "cap obs"], y: Float[Array, "cap dim"], valid: Bool[Array, " cap"]
) -> tuple[Float[Array, "dim obs"], Float[Array, " dim"], Float[Array, "cap dim"]]:
    """Coefficients W and intercept b of a linear regression, y = W x + b.

    The penalty, one of `PENALTIES` for each column of y, minimises the generalised cross-validation error (Golub, Heath
    and Wahba 1979): with more predictors than rows the coefficients are small, and not those of an interpolation.

    Args:
        x: predictors, shape [C, S].
        y: targets, shape [C, D].
        valid: true for the rows that are used, shape [C].

    Returns:
        W and b, zeros without rows; and the prediction of each row by the regression with the same penalty fitted to
        the other folds, less b, shape [C, D]. Row i is in fold i modulo `FOLDS`.
    """
    rows = jnp.sum(valid)
    x_mean, y_mean = (jnp.sum(v, axis=0, where=valid[:, None]) / jnp.maximum(rows, 1) for v in (x, y))
    x, y = jnp.where(valid[:, None], x - x_mean, 0.0), jnp.where(valid[:, None], y - y_mean, 0.0)
    left, singular, right = svd(x)
    along = left.T @ y  # [R, D]
    kept = singular**2 / (singular**2 + PENALTIES[:, None])  # shrinkage of each direction by a penalty, [P, R]
    outside = jnp.maximum(jnp.sum(y**2, axis=0) - jnp.sum(along**2, axis=0), 0.0)
    residual = jnp.sum(((1 - kept)[:, :, None] * along) ** 2, axis=1) + outside  # [P, D]
    free = jnp.maximum(rows - 1 - jnp.sum(kept, axis=1), 1e-3)
    best = jnp.argmin(residual / free[:, None] ** 2, axis=0)
    shrunk = jnp.take_along_axis(kept, best[:, None], axis=0)  # [D, R]
    coefficients = (shrunk * along.T / jnp.where(singular > 0, singular, 1.0)) @ right
    others = _by_others(left * singular, y, valid, jnp.asarray(PENALTIES)[best])
    return coefficients, y_mean - coefficients @ x_mean, others + coefficients @ x_mean


def least_squares(
    x: Float[Array, "cap few"], y: Float[Array, "cap dim"], valid: Bool[Array, " cap"]
) -> tuple[Float[Array, "dim few"], Float[Array, "cap dim"]]:
    """Coefficients W of a regression on few predictors, and the predictions by other folds, as in `ridge`.

    The penalty is the smallest of `PENALTIES`: with few predictors, it hardly matters.
    """
    mean = lambda v: jnp.sum(v, axis=0, where=valid[:, None]) / jnp.maximum(jnp.sum(valid), 1)
    x_mean = mean(x)
    x, y = jnp.where(valid[:, None], x - x_mean, 0.0), jnp.where(valid[:, None], y - mean(y), 0.0)
    coefficients = jax.scipy.linalg.solve(x.T @ x + jnp.eye(x.shape[-1]), x.T @ y, assume_a="pos").T
    return coefficients, _by_others(x, y, valid, jnp.ones(y.shape[-1])) + coefficients @ x_mean


def linear_gaussian(
    x: Float[Array, "cap obs"], y: Float[Array, "cap dim"], valid: Bool[Array, " cap"]
) -> tuple[Float[Array, "dim obs"], Float[Array, " dim"], Float[Array, "dim dim"]]:
    """The Gaussian N(W x + b, C) of y given x, by ridge regression.

    C is the covariance of the errors of the regressions fitted to the other folds (`_factor`).

    Args:
        x: predictors, shape [C, S].
        y: targets, shape [C, D].
        valid: true for the rows that are used, shape [C].

    Returns:
        W, b, and the lower-triangular U of the precision U^T U = C^-1.
    """
    coefficients, intercept, others = ridge(x, y, valid)
    return coefficients, intercept, _factor(y - intercept - others, valid)


def scaled_gaussian(
    x: Float[Array, "cap obs"], y: Float[Array, "cap dim"], valid: Bool[Array, " cap"]
) -> tuple[Array, Array, Array, Array, Float[Array, "dim dim"]]:
    """The same with standard deviations that depend on x: exp(V x + v) times those of C, by a second regression.

    Returns:
        W, b, V, v and U. V x + v is zero on average over the rows.
    """
    coefficients, intercept, others = ridge(x, y, valid)
    wrong = y - intercept - others
    by_x, _, log_scale = ridge(x, log_sizes(wrong, valid), valid)
    average = lambda v: jnp.sum(v, axis=0, where=valid[:, None]) / jnp.maximum(jnp.sum(valid), 1)
    scaled = wrong * jnp.exp(average(log_scale) - log_scale)
    return coefficients, intercept, by_x, -by_x @ average(x), _factor(scaled, valid)


def log_sizes(errors: Float[Array, "cap dim"], valid: Bool[Array, " cap"]) -> Float[Array, "cap dim"]:
    """Logarithms of absolute errors, bounded from below: those far below the median are nearly equal."""
    size = jnp.abs(errors)
    usual = jnp.nanmedian(jnp.where(valid[:, None], size, jnp.nan), axis=0)
    return jnp.where(valid[:, None], jnp.log(size + LEAST_SIZE * jnp.nan_to_num(usual) + LEAST), 0.0)


def _factor(wrong: Float[Array, "cap dim"], valid: Bool[Array, " cap"]) -> Float[Array, "dim dim"]:
    """The lower-triangular U of the precision U^T U of errors.

    Their covariance is estimated with D additional rows of the same variances without correlation, so that it is
    positive definite even with few rows.
    """
    wrong = jnp.where(valid[:, None], wrong, 0.0)
    products, dim, rows = wrong.T @ wrong, wrong.shape[-1], jnp.maximum(jnp.sum(valid), 1)
    variances = jnp.diag(jnp.diagonal(products) / rows + LEAST)
    covariance = (products + dim * variances) / (rows + dim) + LEAST * jnp.eye(dim)
    factor = jnp.linalg.cholesky(covariance)
    return solve_triangular(factor, jnp.eye(dim), lower=True)


def _by_others(
    z: Float[Array, "cap rank"], y: Float[Array, "cap dim"], valid: Bool[Array, " cap"], penalty: Float[Array, " dim"]
) -> Float[Array, "cap dim"]:
    """The prediction of each row by the regression fitted to the other folds.

    Leaving out one row at a time would not do. The mean of all others is linear in the row left out, and so are their
    coefficients: a network that sees such predictions could read its target from them.

    Args:
        z: predictors along their principal axes, zero where not valid, shape [C, R].
        y: centred targets, zero where not valid, shape [C, D].
        valid: true for the rows that are used, shape [C].
        penalty: penalty for each column of y, shape [D].
    """
    dealt = lambda v: jnp.pad(v, [(0, -len(v) % FOLDS), *[(0, 0)] * (v.ndim - 1)]).reshape(-1, FOLDS, *v.shape[1:])
    in_fold = dealt(z), dealt(y), dealt(valid.astype(z.dtype))
    moments = lambda z, y, one: (z.T @ z, z.T @ y, jnp.sum(z, axis=0), jnp.sum(y, axis=0), jnp.sum(one))
    each = jax.vmap(moments, in_axes=1)(*in_fold)
    squares, products, z_sum, y_sum, count = jax.tree.map(lambda fold: jnp.sum(fold, axis=0) - fold, each)
    count = jnp.maximum(count, 1)[:, None]
    z_mean, y_mean = z_sum / count, y_sum / count
    squares = squares - count[:, :, None] * z_mean[:, :, None] * z_mean[:, None, :]
    products = products - count[:, :, None] * z_mean[:, :, None] * y_mean[:, None, :]
    ridged = squares[:, None] + penalty[:, None, None] * jnp.eye(z.shape[-1])  # [K, D, R, R]
    solved = jax.scipy.linalg.solve(ridged, jnp.swapaxes(products, 1, 2)[..., None], assume_a="pos")[..., 0]
    predicted = y_mean + jnp.einsum("ckr,kdr->ckd", in_fold[0] - z_mean, solved)
    return predicted.reshape(-1, y.shape[-1])[: len(y)]
