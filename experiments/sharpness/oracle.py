"""Draws of exact posteriors: importance sampling for any likelihood, Gibbs sampling for linear models.

Importance sampling is exact for any proposal. Here the proposal is a mixture of Student's t around particles of a
tempered sequential Monte Carlo run, each as wide as its neighbours are apart, so that modes, ridges and rings are
covered. The effective sample size measures its quality: it is reported, and a result with too small a one is refused.
An unbiased estimate of the likelihood (by a particle filter) may replace the exact one: weights are then unbiased
estimates, and the effective size counts their noise, too.
"""

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy import special

LEAST_SIZE = 1000.0
"""Effective size below which a reference is refused."""
TEMPERED_SIZE = 0.5
"""Effective fraction of particles that a tempering step keeps."""
FREEDOM = 5.0
"""Degrees of freedom of the proposal's kernels."""
ATTEMPTS = 10
"""Rounds of importance sampling, each from the draws of the one before, until the effective size suffices."""
MAX_STEPS = 200

LogDensity = Callable[[np.ndarray, int], np.ndarray]
"""`(theta [N, D], seed) -> log-density [N]`, up to a constant; an estimated one draws by the seed."""


@dataclasses.dataclass(frozen=True)
class Draws:
    """Draws of a posterior, all with equal weight.

    Attributes:
        theta: shape [N, D].
        log_density: of each, up to a constant that all share, shape [N].
        size: effective size of the weighted draws that they were picked from.
    """

    theta: np.ndarray
    log_density: np.ndarray
    size: float


def effective_size(log_weight: np.ndarray) -> float:
    """Effective sample size of weights with these logarithms: N for N equal ones, 1 if one outweighs all others."""
    weight = np.exp(log_weight - np.max(log_weight))
    return float(weight.sum() ** 2 / np.sum(weight**2))


def _picked(rng: np.random.Generator, log_weight: np.ndarray, count: int) -> np.ndarray:
    """Indices drawn by weight with systematic resampling, shape [count]."""
    weight = np.cumsum(np.exp(log_weight - np.max(log_weight)))
    points = (np.arange(count) + rng.uniform()) / count * weight[-1]
    return np.minimum(np.searchsorted(weight, points), len(weight) - 1)


@dataclasses.dataclass(frozen=True)
class Effort:
    """How much work an oracle does.

    Attributes:
        particles: of the tempered run.
        moves: Metropolis steps of every particle at each temperature.
        centres: of the proposal.
        draws: weighted draws per round.
    """

    particles: int = 2000
    moves: int = 6
    centres: int = 500
    draws: int = 10_000


def importance_draws(
    log_likelihood: LogDensity,
    log_prior: Callable[[np.ndarray], np.ndarray],
    prior_draws: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    *,
    count: int,
    seed: int = 0,
    effort: Effort | None = None,
    least: float = LEAST_SIZE,
) -> Draws:
    """Draws of a posterior on a box.

    Args:
        log_likelihood: of N parameters at once.
        log_prior: up to a constant; of N parameters that lie in the box.
        prior_draws: from the prior on the box, one per particle, shape [N, D].
        low: of the box, shape [D].
        high: of the box.
        count: of draws that are returned.
        seed: of everything.
        effort: by default that of `Effort`, with as many particles as there are draws of the prior.
        least: effective size below which there is no result.

    Raises:
        ValueError: for an effective size that is too small.
    """
    effort, rng = effort or Effort(), np.random.default_rng(seed)
    theta = _tempered(rng, log_likelihood, log_prior, np.asarray(prior_draws, float), low, high, effort)
    log_weights, kept, densities = [], [], []
    for _ in range(ATTEMPTS):
        proposed, log_proposal = _kernels(rng, theta, effort)
        inside = np.all((proposed >= low) & (proposed <= high), axis=1)
        log_density = np.full(len(proposed), -np.inf)
        places = np.clip(proposed, low, high)  # one shape for all calls, so that one program serves them
        values = log_likelihood(places, int(rng.integers(2**31))) + log_prior(places)
        log_density[inside] = values[inside]
        log_density[np.isnan(log_density)] = -np.inf
        log_weight = log_density - log_proposal
        if not np.isfinite(log_weight).any():
            raise ValueError("importance sampling: expected draws of some density, got none")
        size = effective_size(log_weight)
        # Rounds are pooled if they are of similar quality; the first may be poor.
        log_weights, kept, densities = (
            [*old, new] for old, new in ((log_weights, log_weight), (kept, proposed), (densities, log_density))
        )
        pooled = effective_size(np.concatenate(log_weights))
        if size >= pooled:
            log_weights, kept, densities = [log_weight], [proposed], [log_density]
        size = max(size, pooled)
        theta = np.concatenate(kept)[_picked(rng, np.concatenate(log_weights), len(theta))]
        if size >= 2 * least:
            break
    if size < least:
        raise ValueError(f"importance sampling: expected an effective size of {least:.0f} or more, got {size:.0f}")
    places = _picked(rng, np.concatenate(log_weights), count)
    places = rng.permutation(places)
    return Draws(np.concatenate(kept)[places], np.concatenate(densities)[places], size)


