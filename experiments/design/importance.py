"""Exact posteriors from few simulations: importance sampling with normals, by a likelihood tempered in steps."""

from collections.abc import Callable, Iterator

import numpy as np
from scipy.special import logsumexp

from experiments.design.likelihood import log_likelihood
from experiments.design.resampling import systematic, weights
from jaxlfi.tasks.task import Task

POINTS = 1024
"""Number of draws in each step, and of the posterior."""
FIRST = 8
"""Factor by which more draws are made from the box."""
STEPS = 100
"""Largest number of steps."""
WIDER = 1.5
"""Width of a step's proposals, relative to the last step's draws."""
KERNEL = 0.7
"""Width of the kernels about a step's draws, in standard deviations of these."""


def posterior(
    rng: np.random.Generator,
    task: Task,
    recorded: np.ndarray,
    designs: np.ndarray,
    before: np.ndarray | None = None,
    points: int = POINTS,
    first: int = FIRST * POINTS,
    propose: Callable | None = None,
) -> np.ndarray:
    """Draws in inference space, shape [N, D].

    Each step weighs draws by the ratio of likelihood and proposal, raised to the power that leaves a fifth of them
    effective, and draws the next ones in the box from a normal that is half as wide again. The first ones are drawn
    from the box or, if the posterior of some recordings is known, from a normal that is half as wide again as that.

    Args:
        rng: random generator of the draws.
        task: task with a known response and noise.
        recorded: recordings of all experiments, shape [E, T, ...].
        designs: their designs, shape [E, K].
        before: draws of the first recording's posterior to begin with; None begins with the box.
        points: number of draws N.
        first: number of draws from the box.
        propose: function that makes a step's proposals from the last step's draws: `normal` by default, `kernels` for
            posteriors of other shapes.

    Raises:
        RuntimeError: if the full likelihood is not reached.
    """
    box = task.support(None)
    low, high = np.asarray(box.low, float), np.asarray(box.high, float)
    of, propose = log_likelihood(task), propose or normal
    if before is None:
        theta, log_proposal = rng.uniform(low, high, (first, len(low))), np.zeros(first)
    else:
        theta, log_proposal = propose(rng, low, high, points, before, np.full(len(before), 1 / len(before)))
    power = 0.0
    for _ in range(STEPS):
        log = np.concatenate([of(recorded, designs, part).sum(axis=1) for part in _parts(theta, points)])
        done, power = power, power_of(log - log_proposal, len(theta) / 5)
        weight = weights(power * (log - log_proposal))
        if power == 1.0 and done == 1.0:
            return theta[systematic(rng, weight, points)]
        theta, log_proposal = propose(rng, low, high, points, theta, weight)
    raise RuntimeError(f"{task.name}: expected a posterior after {STEPS} steps, got none")


def normal(rng: np.random.Generator, low: np.ndarray, high: np.ndarray, points: int, theta, weight):
    """Draws in the box from a normal that is wider than weighted draws, and its log-density there."""
    mean = weight @ theta
    centred = theta - mean
    factor = np.linalg.cholesky(WIDER**2 * (weight[:, None] * centred).T @ centred + 1e-12 * np.eye(len(mean)))
    kept = np.empty((0, len(mean)))
    while len(kept) < points:
        tried = mean + rng.standard_normal((4 * points, len(mean))) @ factor.T
        kept = np.concatenate([kept, tried[((tried > low) & (tried < high)).all(axis=1)]])
    theta = kept[:points]
    return theta, -0.5 * np.sum(np.linalg.solve(factor, (theta - mean).T) ** 2, axis=0)


def kernels(rng: np.random.Generator, low: np.ndarray, high: np.ndarray, points: int, theta, weight):
    """Draws in the box from a mixture of normals about weighted draws, and its log-density there."""
    centred = theta - weight @ theta
    factor = np.linalg.cholesky(KERNEL**2 * (weight[:, None] * centred).T @ centred + 1e-12 * np.eye(theta.shape[1]))
    kept = np.empty((0, theta.shape[1]))
    while len(kept) < points:
        about = theta[rng.choice(len(theta), 4 * points, p=weight)]
        tried = about + rng.standard_normal(about.shape) @ factor.T
        kept = np.concatenate([kept, tried[((tried > low) & (tried < high)).all(axis=1)]])
    centres, kept = theta[weight > 0], kept[:points]
    off = np.linalg.solve(factor, (kept[:, None] - centres).reshape(-1, theta.shape[1]).T).reshape(
        -1, points, len(centres)
    )
    return kept, logsumexp(-0.5 * np.sum(off**2, axis=0), axis=1, b=weight[weight > 0])


def _parts(theta: np.ndarray, size: int) -> Iterator[np.ndarray]:
    for first in range(0, len(theta), size):
        yield theta[first : first + size]


def power_of(log: np.ndarray, effective: float) -> float:
    """The largest power of weights, at most 1, that leaves this many draws effective."""
    enough = lambda power: 1 / np.sum(weights(power * log) ** 2) >= effective
    if enough(1.0):
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if enough(middle) else (low, middle)
    return max(low, 1e-6)
