"""Points that represent the standard normal distribution."""

import functools

import numpy as np
from jaxtyping import Float

POINTS = 64
"""Smallest number of points."""


@functools.cache
def normal_points(dim: int) -> Float[np.ndarray, "n dim"]:
    """Points of the standard normal distribution, with its mean and covariance; always the same ones.

    Example:
        >>> points = normal_points(2)
        >>> points.shape, bool(np.allclose(points.T @ points / 64, np.eye(2), atol=1e-5))
        ((64, 2), True)
    """
    points = np.random.default_rng(0).normal(size=(max(POINTS // 2, 4 * dim), dim))
    points = np.concatenate([points, -points])
    return np.linalg.solve(np.linalg.cholesky(points.T @ points / len(points)), points.T).T.astype(np.float32)