def _tempered(rng, log_likelihood, log_prior, theta, low, high, effort) -> np.ndarray:
    """Particles that follow the posterior roughly, shape [N, D]."""
    count, dim = theta.shape
    value, prior, temperature = log_likelihood(theta, int(rng.integers(2**31))), log_prior(theta), 0.0
    value = np.where(np.isnan(value), -np.inf, value)
    for _ in range(MAX_STEPS):
        following = _next_temperature(value, temperature)
        chosen = _picked(rng, np.nan_to_num((following - temperature) * value, neginf=-1e300, nan=-1e300), count)
        theta, value, prior, temperature = theta[chosen], value[chosen], prior[chosen], following
        for move in range(effort.moves * (1 + (temperature == 1))):
            # Differential evolution: steps along differences of other particles, now and then a whole one.
            first, second = rng.integers(count, size=(2, count))
            scale = 1.0 if move % 3 == 2 else 2.38 / np.sqrt(2 * dim) * rng.uniform(0.2, 1.0)
            jitter = 1e-3 * theta.std(axis=0) * rng.normal(size=theta.shape)
            proposed = theta + scale * (theta[first] - theta[second]) + jitter
            inside = np.all((proposed >= low) & (proposed <= high), axis=1)
            proposed = np.clip(proposed, low, high)
            other = log_likelihood(proposed, int(rng.integers(2**31)))
            other = np.where(inside & ~np.isnan(other), other, -np.inf)
            other_prior = log_prior(proposed)
            with np.errstate(invalid="ignore"):
                gain = temperature * (other - value) + other_prior - prior
            accepted = inside & (np.log(rng.uniform(size=count)) < np.nan_to_num(gain, nan=-np.inf))
            theta = np.where(accepted[:, None], proposed, theta)
            value, prior = np.where(accepted, other, value), np.where(accepted, other_prior, prior)
        if temperature == 1:
            return theta
    raise ValueError(f"tempering: expected to end within {MAX_STEPS} steps, got to {temperature:.3g}")


def _next_temperature(value: np.ndarray, temperature: float) -> float:
    """The largest temperature at which `TEMPERED_SIZE` of the particles are effective."""
    wanted = TEMPERED_SIZE * np.isfinite(value).sum()
    size = lambda following: effective_size((following - temperature) * np.where(np.isfinite(value), value, -1e300))
    if not np.isfinite(value).any():
        raise ValueError("tempering: expected a likelihood at some draws of the prior, got none")
    if size(1.0) >= wanted:
        return 1.0
    low, high = temperature, 1.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if size(middle) >= wanted else (low, middle)
    return high


