"""Regression features: a summary reduced to predictions of the parameters.

The posterior mean is the most informative single number per parameter (Fearnhead and Prangle 2012). Near the
observation, where the later rounds simulate, a linear regression of the parameters on the summaries finds it with far
fewer simulations than a network does: dozens of raw numbers with little information each become one number per
parameter. Farther away a parameter may be nonlinear in the summaries, which products along principal axes follow
(`jaxlfi.estimators.axes`); if they only add noise, it is predicted without them. If some of the numbers are outliers,
it is predicted from numbers clipped to what the others imply (`jaxlfi.estimators.clipping`). If they help, estimates by
a nonlinear model of the numbers, which leaves outliers out, are used as well (`jaxlfi.estimators.robust_estimates`).
Over a whole prior, where a single round simulates, that is not enough, and `KernelRegression` fits any nonlinearity.

A series has a second regression, on its statistics and on the sizes of that model's residuals, for information that is
not in its raw numbers, such as their spread. A summary of more numbers than a round has simulations, such as a picture,
has another one, on the estimates by a linear model of its numbers (`jaxlfi.estimators.inverse_regression`). For an even
longer one, the first regression is on means of neighbours (`jaxlfi.estimators.averages`).

The features of the simulations that a regression is fitted to are predicted without them: otherwise a network would
learn from residuals that are smaller than the observation's, and be overconfident.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.estimators.averages import MOST_MODELLED, as_series, seen, seen_channels, seen_size
from jaxlfi.estimators.axes import BEYOND_DIM, MOST, Axes, no_axes, principal_axes
from jaxlfi.estimators.clipping import FEWEST, Clipping, clipping, no_clipping
from jaxlfi.estimators.inverse_regression import MANY, InverseRegression, inverse_regression, no_estimates
from jaxlfi.estimators.kernel import MOST_ROWS, KernelRidge, kernel_ridge, unfitted_kernel
from jaxlfi.estimators.normaliser import Normaliser, fit_normaliser, identity, standardiser
from jaxlfi.estimators.ridge import least_squares, log_sizes, ridge
from jaxlfi.estimators.robust_estimates import MOST_DIM, RobustEstimates, no_robust_estimates, robust_estimates
from jaxlfi.estimators.statistics import RESIDUAL_SIZES, first_statistics, residual_sizes, statistics, statistics_size

GAIN = 0.95
"""Fraction of a regression's squared error that one with more predictors must stay below to be used."""


