"""Exact posteriors of slow simulators: importance sampling about the points that fit best.

Least squares begins from the best of some draws, from the known posterior or from the box, starting with those that are
far from one another. Fits are local: while noise does not explain the residuals of the best one, further fits begin
from other draws, and from the best of draws at some distance from it. A posterior whose best fit noise never explains
is refused.

About each fit that explains the recordings nearly as well, draws are made from a Student's t distribution with the
covariance that derivatives give there, and weighed by the likelihood; it reaches tails that a normal would miss. If too
few of them are effective, tempered steps continue from these. The draws fill the t distribution evenly (a scrambled
Sobol sequence), and resampling is systematic: as few independent draws left the ends of 90 % intervals uncertain by a
fifth of a standard deviation.
"""

import numpy as np
import scipy.optimize
from scipy.special import logsumexp
from scipy.stats import chi2, norm, qmc

from experiments.design import importance
from experiments.design.likelihood import log_likelihood, residuals
from experiments.design.resampling import systematic, weights
from experiments.design.trust import explained, require_explained
from jaxlfi.tasks.task import Task

POINTS, FIRST, STARTS = 256, 512, 4
"""Numbers of draws about each fit, of draws from the box, and of the latter's best that fits start from at least."""
MOST = 16
"""Largest number of best draws that fits start from."""
LEAPS, LEAP = 12, 64
"""Largest number of fits from the best of draws about a fit that noise does not explain, and number of these draws."""
DISTANCES = (3.0, 10.0, 30.0)
"""Scales of these draws, in standard deviations of that fit, used in turn."""
NATS = 10.0
"""Largest difference in log-likelihood from the best fit of other fits that draws are made about."""
APART = 2.0
"""Standard deviations above which two fits count as different."""
FREEDOM, WIDER = 5, 1.2
"""Degrees of freedom of the t distribution, and its scale, in standard deviations of the fit."""
EFFECTIVE = 0.2
"""Smallest fraction of effective draws."""
DRAWS = 1024
"""Number of draws from a posterior."""
STEP = 0.2
"""Step of finite differences, in standard deviations."""
WIDTH = 0.02
"""Standard deviation that is assumed if none is known, in widths of the box."""
TINY = 1e-9
"""Distance of a start from the box's bounds."""
FAILED = 1e3
"""Residuals of simulations that fail."""

Fit = tuple[float, np.ndarray, np.ndarray]
"""Misfit, mean and covariance of a fit."""


def posterior(
    rng: np.random.Generator,
    task: Task,
    recorded: np.ndarray,
    designs: np.ndarray,
    before: np.ndarray | None = None,
) -> np.ndarray:
    """Draws in inference space, shape [N, D]; see `importance.posterior`.

    Args:
        rng: random generator of the draws.
        task: task with a response outside JAX.
        recorded: recordings of all experiments, shape [E, T, C].
        designs: their designs, shape [E, K].
        before: draws of the first recording's posterior to begin with; None begins with the box.

    Raises:
        UntrustedError: if noise does not explain the residuals of the best fit.
    """
    box, of = task.support(None), log_likelihood(task)
    low, high = np.asarray(box.low, float), np.asarray(box.high, float)
    fits = _fits(rng, task, recorded, designs, before)
    require_explained(fits[0][0], np.size(recorded))
    theta, log_proposal = _about(rng, _modes(fits), low, high)
    log = of(recorded, designs, theta).sum(axis=1) - log_proposal
    weight = weights(log)
    if 1 / np.sum(weight**2) >= EFFECTIVE * len(log):
        return theta[systematic(rng, weight, DRAWS)]
    power = importance.power_of(log, EFFECTIVE * len(log))
    near = theta[systematic(rng, weights(power * log), POINTS)]
    return importance.posterior(rng, task, recorded, designs, near, points=2 * POINTS, propose=importance.kernels)


