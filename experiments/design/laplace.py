"""Exact posteriors of slow simulators: importance sampling about the point that fits best.

That is the least-squares fit from the middle of the posterior that is known already, or where none is, the best of
those from the best of some draws of the box. Draws of the normal that the derivatives there give, made half as wide
again, are weighed by the likelihood. Where too few count, tempered steps lead on from these. The normal's draws fill
it evenly (a scrambled Sobol sequence), and so do those of the posterior (systematic resampling): independent draws, as
few as these, left the ends of 90 % intervals a fifth of a standard deviation uncertain.
"""

import numpy as np
import scipy.optimize
from scipy.stats import norm, qmc

from experiments.design import importance
from experiments.design.likelihood import log_likelihood, residuals
from experiments.design.resampling import systematic, weights
from jaxlfi.tasks.task import Task

POINTS, FIRST, STARTS = 256, 512, 4
"""About the best fit, from the box, and how many of these are fitted from."""
DRAWS = 1024
"""Of a posterior."""
STEP = 0.2
"""Of differences, in standard deviations."""
WIDTH = 0.02
"""And in widths of the box, where no deviation is known."""
FAILED = 1e3
"""Residuals of simulations that fail."""
ROUNDS = 2
"""Fits, each with the differences that the one before says."""


def posterior(
    rng: np.random.Generator,
    task: Task,
    recorded: np.ndarray,
    designs: np.ndarray,
    before: np.ndarray | None = None,
) -> np.ndarray:
    """Draws in inference space, shape [N, D]; see `importance.posterior`."""
    box, of = task.support(None), log_likelihood(task)
    low, high = np.asarray(box.low, float), np.asarray(box.high, float)
    if before is None:
        drawn = rng.uniform(low, high, (FIRST, len(low)))
        starts = drawn[np.argsort(-of(recorded, designs, drawn).sum(axis=1))[:STARTS]]
        deviation = WIDTH * (high - low)
    else:
        starts, deviation = before.mean(axis=0)[None], before.std(axis=0)
    fits = [fitted(task, recorded, designs, np.clip(one, low + 1e-9, high - 1e-9), deviation) for one in starts]
    _, mean, covariance = min(fits, key=lambda fit: fit[0])
    for _ in range(ROUNDS - 1):
        deviation = np.minimum(np.sqrt(np.diagonal(covariance)), deviation)
        _, mean, covariance = fitted(task, recorded, designs, mean, deviation)
    factor = importance.WIDER * np.linalg.cholesky(covariance)
    normal = norm.ppf(qmc.Sobol(len(mean), rng=rng).random(16 * POINTS))
    tried = mean + normal @ factor.T
    inside = np.flatnonzero(((tried > low) & (tried < high)).all(axis=1))[:POINTS]
    theta = tried[inside]
    log = of(recorded, designs, theta).sum(axis=1) + 0.5 * np.sum(normal[inside] ** 2, axis=1)
    weight = weights(log)
    if 1 / np.sum(weight**2) >= 0.2 * POINTS:
        return theta[systematic(rng, weight, DRAWS)]
    return importance.posterior(rng, task, recorded, designs, theta, points=POINTS)


def fitted(
    task: Task, recorded: np.ndarray, designs: np.ndarray, start: np.ndarray, deviation: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """The misfit of the least-squares fit in the box, where it is, and the covariance that its derivatives give.

    Args:
        task: with a response outside JAX.
        recorded: shape [E, T, C].
        designs: shape [E, K].
        start: where to begin.
        deviation: of the parameters, which sets the steps of differences, shape [D].
    """
    box = task.support(None)
    low, high = np.asarray(box.low, float), np.asarray(box.high, float)
    steps = STEP * deviation

    def off(theta: np.ndarray) -> np.ndarray:
        return np.nan_to_num(residuals(task, recorded, designs, theta), nan=FAILED).reshape(len(theta), -1)

    def slope(theta: np.ndarray) -> np.ndarray:
        ahead, behind = np.split(off(np.concatenate([theta + np.diag(steps), theta - np.diag(steps)])), 2)
        return ((ahead - behind) / (2 * steps[:, None])).T

    found = scipy.optimize.least_squares(
        lambda theta: off(theta[None])[0],
        start,
        slope,
        (low, high),
        x_scale=deviation,
        xtol=1e-6,
        ftol=1e-6,
        max_nfev=20,
    )
    precision = found.jac.T @ found.jac + np.diag(1e-2 / (high - low) ** 2)
    return float(found.cost), found.x, np.linalg.inv(precision)