class Regression(struct.PyTreeNode):
    """The P features of a summary: D from its numbers, and D more from its statistics if it is a series.

    If it has at least `MANY` numbers, there are D more, from the estimates by them. Axes and clipping of a long one are
    those of the S' means that replace it (`jaxlfi.estimators.averages`).

    Attributes:
        predictors: normaliser of the summary's numbers and its statistics, [S + M].
        axes: axes of the normalised numbers, and of the normalised statistics if there are any.
        clipping: clipping of the same; empty for summaries of fewer than `FEWEST` numbers and in files of earlier
            versions.
        inverse: estimates from the numbers; None for fewer than `MANY`.
        residuals: normaliser of `residual_sizes`, which extend the statistics, [R]: of the robust model, or otherwise
            of the linear one of clipping. None if the summary is no series, and in files of earlier versions.
        robust: estimates from the numbers that are robust to outliers; None for a summary of fewer than `FEWEST`
            numbers, for more than `MOST_DIM` parameters, and in files of earlier versions.
        coefficients: shape [P, 2 (S' + M + R) + Q + D]: of the numbers, the products along their axes, the clipped
            numbers and the robust estimates, then of the statistics and theirs, and of the estimates and their
            products.
        output: normaliser of the features, [P].
        origin: reference of a summary that is given as a difference (`jaxlfi.tasks.reference`), less its mean in each
            channel: statistics are those of the sum. Shape [S].
        channels: numbers C of a record.
    """

    predictors: Normaliser
    axes: tuple[Axes, ...]
    coefficients: Float[Array, "*batch feature predictor"]
    output: Normaliser
    origin: Float[Array, "*batch obs"]
    channels: int = struct.field(pytree_node=False)
    clipping: tuple[Clipping, ...] = ()
    inverse: InverseRegression | None = None
    residuals: Normaliser | None = None
    robust: RobustEstimates | None = None

    def __call__(self, x: Float[Array, "*n obs"]) -> Float[Array, "*n feature"]:
        """Features of raw summaries."""
        predictors, obs = _predictors(x, self.origin, self.channels), x.shape[-1]
        if predictors.shape[-1] > self.predictors.mean.shape[-1]:  # saved by an earlier version
            first = first_statistics(seen_channels(obs, self.channels))
            predictors = predictors[..., np.r_[:obs, obs + first]]
        numbers, *others = jnp.split(self.predictors(predictors), [obs], axis=-1)
        parts, modelled = [seen(numbers, self.channels), *others], seen(numbers, self.channels, MOST_MODELLED)
        if self.residuals is not None:
            left = self.clipping[0].residuals(parts[0]) if self.robust is None else self.robust.residuals(modelled)
            parts[1] = jnp.concatenate([parts[1], self.residuals(self._residual_sizes(left, obs))], axis=-1)
        clips = self.clipping or (None,) * len(self.axes)
        extended = [_extended(*each) for each in zip(parts, self.axes, clips, strict=False)]
        if self.robust is not None:
            extended[0] = jnp.concatenate([extended[0], self.robust(modelled)], axis=-1)
        if self.inverse is not None:
            extended.append(self.inverse(numbers))
        return self.output(jnp.concatenate(extended, axis=-1) @ self.coefficients.T)

    def fitted(
        self,
        theta: Float[Array, "cap dim"],
        x: Float[Array, "cap obs"],
        valid: Bool[Array, " cap"],
        near: Bool[Array, " cap"],
    ) -> tuple["Regression", Float[Array, "cap feature"]]:
        """The regressions over the rows near the observation, and the features of all rows.

        Args:
            theta: parameters as the network sees them, shape [C, D].
            x: raw summaries, shape [C, S].
            valid: true for the rows that are used, shape [C].
            near: true for those that the regressions are fitted to, shape [C].
        """
        predictors, (numbers, *others) = _normalised(self, x, valid, near)
        parts = [seen(numbers, self.channels), *others]
        fit_clipping = lambda z: clipping(z, theta, near) if self.clipping else None
        of_numbers, residuals, robust = fit_clipping(parts[0]), None, None
        if self.robust is not None:
            robust, estimates, left = robust_estimates(seen(numbers, self.channels, MOST_MODELLED), theta, near)
        elif of_numbers is not None:
            left = of_numbers.residuals(parts[0])
        if self.residuals is not None:
            sizes = self._residual_sizes(left, x.shape[-1])
            residuals = fit_normaliser("zscore", sizes, near)
            parts[1] = jnp.concatenate([parts[1], jnp.where(valid[:, None], residuals(sizes), 0.0)], axis=-1)
        clips = [of_numbers, *map(fit_clipping, parts[1:])]
        axes = tuple(principal_axes(part, near, self.axes[0].centre.shape[-1]) for part in parts)
        by_part = [_best(*each, theta, near) for each in zip(parts, axes, clips, strict=True)]
        if robust is not None:
            by_part[0] = _with_estimates(*by_part[0], estimates, theta, near)
        inverse = None
        if self.inverse is not None:
            inverse, of_estimates = _by_estimates(numbers, theta, near)
            by_part.append(of_estimates)
        coefficients, predicted = zip(*by_part, strict=True)
        features = jnp.concatenate(predicted, axis=-1)
        output = standardiser(features, valid)
        matrix = jax.scipy.linalg.block_diag(*coefficients)
        found = self.replace(predictors=predictors, axes=axes, coefficients=matrix, output=output)
        found = found.replace(clipping=tuple(filter(None, clips)), inverse=inverse, residuals=residuals, robust=robust)
        return found, output(features)

    def _residual_sizes(self, left: Array, obs: int) -> Array:
        """Sizes of a model's residuals of a series, over all S of its numbers or over the means that replace them."""
        whole = left.shape[-1] == obs
        channels = seen_channels(obs, self.channels)
        series = as_series(left, self.channels) if whole else left.reshape(*left.shape[:-1], -1, channels)
        return residual_sizes(series)

    def of_earlier_versions(self, obs: int) -> list["Regression"]:
        """The shapes of its leaves in files of earlier versions.

        These have no robust estimates; or no residuals either; or neither these nor clipping; or no axes either, and
        some only the first statistics. With estimates of an inverse regression there are always clipping and axes:
        before these estimates, networks saw fewer features.
        """
        every, axes = self.predictors.mean.shape[-1] - obs, self.axes[0].centre.shape[-1]
        counts = (every, len(first_statistics(seen_channels(obs, self.channels)))) if every else (0,)
        estimates = self.inverse is not None
        dim = self.coefficients.shape[-2] // (1 + bool(every) + estimates)
        left = self.residuals.mean.shape[-1] if self.residuals is not None else 0
        versions = [(every, axes, True, left)] if self.robust is not None else []
        versions += [(every, axes, True, 0)] if left else []
        if not estimates:
            versions += [(every, axes, False, 0), *((count, 0, False, 0) for count in counts)]
        zero = lambda n, r, clips, left: _zero(dim, (obs, n), r, self.channels, clips, estimates and clips, left)
        return [jax.eval_shape(lambda of=of: zero(*of)) for of in versions]


