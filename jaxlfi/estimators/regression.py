"""Regression features: a summary reduced to what linear regressions predict the parameters to be.

The posterior mean is the one number a parameter that tells most of it (Fearnhead and Prangle 2012). Near the
observation, where the later rounds simulate, a linear regression of the parameters on the summaries finds it with far
fewer simulations than a network does: dozens of raw numbers with little in each become one number a parameter. A series
has a second regression, on its statistics, for what its raw numbers do not tell linearly, such as their spread.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.estimators.normaliser import Normaliser, fit_normaliser, identity, standardiser
from jaxlfi.estimators.ridge import ridge
from jaxlfi.estimators.statistics import first_statistics, statistics, statistics_size


class Regression(struct.PyTreeNode):
    """The features of a summary: P = D of its numbers, and D more of its statistics where it is a series.

    Attributes:
        predictors: normaliser of the summary's numbers and its statistics, [S + M].
        coefficients: shape [P, S + M].
        output: normaliser of the features, [P].
        origin: what a summary is counted from that comes as a difference (`jaxlfi.tasks.reference`), less its mean in
            each channel: its statistics are those of the sum. Shape [S].
        channels: numbers C of a record.
    """

    predictors: Normaliser
    coefficients: Float[Array, "*batch feature predictor"]
    output: Normaliser
    origin: Float[Array, "*batch obs"]
    channels: int = struct.field(pytree_node=False)

    def __call__(self, x: Float[Array, "*n obs"]) -> Float[Array, "*n feature"]:
        """Features of raw summaries."""
        predictors, obs = _predictors(x, self.origin, self.channels), x.shape[-1]
        if predictors.shape[-1] > self.coefficients.shape[-1]:  # saved by an earlier version
            predictors = predictors[..., np.r_[:obs, obs + first_statistics(self.channels)]]
        return self.output(self.predictors(predictors) @ self.coefficients.T)

    def of_first_statistics(self, obs: int) -> "Regression":
        """The shapes of its leaves in files of earlier versions, which had fewer statistics."""
        count = obs + len(first_statistics(self.channels))
        sized = lambda leaf: jax.ShapeDtypeStruct((*leaf.shape[:-1], count), leaf.dtype)
        predictors, coefficients = jax.tree.map(sized, (self.predictors, self.coefficients))
        return self.replace(predictors=predictors, coefficients=coefficients)


def features_size(dim: int, obs: int, channels: int) -> int:
    """Number P of features for D parameters and S numbers in records of C."""
    return dim * (2 if statistics_size(obs // channels, channels) else 1)


def unfitted(dim: int, obs: int, channels: int) -> Regression:
    """Before there are simulations: all features are zero."""
    predictors, features = obs + statistics_size(obs // channels, channels), features_size(dim, obs, channels)
    return Regression(
        identity(predictors, "asinh"),
        jnp.zeros((features, predictors)),
        identity(features, "zscore"),
        jnp.zeros(obs),
        channels,
    )


def fit_regression(
    before: Regression,
    theta: Float[Array, "cap dim"],
    x: Float[Array, "cap obs"],
    valid: Bool[Array, " cap"],
    near: Bool[Array, " cap"],
) -> tuple[Regression, Float[Array, "cap feature"]]:
    """The regressions over the rows that are near the observation, and the features of all rows.

    A row that the regressions were fitted to has the features that they would have without it: else the network would
    learn from residuals that are smaller than those of the observation, and be too sure.

    Args:
        before: for what it is counted from and its channels.
        theta: parameters as the network sees them, shape [C, D].
        x: raw summaries, shape [C, S].
        valid: the rows that count, shape [C].
        near: those of them that the regressions are fitted to, shape [C].
    """
    every = _predictors(x, before.origin, before.channels)
    predictors = fit_normaliser("asinh", every, near)
    z = jnp.where(valid[:, None], predictors(every), 0.0)
    obs = x.shape[-1]
    parts = [slice(0, obs), slice(obs, None)] if every.shape[-1] > obs else [slice(None)]
    coefficients, by_part = [], []
    for part in parts:
        found, _, left_out = ridge(z[:, part], theta, near)
        coefficients.append(jnp.zeros((theta.shape[-1], z.shape[-1])).at[:, part].set(found))
        by_part.append(jnp.where(near[:, None], left_out, z[:, part] @ found.T))
    features = jnp.concatenate(by_part, axis=-1)
    output = standardiser(features, valid)
    return before.replace(predictors=predictors, coefficients=jnp.concatenate(coefficients), output=output), output(
        features
    )


def _predictors(x: Array, origin: Array, channels: int) -> Array:
    """A summary's numbers, and its statistics where it is a series."""
    obs = x.shape[-1]
    if not statistics_size(obs // channels, channels):
        return x
    series = (x + origin).reshape(*x.shape[:-1], -1, channels)
    return jnp.concatenate([x, statistics(series)], axis=-1)
