"""Local model: a run's own simulations, linearised about the parameters of its box that explain the observation best.

Within the box, and a little beyond it, summaries are assumed to be Gaussian about a mean that is linear in the
parameters. How well the observation is explained with a bound in place, and without it, is then a small least-squares
problem that needs no further simulation.
"""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from jaxlfi.distributions.support import Support

PASSES = 4
"""Number of fits, each about the parameters that the last one found."""
STEP = 0.7
"""Longest step of one pass in each parameter, in half widths of the box."""
NEIGHBOURS = 0.3
"""Fraction of the simulations within one scale of the kernel that weights them."""
DIRECTIONS = 60
"""Largest number of summaries, or of their principal components, that the model describes."""
NEWEST = 20_000
"""Largest number of simulations that the model is fitted to: the last ones."""
EXPLODED = 30.0
"""Distance from the median, relative to the observation's or most simulations', beyond which one is left out."""
FLOOR = 1e-5
"""Smallest standard deviation of a summary's noise, as a fraction of its spread: float32 does not resolve less."""


@dataclasses.dataclass(frozen=True)
class LocalModel:
    """The observation's residual in standard deviations of the noise, and how it changes with the parameters.

    Attributes:
        centre: parameters the model is linearised about, the box scaled to [-1, 1], shape [D].
        residual: of the observation there, whitened, shape [S].
        slopes: change of the whitened summaries with each scaled parameter, shape [S, D].
    """

    centre: Float[np.ndarray, " dim"]
    residual: Float[np.ndarray, " obs"]
    slopes: Float[np.ndarray, "obs dim"]

    def nearest(self, low: Float[np.ndarray, " dim"], high: Float[np.ndarray, " dim"]) -> Float[np.ndarray, " dim"]:
        """The parameters in a box of scaled parameters that explain the observation best, shape [D]."""
        return self.centre + bounded_least_squares(self.slopes, self.residual, low - self.centre, high - self.centre)

    def misfit(self, low: Float[np.ndarray, " dim"], high: Float[np.ndarray, " dim"]) -> float:
        """Squared distance of the observation from the nearest mean in a box, in standard deviations of the noise.

        If the model holds and the box is right, it has a chi-squared distribution of at most S degrees of freedom.
        """
        return float(np.sum((self.residual - self.slopes @ (self.nearest(low, high) - self.centre)) ** 2))


def local_model(
    theta: Float[Array | np.ndarray, "n dim"],
    x: Float[Array | np.ndarray, "n obs"],
    observed: Float[Array | np.ndarray, " obs"],
    box: Support,
) -> LocalModel | None:
    """The local model of a run; None if there are too few simulations.

    Args:
        theta: parameters of the simulations in inference space, shape [N, D].
        x: their summaries, shape [N, S].
        observed: the observed summaries, shape [S].
        box: the support they were drawn from.
    """
    low, high = (np.asarray(bound, float) for bound in (box.low, box.high))
    unit = (2 * np.asarray(theta, float)[-NEWEST:] - low - high) / (high - low)
    x, observed = np.asarray(x, float)[-NEWEST:], np.asarray(observed, float)
    dim = unit.shape[1]
    if len(unit) < 3 * (1 + dim):
        return None
    comparable = _comparable(x, observed)
    unit, x = unit[comparable], x[comparable]
    n = len(unit)
    columns = 1 + dim + dim * (dim + 1) // 2
    quadratic = n >= 3 * columns
    columns = columns if quadratic else 1 + dim
    if n < 3 * columns:
        return None
    x, observed = _standardised(x, observed)
    if not x.shape[1]:
        return None
    centre = np.zeros(dim)
    for i in range(PASSES):
        distance = np.sum((unit - centre) ** 2, axis=1)
        within = int(min(max(5 * columns, NEIGHBOURS * n), n - 1))
        weight = np.exp(-0.5 * distance / max(np.partition(distance, within)[within], FLOOR**2))
        model = _fitted(unit - centre, x, observed, weight, quadratic, centre)
        if i < PASSES - 1:
            step = model.nearest(-np.ones(dim), np.ones(dim)) - centre
            centre = np.clip(centre + np.clip(step, -STEP, STEP), -1, 1)
    return model


def _comparable(x: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """Which simulations did not explode: none of their summaries is much farther out than the observation's."""
    middle = np.median(x, axis=0)
    away = np.abs(x - middle)
    usual = np.maximum(np.quantile(away, 0.75, axis=0), np.abs(observed - middle))
    return np.all(away <= EXPLODED * np.where(usual > 0, usual, np.inf), axis=1)


def _standardised(x: Any, observed: Any) -> tuple[np.ndarray, np.ndarray]:
    """Summaries scaled by their spread, without those that never vary; principal components if there are very many."""
    varies = np.ptp(x, axis=0) > 0
    x, observed = x[:, varies], observed[varies]
    middle = np.mean(x, axis=0)
    spread = np.std(x - middle, axis=0)
    x, observed = (x - middle) / spread, (observed - middle) / spread
    if x.shape[1] <= DIRECTIONS:
        return x, observed
    _, vectors = np.linalg.eigh(x.T @ x)
    return x @ vectors[:, -DIRECTIONS:], observed @ vectors[:, -DIRECTIONS:]


def _fitted(offset: np.ndarray, x: np.ndarray, observed: np.ndarray, weight: np.ndarray, quadratic: bool, centre):
    """Weighted least squares: means of the summaries near a centre, and the covariance of what is left."""
    dim, size = offset.shape[1], x.shape[1]
    products = [offset[:, [i]] * offset[:, i:] for i in range(dim)] if quadratic else []
    features = np.concatenate([np.ones((len(offset), 1)), offset, *products], axis=1)
    columns, total = features.shape[1], np.sum(weight)
    weighted = features * weight[:, None]
    ridge = np.diag(np.r_[0.0, np.full(columns - 1, 1e-6 * total)])  # a parameter that hardly varies has no slope
    coefficients = np.linalg.solve(weighted.T @ features + ridge, weighted.T @ x)
    left = x - features @ coefficients
    effective = total**2 / np.sum(weight**2)
    covariance = (left * weight[:, None]).T @ left / total * effective / max(effective - columns, 1.0)
    variances = np.diag(covariance)
    shrunk = min(1.0, (size + 1) / effective)  # few simulations cannot tell many covariances
    covariance = (1 - shrunk) * covariance + np.diag(shrunk * variances + 1e-6 * variances + FLOOR**2)
    root = np.linalg.cholesky(covariance)
    residual = np.linalg.solve(root, observed - coefficients[0])
    return LocalModel(centre, residual, np.linalg.solve(root, coefficients[1 : dim + 1].T))


def bounded_least_squares(
    slopes: Float[np.ndarray, "obs dim"],
    residual: Float[np.ndarray, " obs"],
    low: Float[np.ndarray, " dim"],
    high: Float[np.ndarray, " dim"],
) -> Float[np.ndarray, " dim"]:
    """The step s within bounds that minimises ||r - A s||^2, by the active-set method of Stark and Parker."""
    from scipy.optimize import lsq_linear  # slow to import, and only local models need it

    return lsq_linear(slopes, residual, (low, high), method="bvls").x
