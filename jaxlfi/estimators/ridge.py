"""Ridge regression whose penalty is chosen by generalised cross-validation."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlfi.distributions.decomposition import svd

PENALTIES = np.logspace(0, 5, 11).astype(np.float32)
"""What is added to the inner products of predictors that have unit variance; 1 weighs as much as one row."""


def ridge(
    x: Float[Array, "cap obs"], y: Float[Array, "cap dim"], valid: Bool[Array, " cap"]
) -> tuple[Float[Array, "dim obs"], Float[Array, " dim"], Float[Array, "cap dim"]]:
    """Coefficients W and intercept b of a linear regression, y = W x + b.

    The penalty, one of `PENALTIES` for each column of y, has the least generalised cross-validation error (Golub, Heath
    and Wahba 1979): with more predictors than rows the coefficients are small, and not those of an interpolation.

    Args:
        x: predictors, shape [C, S].
        y: what is predicted, shape [C, D].
        valid: the rows that count, shape [C].

    Returns:
        W and b, zeros without rows; and what each row would be predicted to be, were the regression fitted without it
        (Allen 1974), shape [C, D], less b.
    """
    rows = jnp.sum(valid)
    x_mean, y_mean = (jnp.sum(v, axis=0, where=valid[:, None]) / jnp.maximum(rows, 1) for v in (x, y))
    x, y = jnp.where(valid[:, None], x - x_mean, 0.0), jnp.where(valid[:, None], y - y_mean, 0.0)
    left, singular, right = svd(x)
    along = left.T @ y  # [R, D]
    kept = singular**2 / (singular**2 + PENALTIES[:, None])  # what a penalty leaves of each direction, [P, R]
    outside = jnp.maximum(jnp.sum(y**2, axis=0) - jnp.sum(along**2, axis=0), 0.0)
    residual = jnp.sum(((1 - kept)[:, :, None] * along) ** 2, axis=1) + outside  # [P, D]
    free = jnp.maximum(rows - 1 - jnp.sum(kept, axis=1), 1e-3)
    best = jnp.argmin(residual / free[:, None] ** 2, axis=0)
    shrunk = jnp.take_along_axis(kept, best[:, None], axis=0)  # [D, R]
    coefficients = (shrunk * along.T / jnp.where(singular > 0, singular, 1.0)) @ right
    # The change is the residual times the leverage over one less the leverage; the mean's own is 1 / rows.
    leverage = jnp.einsum("cr,dr->cd", left**2, shrunk) + 1 / jnp.maximum(rows, 1)
    fitted = x @ coefficients.T
    left_out = fitted - (y - fitted) * leverage / jnp.maximum(1 - leverage, 1e-3)
    return coefficients, y_mean - coefficients @ x_mean, left_out + coefficients @ x_mean
