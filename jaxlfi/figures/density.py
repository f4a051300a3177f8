"""A mixture of Gaussians in plain NumPy: marginals, their density, and the weighted mean."""

import numpy as np


def weights(logits: np.ndarray) -> np.ndarray:
    """Softmax over the last axis; a component of logit -inf has weight 0. If all are -inf, weights are NaN."""
    largest = np.max(logits, axis=-1, keepdims=True)
    exponentials = np.exp(logits - np.where(np.isfinite(largest), largest, 0.0))
    total = exponentials.sum(-1, keepdims=True)
    return np.where(total > 0, exponentials / np.where(total > 0, total, 1.0), np.nan)


def weighted_mean(logits: np.ndarray, means: np.ndarray) -> np.ndarray:
    """sum_k w_k mu_k, shape [..., D], from logits [..., K] and means [..., K, D]."""
    return np.einsum("...k,...kd->...d", weights(logits), means)


def marginal(means: np.ndarray, scale_tril: np.ndarray, dims: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Means [K, m] and covariances [K, m, m] of the components over some of the parameters."""
    chosen = list(dims)
    factor = scale_tril[:, chosen, :].astype(float)
    return means[:, chosen], factor @ np.swapaxes(factor, -1, -2)


def density(points: np.ndarray, weight: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Density of the mixture at points [..., m], in closed form; degenerate components are left out.

    Weights have shape [K], means [K, m], covariances [K, m, m].
    """
    total = np.zeros(points.shape[:-1])
    for w, mu, sigma in zip(weight, mean, covariance, strict=True):
        volume = np.linalg.det(2 * np.pi * sigma)
        if w <= 0 or volume <= 0:
            continue
        offset = points - mu
        squared = np.einsum("...i,ij,...j->...", offset, np.linalg.inv(sigma), offset)
        total += w * np.exp(-0.5 * squared) / np.sqrt(volume)
    return total


def grid(low: float, high: float, mean: np.ndarray, scale: np.ndarray, points: int = 180) -> np.ndarray:
    """Points over an interval, denser around the components, so that narrow peaks are resolved.

    `points` of them are evenly spaced; `mean` and `scale` are the components' along this axis, [K].
    """
    around = mean[:, None] + scale[:, None] * np.linspace(-3, 3, 13)
    every = np.concatenate([np.linspace(low, high, points), around[(around >= low) & (around <= high)]])
    # Cells far narrower than a pixel would cost time and be invisible.
    return np.unique(np.round((every - low) / (high - low), 5)) * (high - low) + low
