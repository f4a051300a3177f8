"""Exact posteriors of slow simulators: importance sampling about the point that fits best.

That is the least-squares fit from the middle of the posterior that is known already, or where none is, the best of
those from the best of some draws of the box. Fits are local: while the best one leaves residuals that the noise does
not explain, others are fitted from further draws of the box, and from the best of draws at some distance from it. Draws
of the normal that the derivatives there give, made half as wide again, are weighed by the likelihood. Where too few
count, tempered steps lead on from these. The normal's draws fill it evenly (a scrambled Sobol sequence), and so do
those of the posterior (systematic resampling): independent draws, as few as these, left the ends of 90 % intervals a
fifth of a standard deviation uncertain.
"""

import numpy as np
import scipy.optimize
from scipy.stats import norm, qmc

from experiments.design import importance
from experiments.design.likelihood import log_likelihood, residuals
from experiments.design.resampling import systematic, weights
from jaxlfi.tasks.task import Task

POINTS, FIRST, STARTS = 256, 512, 4
"""About the best fit, from the box, and how many of these are fitted from at least."""
MOST = 16
"""Draws of the box that are fitted from at most."""
LEAPS, LEAP = 12, 64
"""Fits from the best of so many draws about a fit that the noise does not explain."""
DISTANCES = (3.0, 10.0, 30.0)
"""How many times as wide as that fit's covariance these draws are, one after another."""
EXPLAINED = 5.0
"""Standard deviations by which the sum of squared residuals may exceed that of the noise."""
DRAWS = 1024
"""Of a posterior."""
STEP = 0.2
"""Of differences, in standard deviations."""
WIDTH = 0.02
"""And in widths of the box, where no deviation is known."""
TINY = 1e-9
"""Distance of a start from the box's bounds."""
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
    leaps: int = 0,
) -> np.ndarray:
    """Draws in inference space, shape [N, D]; see `importance.posterior`.

    Args:
        rng: of the draws.
        task: with a response outside JAX.
        recorded: of all experiments, shape [E, T, C].
        designs: theirs, shape [E, K].
        before: draws of the first recording's posterior, where to begin; from the box if not.
        leaps: fits about the best one that are tried even where the noise explains that.
    """
    box, of = task.support(None), log_likelihood(task)
    low, high = np.asarray(box.low, float), np.asarray(box.high, float)
    if before is None:
        drawn = rng.uniform(low, high, (FIRST, len(low)))
        starts = drawn[np.argsort(-of(recorded, designs, drawn).sum(axis=1))[:MOST]]
        least, deviation = STARTS, WIDTH * (high - low)
    else:
        starts, least, deviation = before.mean(axis=0)[None], 1, before.std(axis=0)
    enough = 0.5 * (np.size(recorded) + EXPLAINED * np.sqrt(2 * np.size(recorded)))
    fit = lambda start, deviation: fitted(task, recorded, designs, np.clip(start, low + TINY, high - TINY), deviation)
    best = fit(starts[0], deviation)
    for number, start in enumerate(starts[1:], start=1):
        if number >= least and best[0] <= enough:
            break
        best = min(best, fit(start, deviation), key=lambda one: one[0])
    for leap in range(LEAPS):
        if leap >= leaps and best[0] <= enough:
            break
        factor = DISTANCES[leap % len(DISTANCES)] * np.linalg.cholesky(best[2])
        about = np.clip(best[1] + rng.standard_normal((LEAP, len(low))) @ factor.T, low + TINY, high - TINY)
        start = about[np.argmax(of(recorded, designs, about).sum(axis=1))]
        best = min(best, fit(start, np.minimum(np.sqrt(np.diagonal(best[2])), deviation)), key=lambda one: one[0])
    _, mean, covariance = best
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
    near = theta[systematic(rng, weights(importance.power_of(log, 0.2 * POINTS) * log), POINTS)]
    return importance.posterior(rng, task, recorded, designs, near, points=2 * POINTS, propose=importance.kernels)


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