class KernelRegression(struct.PyTreeNode):
    """Features by kernel ridge regressions over all simulations: predictions of the parameters, and of their errors.

    Over a whole prior, errors are far larger at some summaries than at others. The features therefore include, for each
    prediction, the predicted logarithm of its absolute error.

    Attributes:
        predictors: normaliser of the summary's numbers and its statistics, [S + M].
        parts: pairs of regressions, of the parameters and of the errors' logarithms, on the normalised numbers and, if
            there are any, on the normalised statistics.
        output: normaliser of the features, [P].
        origin: as in `Regression`, shape [S].
        channels: numbers C of a record.
    """

    predictors: Normaliser
    parts: tuple[tuple[KernelRidge, KernelRidge], ...]
    output: Normaliser
    origin: Float[Array, "*batch obs"]
    channels: int = struct.field(pytree_node=False)

    def __call__(self, x: Float[Array, "*n obs"]) -> Float[Array, "*n feature"]:
        """Features of raw summaries."""
        z = jnp.split(self.predictors(_predictors(x, self.origin, self.channels)), [x.shape[-1]], axis=-1)
        features = [regression(own) for both, own in zip(self.parts, z, strict=False) for regression in both]
        return self.output(jnp.concatenate(features, axis=-1))

    def fitted(
        self,
        theta: Float[Array, "cap dim"],
        x: Float[Array, "cap obs"],
        valid: Bool[Array, " cap"],
        near: Bool[Array, " cap"],
    ) -> tuple["KernelRegression", Float[Array, "cap feature"]]:
        """The regressions over all valid rows, near the observation or not, and the features of all rows."""
        predictors, z = _normalised(self, x, valid, valid)
        most = self.parts[0][0].rows.shape[-2]
        parts, features = [], []
        for own in z:
            of_theta, predicted = kernel_ridge(own, theta, valid, most)
            of_errors, log_errors = kernel_ridge(own, log_sizes(theta - predicted, valid), valid, most)
            parts.append((of_theta, of_errors))
            features += [predicted, log_errors]
        every = jnp.concatenate(features, axis=-1)
        output = standardiser(every, valid)
        return self.replace(predictors=predictors, parts=tuple(parts), output=output), output(every)

    def of_earlier_versions(self, obs: int) -> list["KernelRegression"]:
        """No earlier version had any."""
        return []


def features_size(dim: int, obs: int, channels: int, kernels: bool = False) -> int:
    """Number P of features for D parameters and S numbers in records of C, from kernel regressions or linear ones."""
    parts = 2 if _statistics_size(obs, channels) else 1
    return dim * (2 * parts if kernels else parts + (obs >= MANY))


def unfitted_kernels(dim: int, obs: int, channels: int, rows: int) -> KernelRegression:
    """Kernel regressions before there are simulations, with room for up to `MOST_ROWS` of `rows` simulations."""
    sizes = [size for size in (obs, _statistics_size(obs, channels)) if size]
    both = lambda size: (unfitted_kernel(min(rows, MOST_ROWS), size, dim),) * 2
    return KernelRegression(
        identity(sum(sizes), "asinh"),
        tuple(both(size) for size in sizes),
        identity(features_size(dim, obs, channels, kernels=True), "zscore"),
        jnp.zeros(obs),
        channels,
    )


def unfitted(dim: int, obs: int, channels: int) -> Regression:
    """The state before there are simulations: all features are zero."""
    sizes = (obs, _statistics_size(obs, channels))
    axes = min(dim + BEYOND_DIM, MOST, obs)
    left = RESIDUAL_SIZES * seen_channels(obs, channels) if sizes[1] else 0
    robust = FEWEST <= obs and dim <= MOST_DIM
    return _zero(dim, sizes, axes, channels, clips=obs >= FEWEST, estimates=obs >= MANY, left=left, robust=robust)


def _zero(
    dim: int,
    sizes: tuple[int, int],
    count: int,
    channels: int,
    clips: bool,
    estimates: bool,
    left: int = 0,
    robust: bool = False,
) -> Regression:
    """Zero features, for given counts of numbers, statistics, residual sizes, and axes of either part."""
    parts = [size for size in (seen_size(sizes[0], channels), sizes[1] + left) if size]
    own = tuple(no_axes(size, count) for size in parts)
    clipped = tuple(no_clipping(dim, size) for size in parts if clips)
    inverse = no_estimates(dim, sizes[0]) if estimates else None
    features = dim * (len(own) + estimates)
    predictors = sum(part.size for part in own) + sum(parts) * clips + (inverse.size if inverse else 0)
    predictors += dim * robust
    return Regression(
        identity(sum(sizes), "asinh"),
        own,
        jnp.zeros((features, predictors)),
        identity(features, "zscore"),
        jnp.zeros(sizes[0]),
        channels,
        clipped,
        inverse,
        identity(left, "zscore") if left else None,
        no_robust_estimates(dim, seen_size(sizes[0], channels, MOST_MODELLED)) if robust else None,
    )


