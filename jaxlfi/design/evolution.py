"""CMA-ES: gradient-free maximisation in a box that adapts to the shape of the objective.

The algorithm and its constants are those of Hansen, "The CMA Evolution Strategy: A Tutorial" (2016), with positive
recombination weights: rank-one and rank-mu updates of the covariance, and cumulative step-size adaptation. It works on
the unit cube. Candidates outside are evaluated at the nearest point inside, minus a penalty for their distance, which
keeps the distribution's mean near the cube.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

PENALTY = 1.0
"""Penalty of a squared distance from the cube in step sizes, as a fraction of the range of a generation's values."""
SMALLEST = 1e-4
"""Step size, in widths of the cube, below which the search has converged."""


@dataclasses.dataclass(frozen=True)
class Found:
    """The result of a search.

    Attributes:
        point: best point of the unit cube, shape [K].
        value: value at the best point.
        points: all evaluated points, shape [N, K].
        values: values at these points, shape [N].
    """

    point: np.ndarray
    value: float
    points: np.ndarray
    values: np.ndarray


def maximise(
    rng: np.random.Generator,
    objective: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    step: float = 0.25,
    generations: int = 20,
    population: int | None = None,
) -> Found:
    """Maximise a function on the unit cube.

    Args:
        rng: random number generator of the candidates.
        objective: function from points [N, K] to values [N]; a value that is not finite ranks last.
        start: initial mean, shape [K].
        step: initial step size, in widths of the cube.
        generations: largest number of generations.
        population: number of candidates in a generation; by default 4 + 3 ln K.

    Example:
        >>> found = maximise(np.random.default_rng(0), lambda x: -np.sum((x - 0.3) ** 2, axis=1), np.full(2, 0.9))
        >>> bool(np.abs(found.point - 0.3).max() < 0.02)
        True
    """
    dim = len(start)
    size = population or 4 + int(3 * np.log(dim))
    parents = size // 2
    weights = np.log((size + 1) / 2) - np.log(np.arange(1, parents + 1))
    weights /= weights.sum()
    effective = 1 / np.sum(weights**2)
    c_sigma = (effective + 2) / (dim + effective + 5)
    d_sigma = 1 + 2 * max(0.0, np.sqrt((effective - 1) / (dim + 1)) - 1) + c_sigma
    c_path = (4 + effective / dim) / (dim + 4 + 2 * effective / dim)
    c_one = 2 / ((dim + 1.3) ** 2 + effective)
    c_mu = min(1 - c_one, 2 * (effective - 2 + 1 / effective) / ((dim + 2) ** 2 + effective))
    expected = np.sqrt(dim) * (1 - 1 / (4 * dim) + 1 / (21 * dim**2))  # length of a standard normal vector

    mean, sigma, covariance = np.array(start, float), step, np.eye(dim)
    path, path_sigma = np.zeros(dim), np.zeros(dim)
    points: list[np.ndarray] = []
    values: list[np.ndarray] = []
    for generation in range(1, generations + 1):
        variance, axes = np.linalg.eigh(covariance)
        scale = np.sqrt(np.maximum(variance, 1e-20))
        y = (rng.standard_normal((size, dim)) * scale) @ axes.T
        candidates = mean + sigma * y
        inside = np.clip(candidates, 0.0, 1.0)
        value = np.asarray(objective(inside), float)
        value = np.where(np.isfinite(value), value, -np.inf)
        points.append(inside)
        values.append(value)
        finite = value[np.isfinite(value)]
        spread = np.ptp(finite) + 1e-12 if len(finite) else 1.0
        distance = np.sum((candidates - inside) ** 2, axis=1) / sigma**2
        best = np.argsort(-(value - PENALTY * spread * distance), kind="stable")[:parents]
        shift = weights @ y[best]
        mean = mean + sigma * shift
        path_sigma = (1 - c_sigma) * path_sigma + np.sqrt(c_sigma * (2 - c_sigma) * effective) * (
            axes @ ((axes.T @ shift) / scale)
        )
        length = np.linalg.norm(path_sigma)
        going = length / np.sqrt(1 - (1 - c_sigma) ** (2 * generation)) < (1.4 + 2 / (dim + 1)) * expected
        path = (1 - c_path) * path + going * np.sqrt(c_path * (2 - c_path) * effective) * shift
        kept = 1 - c_one - c_mu + (1 - going) * c_one * c_path * (2 - c_path)
        covariance = kept * covariance + c_one * np.outer(path, path) + c_mu * (y[best].T * weights) @ y[best]
        sigma *= np.exp(min(1.0, c_sigma / d_sigma * (length / expected - 1)))
        if sigma * scale.max() < SMALLEST:
            break
    every, each = np.concatenate(points), np.concatenate(values)
    place = int(np.argmax(each))
    return Found(every[place], float(each[place]), every, each)