def _kernels(rng: np.random.Generator, theta: np.ndarray, effort: Effort) -> tuple[np.ndarray, np.ndarray]:
    """Draws of the mixture of kernels, shape [M, D], and its log-density at each."""
    unique = np.unique(theta, axis=0)
    centres = unique[rng.permutation(len(unique))[: effort.centres]]
    count, dim = centres.shape
    spread = unique.std(axis=0) + 1e-12
    scaled = centres / spread
    distance = np.sum((scaled[:, None] - scaled[None]) ** 2, axis=-1)
    neighbours = np.argsort(distance, axis=1)[:, : max(count // 15, 4 * dim)]
    near = scaled[neighbours]
    centred = near - near.mean(axis=1, keepdims=True)
    covariance = np.einsum("ikd,ike->ide", centred, centred) / near.shape[1]
    # Regular in the units of each kernel's own axes: a mode may be thousands of times as thin as modes are apart.
    diagonal = np.einsum("idd->id", covariance)[:, :, None] * np.eye(dim)
    factor = np.linalg.cholesky(covariance + 1e-2 * diagonal + 1e-14 * np.eye(dim))
    which = rng.integers(count, size=effort.draws)
    step = rng.normal(size=(effort.draws, dim)) / np.sqrt(rng.chisquare(FREEDOM, effort.draws) / FREEDOM)[:, None]
    proposed = scaled[which] + np.einsum("ide,ie->id", factor[which], step)
    inverse = np.linalg.inv(factor)
    log_kernel = np.empty((effort.draws, count))
    for start in range(0, effort.draws, 2000):
        part = slice(start, start + 2000)
        standard = np.einsum("jde,je->jd", inverse, scaled)  # L^-1 c, so that L^-1 (x - c) is one product
        moved = np.einsum("jde,ie->ijd", inverse, proposed[part], optimize=True) - standard
        log_kernel[part] = -0.5 * (FREEDOM + dim) * np.log1p(np.sum(moved**2, axis=-1) / FREEDOM)
    log_kernel -= np.log(np.abs(np.linalg.det(factor))) + np.log(count)  # so that rounds can be pooled
    return proposed * spread, special.logsumexp(log_kernel, axis=1)


def linear_draws(
    matrix: np.ndarray, noise: float, x: np.ndarray, low: np.ndarray, high: np.ndarray, *, count: int, seed: int = 0
) -> Draws:
    """Draws of the posterior of x = matrix theta + noise under a uniform prior on a box: a truncated Gaussian.

    Gibbs sampling along the principal axes of the Gaussian, where each conditional is a truncated normal distribution,
    or uniform along axes that the data do not inform. Every draw is the end of its own chain, so that draws are
    independent; chains have converged once their moments no longer change.

    Args:
        matrix: shape [S, D].
        noise: standard deviation.
        x: shape [S].
        low: of the box, shape [D].
        high: of the box.
        count: of draws.
        seed: of everything.

    Raises:
        ValueError: where chains have not converged.
    """
    rng, dim = np.random.default_rng(seed), matrix.shape[1]
    precision = matrix.T @ matrix / noise**2
    values, axes = np.linalg.eigh(precision)
    values = np.where(values > 1e-9 * values.max(), values, 0.0)
    peak = axes.T @ np.linalg.lstsq(matrix, x, rcond=None)[0]  # along the axes
    theta = rng.uniform(low, high, (count, dim))
    sweeps, before = 30, None
    for sweep in range(8 * sweeps):
        for axis in rng.permutation(dim):
            direction = axes[:, axis]
            with np.errstate(divide="ignore", invalid="ignore"):
                steps = np.stack([(low - theta) / direction, (high - theta) / direction])
            steps = np.where(np.abs(direction) > 1e-12, steps, np.array([-np.inf, np.inf])[:, None, None])
            least, most = np.min(steps, axis=0).max(axis=1), np.max(steps, axis=0).min(axis=1)
            least, most = np.minimum(least, 0.0), np.maximum(most, 0.0)
            here = theta @ direction
            if values[axis] == 0:
                step = rng.uniform(least, most)
            else:
                deviation = values[axis] ** -0.5
                ends = [(here + end - peak[axis]) / deviation for end in (least, most)]
                step = peak[axis] + deviation * _truncated_normal(rng, *ends) - here
            theta = np.clip(theta + step[:, None] * direction, low, high)
        if sweep % sweeps == sweeps - 1:
            moments = np.concatenate([theta.mean(axis=0) / theta.std(axis=0), np.log(theta.std(axis=0))])
            # Two independent sets of draws differ by this much: 5 standard errors of a mean, 7 of a deviation.
            if before is not None and np.max(np.abs(moments - before)) < 7 / np.sqrt(count) * (
                1 + 0.2 * np.max(np.abs(moments[:dim]))
            ):
                residual = (theta @ matrix.T - x) / noise
                return Draws(theta, -0.5 * np.sum(residual**2, axis=1), float(count))
            before = moments
    raise ValueError(f"Gibbs sampling: expected chains that converge within {8 * sweeps} sweeps, got others")


def _truncated_normal(rng: np.random.Generator, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Draws of the standard normal distribution between bounds, also far out in its tails."""
    flipped = low + high > 0
    low, high = np.where(flipped, -high, low), np.where(flipped, -low, high)
    below, above = special.log_ndtr(low), special.log_ndtr(high)
    share = rng.uniform(size=low.shape)
    value = special.ndtri_exp(above + np.log1p(-share * -np.expm1(below - above)))
    value = np.clip(value, low, high)
    return np.where(flipped, -value, value)
