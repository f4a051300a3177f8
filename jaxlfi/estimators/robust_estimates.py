"""Estimates of the parameters that are robust to outliers, by a quadratic model of the predictors.

A regression of a parameter on the predictors has to average errors out, and an outlier moves it in proportion to its
size, or, if it is clipped, by the limit. A model of the predictors goes the other way: it predicts each of them from
the parameters, and thus which of them are outliers. Estimates with Tukey's weights leave outliers out altogether
(Beaton and Tukey 1974). As they might also leave out informative predictors, they start from Huber's estimates, which
do not depend on their starting point (Huber 1964).
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.estimators.averages import LONG, shrunk
from jaxlfi.estimators.clipping import LARGEST, LEAST, TO_DEVIATION, preconditioner
from jaxlfi.estimators.ridge import FOLDS

MOST_DIM = 8
"""Largest number of parameters: a round's simulations would hardly determine a quadratic model in more of them."""
FARTHEST = 4.0
"""Robust standard deviations beyond which a predictor has no weight (Tukey's biweight; 4.7 is as common)."""
STEPS = 10
"""Number of steps of each iteration, with Huber's weights and then with Tukey's."""
LONGEST = 1.0
"""Largest step of an estimate, in standard deviations of the parameters."""
REACH = 4.0
"""Largest distance of an estimate from the parameters' mean, in standard deviations: a quadratic model ends there."""


class RobustEstimates(struct.PyTreeNode):
    """A quadratic model of the predictors, and the scale of their errors.

    Attributes:
        model: coefficients of the standardised parameters, of their products and of 1, shape [P, S].
        scale: robust standard deviation of each predictor's errors, shape [S].
    """

    model: Float[Array, "*batch term predictor"]
    scale: Float[Array, "*batch predictor"]

    def __call__(self, z: Float[Array, "*n predictor"]) -> Float[Array, "*n dim"]:
        """The estimates, in standard deviations of the parameters, under a standard normal prior."""
        return jnp.vectorize(lambda row: _estimate(self.model, self.scale, row), signature="(s)->(d)")(z)

    def residuals(self, z: Float[Array, "*n predictor"]) -> Float[Array, "*n predictor"]:
        """Differences of the predictors from the model's at the estimates, in robust standard deviations."""
        return (z - _design(self(z)) @ self.model) / self.scale


def no_robust_estimates(dim: int, predictors: int) -> RobustEstimates:
    """The state before there are simulations: all estimates are zero."""
    return RobustEstimates(jnp.zeros((_terms(dim), predictors)), jnp.ones(predictors))