def _fits(
    rng: np.random.Generator, task: Task, recorded: np.ndarray, designs: np.ndarray, before: np.ndarray | None
) -> list[Fit]:
    """All fits, the best one first."""
    box, of, size = task.support(None), log_likelihood(task), np.size(recorded)
    low, high = np.asarray(box.low, float), np.asarray(box.high, float)
    drawn = rng.uniform(low, high, (FIRST, len(low))) if before is None else before[:: -(-len(before) // FIRST)]
    deviation = WIDTH * (high - low) if before is None else before.std(axis=0)
    inside = lambda theta: np.clip(theta, low + TINY, high - TINY)
    likeliest = lambda theta: theta[np.argsort(-of(recorded, designs, theta).sum(axis=1))]
    fit = lambda start, scale: fitted(task, recorded, designs, inside(start), scale)
    fits: list[Fit] = []

    def add(start: np.ndarray, scale: np.ndarray) -> None:
        """Add a fit, made again with differences scaled by its own covariance."""
        _, mean, covariance = fit(start, scale)
        fits.append(fit(mean, np.minimum(np.sqrt(np.diagonal(covariance)), scale)))
        fits.sort(key=lambda one: one[0])

    for number, start in enumerate(_far_first(likeliest(drawn)[:MOST], drawn.std(axis=0))):
        if number >= STARTS and explained(fits[0][0], size):
            break
        add(start, deviation)
    for leap in range(LEAPS):
        _, mean, covariance = fits[0]
        if explained(fits[0][0], size):
            break
        factor = DISTANCES[leap % len(DISTANCES)] * np.linalg.cholesky(covariance)
        about = inside(mean + rng.standard_normal((LEAP, len(low))) @ factor.T)
        add(likeliest(about)[0], np.minimum(np.sqrt(np.diagonal(covariance)), deviation))
    return fits


def _far_first(theta: np.ndarray, scale: np.ndarray) -> list[np.ndarray]:
    """All points in order: the first, and then each time the one farthest from those before it."""
    left, found = list(theta[1:]), [theta[0]]
    while left:
        nearest = [min(np.sum(((one - other) / scale) ** 2) for other in found) for one in left]
        found.append(left.pop(int(np.argmax(nearest))))
    return found


def _modes(fits: list[Fit]) -> list[Fit]:
    """The fits that are nearly as likely as the best one, without duplicates."""
    found: list[Fit] = []
    for one in fits:
        off = [one[1] - other[1] for other in found]
        far = all(gap @ np.linalg.solve(other[2], gap) > APART**2 for gap, other in zip(off, found, strict=True))
        if one[0] <= fits[0][0] + NATS and far:
            found.append(one)
    return found


def _about(
    rng: np.random.Generator, modes: list[Fit], low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Draws in the box from t distributions about all fits, and the logarithm of the sum of their densities there."""
    dim = len(low)
    means = np.stack([mean for _, mean, _ in modes])
    factors = np.stack([WIDER * np.linalg.cholesky(covariance) for _, _, covariance in modes])
    even = np.stack([qmc.Sobol(dim + 1, rng=rng).random(16 * POINTS) for _ in modes], axis=1)  # each fills its own
    longer = np.sqrt(FREEDOM / chi2.ppf(even[..., -1:], FREEDOM))
    tried = means + np.einsum("kij,nkj->nki", factors, longer * norm.ppf(even[..., :-1]))
    tried = tried.reshape(-1, dim)  # equally many about each fit, before the box is applied
    theta = tried[((tried > low) & (tried < high)).all(axis=1)][: POINTS * len(modes)]
    away = np.stack([np.linalg.solve(f, (theta - m).T) for f, m in zip(factors, means, strict=True)])
    each = -0.5 * (FREEDOM + dim) * np.log1p(np.sum(away**2, axis=1) / FREEDOM)
    return theta, logsumexp(each - np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)[:, None], axis=0)


def fitted(
    task: Task, recorded: np.ndarray, designs: np.ndarray, start: np.ndarray, deviation: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """The misfit of the least-squares fit in the box, its point, and the covariance that its derivatives give.

    Args:
        task: task with a response outside JAX.
        recorded: recordings, shape [E, T, C].
        designs: their designs, shape [E, K].
        start: starting point, shape [D].
        deviation: standard deviations of the parameters, which set the steps of differences, shape [D].
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