def _normalised(
    regression: Regression | KernelRegression, x: Array, valid: Array, near: Array
) -> tuple[Normaliser, list]:
    """The normaliser of numbers and statistics, fitted to the near rows; and both for all rows, normalised."""
    every = _predictors(x, regression.origin, regression.channels)
    predictors = fit_normaliser("asinh", every, near)
    parts = jnp.split(jnp.where(valid[:, None], predictors(every), 0.0), [x.shape[-1]], axis=-1)
    return predictors, [part for part in parts if part.shape[-1]]


def _extended(z: Array, along: Axes, clip: Clipping | None) -> Array:
    """The predictors, the products along their axes, and the clipped predictors."""
    return along.beside(z) if clip is None else jnp.concatenate([along.beside(z), clip(z)], axis=-1)


def _best(z: Array, along: Axes, clip: Clipping | None, theta: Array, near: Array) -> tuple[Array, Array]:
    """One regression: its coefficients, and its predictions for all rows.

    A parameter is predicted from the predictors alone, from their products as well, or from the clipped ones. Each of
    these is used only if it leaves less than `GAIN` of the squared error of the one before on held-out folds.
    """
    curved, every = along.beside(z), _extended(z, along, clip)
    candidates = [z, curved] + [every[:, curved.shape[-1] :]] * (clip is not None)
    fits = [ridge(v, theta, near) for v in candidates]
    errors = [jnp.sum((theta - own - by_others) ** 2, axis=0, where=near[:, None]) for _, own, by_others in fits]
    best = jnp.argmin(jnp.stack([GAIN**-place * error for place, error in enumerate(errors)]), axis=0)  # [D]
    placed = [
        jnp.zeros((theta.shape[-1], every.shape[-1])).at[:, first : first + found.shape[-1]].set(found)
        for first, (found, _, _) in zip((0, 0, curved.shape[-1]), fits, strict=False)
    ]
    coefficients = jnp.choose(best[:, None], placed, mode="clip")
    by_others = jnp.choose(best, [predicted for _, _, predicted in fits], mode="clip")
    return coefficients, jnp.where(near[:, None], by_others, every @ coefficients.T)


def _with_estimates(
    coefficients: Array, predicted: Array, estimates: Array, theta: Array, near: Array
) -> tuple[Array, Array]:
    """A regression on another's predictions and on estimates, if it leaves less than `GAIN` of its squared error."""
    predictors = jnp.concatenate([predicted, estimates], axis=-1)
    own, by_others = least_squares(predictors, theta, near)
    by_both = jnp.where(near[:, None], by_others, predictors @ own.T)
    better = _unexplained(theta - by_both, near) < GAIN * _unexplained(theta - predicted, near)  # [D]
    dim = theta.shape[-1]
    both = jnp.concatenate([own[:, :dim] @ coefficients, own[:, dim:]], axis=-1)
    alone = jnp.concatenate([coefficients, jnp.zeros_like(own[:, dim:])], axis=-1)
    return jnp.where(better[:, None], both, alone), jnp.where(better, by_both, predicted)


def _unexplained(errors: Array, near: Array) -> Array:
    """Sum of squared errors of the near rows, about their mean."""
    there = near[:, None]
    mean = jnp.sum(errors, axis=0, where=there) / jnp.maximum(jnp.sum(near), 1)
    return jnp.sum((errors - mean) ** 2, axis=0, where=there)


def _by_estimates(z: Array, theta: Array, near: Array) -> tuple[InverseRegression, tuple[Array, Array]]:
    """The regression on estimates: these, its coefficients, and its predictions for all rows."""
    inverse, estimates = inverse_regression(z, theta, near)
    coefficients, _, by_others = ridge(estimates, theta, near)
    return inverse, (coefficients, jnp.where(near[:, None], by_others, inverse(z) @ coefficients.T))


def _predictors(x: Array, origin: Array, channels: int) -> Array:
    """A summary's numbers, and its statistics if it is a series."""
    if not _statistics_size(x.shape[-1], channels):
        return x
    return jnp.concatenate([x, statistics(as_series(x + origin, channels))], axis=-1)


def _statistics_size(obs: int, channels: int) -> int:
    """Number of statistics of a summary; 0 if it is no series."""
    return statistics_size(obs // channels, seen_channels(obs, channels))