def robust_estimates(
    z: Float[Array, "n predictor"], theta: Float[Array, "n dim"], counted: Bool[Array, " n"]
) -> tuple[RobustEstimates, Float[Array, "n dim"], Float[Array, "n predictor"]]:
    """Fit the model to some rows, with Huber's weights and then Tukey's.

    Args:
        z: predictors, shape [N, S].
        theta: parameters, shape [N, D].
        counted: true for the rows that are used, shape [N].

    Returns:
        The model; and the estimates and residuals of each row by the model of the other folds. Row i is in fold i
        modulo `FOLDS`.
    """
    rows, there = jnp.maximum(jnp.sum(counted), 1), counted[:, None]
    from_mean = theta - jnp.sum(theta, axis=0, where=there) / rows
    deviation = jnp.sqrt(jnp.sum(from_mean**2, axis=0, where=there) / rows)
    design = _design(from_mean / jnp.maximum(deviation, jnp.finfo(theta.dtype).eps))
    fold = jnp.arange(len(z)) % FOLDS
    # The first model is fitted to all rows, the others to those in all folds but one: [1 + FOLDS, N, P].
    kept = counted & jnp.concatenate([jnp.ones((1, len(z)), bool), fold != jnp.arange(FOLDS)[:, None]])
    each = jnp.where(kept[:, :, None], design, 0.0)
    to_model = jax.scipy.linalg.solve(each.mT @ each + jnp.eye(design.shape[1]), each.mT, assume_a="pos")
    away = lambda models: jnp.where(there, z - design @ models, 0.0)

    def scale(models: Array) -> Array:
        usual = jnp.nanmedian(jnp.where(there, jnp.abs(away(models[0])), jnp.nan), axis=0)
        return jnp.maximum(TO_DEVIATION * jnp.nan_to_num(usual), LEAST)

    def refined(half: int, models: Array) -> Array:
        usual = scale(models)
        step = lambda _, found: found + to_model @ (_weight(half, away(found) / usual) * away(found))
        return jax.lax.fori_loop(0, STEPS, step, models)

    models = jax.lax.fori_loop(0, 2, refined, to_model @ jnp.where(there, z, 0.0))
    usual = scale(models)
    if z.shape[-1] > LONG:
        constant, linear, products = jnp.split(models, [1, 1 + theta.shape[-1]], axis=-2)
        models = jnp.concatenate([constant, *(shrunk(one, usual, rows) for one in (linear, products))], axis=-2)
    dealt = jnp.pad(z, [(0, -len(z) % FOLDS), (0, 0)]).reshape(-1, FOLDS, z.shape[-1])

    def of_fold(model: Array, own: Array) -> tuple[Array, Array]:
        found = RobustEstimates(model, usual)
        return found(own), found.residuals(own)

    estimates, residuals = jax.vmap(of_fold, in_axes=(0, 1), out_axes=1)(models[1:], dealt)
    in_order = lambda v: v.reshape(-1, v.shape[-1])[: len(z)]
    return RobustEstimates(models[0], usual), in_order(estimates), in_order(residuals)


@jax.jit
def _estimate(model: Array, scale: Array, z: Array) -> Array:
    """The estimate for one row, by the Gauss-Newton method; a row noisier than most has its own noise scale."""
    dim = next(dim for dim in range(MOST_DIM + 1) if _terms(dim) == len(model))
    free = math.sqrt(len(z) / max(len(z) - dim, 1))  # residuals are smaller than errors
    away = lambda theta: (z - _design(theta) @ model) / scale

    def refined(half: int, theta: Array) -> Array:
        noise = jnp.maximum(free * TO_DEVIATION * jnp.median(jnp.abs(away(theta))), 1.0)
        usual = jnp.where(half == 0, 1.0, noise)

        def nearer(_: int, theta: Array) -> Array:
            left, response = jax.linearize(away, theta)
            response = jax.vmap(response)(jnp.eye(dim))  # [D, S]
            counted = _weight(half, left / usual) * response / usual**2
            move = preconditioner(counted @ response.T + jnp.eye(dim)) @ (-counted @ left - theta)
            shorter = jnp.minimum(1.0, LONGEST / jnp.maximum(jnp.linalg.norm(move), LEAST))
            return jnp.clip(theta + shorter * move, -REACH, REACH)

        return jax.lax.fori_loop(0, STEPS, nearer, theta)

    return jax.lax.fori_loop(0, 2, refined, jnp.zeros(dim, z.dtype))


def _design(theta: Float[Array, "*n dim"]) -> Float[Array, "*n term"]:
    """The terms of a quadratic model: 1, the parameters, and the products of any two."""
    one, other = np.triu_indices(theta.shape[-1])
    return jnp.concatenate([jnp.ones_like(theta[..., :1]), theta, theta[..., one] * theta[..., other]], axis=-1)


def _terms(dim: int) -> int:
    return 1 + dim + dim * (dim + 1) // 2


def _weight(half: int, away: Array) -> Array:
    """The weight of an error: Huber's in the first half of the steps, then Tukey's."""
    huber = LARGEST / jnp.maximum(jnp.abs(away), LARGEST)
    tukey = jnp.maximum(1.0 - (away / FARTHEST) ** 2, 0.0) ** 2
    return jnp.where(half == 0, huber, tukey)
