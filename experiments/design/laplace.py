"""Exact posteriors of slow simulators: importance sampling about the points that fit best.

Least squares begins from the best of some draws, of the posterior that is known already or of the box, those first
that are far from one another. Fits are local: while the best one leaves residuals that the noise does not explain,
others are fitted, from further draws, and from the best of draws at some distance from it. A posterior whose best fit
the noise never explains is refused.

About each fit that explains the recordings nearly as well, draws of a Student's t distribution with the covariance that
derivatives give there are weighed by the likelihood; its tails are found where those of a normal would end. Where too
few count, tempered steps lead on from these. The draws fill the t distribution evenly (a scrambled Sobol sequence), and
so do those of the posterior (systematic resampling): independent draws, as few as these, left the ends of 90 %
intervals a fifth of a standard deviation uncertain.
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
"""About each fit, from the box, and how many of these are fitted from at least."""
MOST = 16
"""The best draws, which are fitted from at most."""
LEAPS, LEAP = 12, 64
"""Fits from the best of so many draws about a fit that the noise does not explain."""
DISTANCES = (3.0, 10.0, 30.0)
"""How many times as wide as that fit's covariance these draws are, one after another."""
NATS = 10.0
"""By how much less likely fits than the best one have draws about them, too."""
APART = 2.0
"""Standard deviations between fits that are not the same."""
FREEDOM, WIDER = 5, 1.2
"""Degrees of freedom of the t distribution, and its scale, in standard deviations of the fit."""
EFFECTIVE = 0.2
"""Part of the draws that is effective at least."""
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

Fit = tuple[float, np.ndarray, np.ndarray]
"""Misfit, mean and covariance."""


def posterior(
    rng: np.random.Generator,
    task: Task,
    recorded: np.ndarray,
    designs: np.ndarray,
    before: np.ndarray | None = None,
) -> np.ndarray:
    """Draws in inference space, shape [N, D]; see `importance.posterior`.

    Args:
        rng: of the draws.
        task: with a response outside JAX.
        recorded: of all experiments, shape [E, T, C].
        designs: theirs, shape [E, K].
        before: draws of the first recording's posterior, where to begin; from the box if not.

    Raises:
        UntrustedError: where noise does not explain what the best fit leaves.
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
    """The best one first."""
    box, of, size = task.support(None), log_likelihood(task), np.size(recorded)
    low, high = np.asarray(box.low, float), np.asarray(box.high, float)
    drawn = rng.uniform(low, high, (FIRST, len(low))) if before is None else before[:: -(-len(before) // FIRST)]
    deviation = WIDTH * (high - low) if before is None else before.std(axis=0)
    inside = lambda theta: np.clip(theta, low + TINY, high - TINY)
    likeliest = lambda theta: theta[np.argsort(-of(recorded, designs, theta).sum(axis=1))]
    fit = lambda start, scale: fitted(task, recorded, designs, inside(start), scale)
    fits: list[Fit] = []

    def add(start: np.ndarray, scale: np.ndarray) -> None:
        """A fit, and once more with the differences that it says itself."""
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
    """All of them: the first, and each time the one that is farthest from those before it."""
    left, found = list(theta[1:]), [theta[0]]
    while left:
        nearest = [min(np.sum(((one - other) / scale) ** 2) for other in found) for one in left]
        found.append(left.pop(int(np.argmax(nearest))))
    return found


def _modes(fits: list[Fit]) -> list[Fit]:
    """Those that are nearly as likely as the best one, each of them once."""
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
    """Draws in the box of t distributions about all fits, and the logarithm of their sum there."""
    dim = len(low)
    means = np.stack([mean for _, mean, _ in modes])
    factors = np.stack([WIDER * np.linalg.cholesky(covariance) for _, _, covariance in modes])
    even = np.stack([qmc.Sobol(dim + 1, rng=rng).random(16 * POINTS) for _ in modes], axis=1)  # each fills its own
    longer = np.sqrt(FREEDOM / chi2.ppf(even[..., -1:], FREEDOM))
    tried = means + np.einsum("kij,nkj->nki", factors, longer * norm.ppf(even[..., :-1]))
    tried = tried.reshape(-1, dim)  # as many of each fit, wherever the box ends
    theta = tried[((tried > low) & (tried < high)).all(axis=1)][: POINTS * len(modes)]
    away = np.stack([np.linalg.solve(f, (theta - m).T) for f, m in zip(factors, means, strict=True)])
    each = -0.5 * (FREEDOM + dim) * np.log1p(np.sum(away**2, axis=1) / FREEDOM)
    return theta, logsumexp(each - np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)[:, None], axis=0)


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
