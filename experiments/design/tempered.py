"""Exact posteriors of any shape: particles are tempered from the box to the posterior, and moved by differences.

Sequential Monte Carlo with tempered likelihoods (Del Moral, Doucet and Jasra 2006). A particle moves along the
difference of two others (ter Braak 2006) from the other half of the particles, so that each half is moved by a Markov
chain whose proposals do not depend on it (Foreman-Mackey, Hogg, Lang and Goodman 2013).
"""

import numpy as np

from experiments.design.likelihood import log_likelihood
from experiments.design.resampling import systematic, weights
from experiments.design.trust import require_explained, require_moved
from jaxlfi.tasks.task import Task

PARTICLES = 2048
FIRST = 4
"""Factor by which more particles are drawn from the box."""
SWEEPS, LAST = 8, 24
"""Number of moves of all particles at each temperature, and at the end."""
EFFECTIVE = 0.5
"""Fraction of particles that are effective after each step."""
LEAPS = 0.1
"""Fraction of moves that are as long as the difference, which lead from one mode to another."""


def posterior(
    rng: np.random.Generator,
    task: Task,
    recorded: np.ndarray,
    designs: np.ndarray,
    before: np.ndarray | None = None,
) -> np.ndarray:
    """Draws in inference space, shape [N, D].

    Args:
        rng: random generator of particles and moves.
        task: task with a known response and noise.
        recorded: recordings of all experiments, shape [E, T, ...].
        designs: their designs, shape [E, K].
        before: draws of the first experiment's posterior to begin with; None begins with the box.

    Raises:
        UntrustedError: if noise does not explain the residuals of the best particle, or particles do not move.
    """
    box, of = task.support(None), log_likelihood(task)
    low, high = np.asarray(box.low, float), np.asarray(box.high, float)
    known = 0 if before is None else 1

    def parts(theta: np.ndarray) -> np.ndarray:
        """Log-likelihoods of the recordings that are included already and of the added ones, shape [2, N]."""
        log = of(recorded, designs, theta)
        inside = ((theta > low) & (theta < high)).all(axis=1)
        found = np.stack([log[:, :known].sum(axis=1), log[:, known:].sum(axis=1)])
        return np.where(inside, found, -np.inf)

    if before is None:
        theta = rng.uniform(low, high, (FIRST * PARTICLES, len(low)))
        log = np.concatenate([parts(part) for part in np.split(theta, FIRST)], axis=1)
    else:
        theta = before[rng.permutation(len(before))]
        log = parts(theta)
    power = 0.0
    while power < 1.0:
        step = _step(log[1], 1.0 - power, EFFECTIVE * PARTICLES)
        power += step
        chosen = systematic(rng, weights(step * log[1]), PARTICLES)
        theta, log = theta[chosen], log[:, chosen]
        moves = 0.0
        for _ in range(SWEEPS if power < 1.0 else LAST):
            theta, log, taken = _moved(rng, parts, theta, log, power)
            moves += taken
    require_explained(-log.sum(axis=0).max(), np.size(recorded))
    require_moved(moves)
    return theta


def _moved(rng: np.random.Generator, parts, theta: np.ndarray, log: np.ndarray, power: float):
    """Both halves moved once, by differences within the other, and the fraction of particles that moved."""
    moved = 0
    order = rng.permutation(len(theta))
    theta, log = theta[order].copy(), log[:, order].copy()
    half, dim = len(theta) // 2, theta.shape[1]
    for own, other in ((slice(0, half), slice(half, None)), (slice(half, None), slice(0, half))):
        pairs = np.argsort(rng.random((half, 12)), axis=1)[:, :2]  # two of a dozen random ones
        dozen = rng.integers(half, size=(half, 12))
        first, second = (theta[other][dozen[np.arange(half), pairs[:, i]]] for i in (0, 1))
        scale = 2.38 / np.sqrt(2 * dim) * np.exp(rng.uniform(np.log(0.2), np.log(1.2), (half, 1)))
        scale = np.where(rng.random((half, 1)) < LEAPS, 1.0, scale)
        tried = theta[own] + scale * (first - second)
        new = parts(tried)
        gain = (new[0] - log[0, own]) + power * (new[1] - log[1, own])
        taken = np.log(rng.random(half)) < gain
        theta[own] = np.where(taken[:, None], tried, theta[own])
        log[:, own] = np.where(taken, new, log[:, own])
        moved += taken.sum()
    return theta, log, moved / len(theta)


def _step(log: np.ndarray, most: float, effective: float) -> float:
    """The next increment of the likelihood's power, which leaves this many particles effective."""
    enough = lambda step: 1 / np.sum(weights(step * log) ** 2) >= effective
    if enough(most):
        return most
    low, high = -30.0, np.log(most)
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if enough(np.exp(middle)) else (low, middle)
    return float(np.exp(low))
