"""Algorithms 2, 3 and 4 of the paper, transcribed line by line: loops, ifs and float64, no JAX."""

import numpy as np
from scipy.special import ndtr


def mass_between(left, right, weights, means, scales) -> float:
    """Mass of a one-dimensional mixture in [left, right]."""
    total = 0.0
    for w, m, s in zip(weights, means, scales, strict=True):
        a, b = (left - m) / s, (right - m) / s
        total += w * (ndtr(b) - ndtr(a) if a < 0 else ndtr(-a) - ndtr(-b))
    return total


def expand(low, high, phi_low, phi_high, go_left, go_right, eta):
    """The last two ifs of Algorithms 2 and 3, with what their comments say about leaving Phi."""
    r = abs(high - low)
    new_low, new_high = low, high
    if go_left and phi_low <= low - eta * r <= phi_high:
        new_low = low - eta * r
    elif go_left:
        new_low = phi_low
    if go_right and phi_low <= high + eta * r <= phi_high:
        new_high = high + eta * r
    elif go_right:
        new_high = phi_high
    return new_low, new_high


def edge_threshold(low, high, weights, means, scales, tau, factor):
    """tau, times up to `factor` for a marginal as wide as a uniform distribution on the box, shape [D]."""
    found, tau, factor = np.zeros(len(low)), *(np.broadcast_to(v, len(low)) for v in (tau, factor))
    for d in range(len(low)):
        mean = sum(w * m for w, m in zip(weights, means[:, d], strict=True))
        variance = sum(w * (s**2 + (m - mean) ** 2) for w, m, s in zip(weights, means[:, d], scales[:, d], strict=True))
        share = min(variance / ((high[d] - low[d]) ** 2 / 12), 1.0)
        found[d] = (1 - share) * tau[d] + share * factor[d] * tau[d]
    return found


def edge(low, high, phi_low, phi_high, weights, means, scales, delta, tau, eta, zone_width=0.0, tail=1.0):
    """Algorithm 2; `delta` is a fraction of the width, `zone_width` is added to it (reading F), `tail` is reading G.

    `tau` has one value per dimension.

    Returns:
        theta_min, theta_max, M_L, M_R, each of shape [D].
    """
    dims = len(low)
    theta_min, theta_max, mass_left, mass_right = (np.zeros(dims) for _ in range(4))
    for d in range(dims):
        r = abs(high[d] - low[d])
        zone = delta * r + zone_width
        marginal = weights, means[:, d], scales[:, d]
        mass_left[d] = mass_between(low[d], low[d] + zone, *marginal)
        mass_left[d] += tail * mass_between(-np.inf, low[d], *marginal)
        mass_right[d] = mass_between(high[d] - zone, high[d], *marginal)
        mass_right[d] += tail * mass_between(high[d], np.inf, *marginal)
        theta_min[d], theta_max[d] = expand(
            low[d], high[d], phi_low[d], phi_high[d], mass_left[d] > tau[d], mass_right[d] > tau[d], eta
        )
    return theta_min, theta_max, mass_left, mass_right


def mode(low, high, phi_low, phi_high, weights, means, previous_means, nu, rho, tau, eta, i):
    """Algorithm 3 in iteration `i`.

    Returns:
        theta_min, theta_max, W_L, W_R, each of shape [D].
    """
    dims = len(low)
    theta_min, theta_max = np.array(low), np.array(high)
    weight_left, weight_right = np.zeros(dims), np.zeros(dims)
    d = 0
    while i > 0 and d < dims:
        r = abs(high[d] - low[d])
        for k in range(len(weights)):
            shift = means[k, d] - previous_means[k, d]
            z = (means[k, d] - low[d]) / r
            if shift < -nu and abs(z) < rho:
                weight_left[d] += weights[k]
            elif shift > nu and abs(1 - z) < rho:
                weight_right[d] += weights[k]
        theta_min[d], theta_max[d] = expand(
            low[d], high[d], phi_low[d], phi_high[d], weight_left[d] > tau, weight_right[d] > tau, eta
        )
        d += 1
    return theta_min, theta_max, weight_left, weight_right


def centre(low, high, phi_low, phi_high, weights, means):
    """Algorithm 4, then clipped to Phi (reading I).

    Returns:
        theta_min, theta_max, each of shape [D].
    """
    dims = len(low)
    theta_min, theta_max = np.zeros(dims), np.zeros(dims)
    for d in range(dims):
        r = abs(high[d] - low[d])
        mu = sum(w * m for w, m in zip(weights, means[:, d], strict=True))
        left, right = mu - r / 2, mu + r / 2
        if not phi_low[d] <= left <= phi_high[d]:
            left = phi_low[d]
            right = left + r
        if not phi_low[d] <= right <= phi_high[d]:
            right = phi_high[d]
            left = right - r
        theta_min[d], theta_max[d] = max(left, phi_low[d]), min(right, phi_high[d])
    return theta_min, theta_max
