"""The error of a model in a measured signal, as a random process that is added to simulations in addition to noise.

Inference trusts its simulator: intervals are too narrow if the real machine has forces that the model lacks. A Gaussian
process on each signal describes how large the model's error may be, and for how long it lasts
(Kennedy and O'Hagan, 2001, doi:10.1111/1467-9868.00294); here an Ornstein-Uhlenbeck process.
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import scipy.fft
import scipy.linalg
from jaxtyping import Array, Float

_PERSISTS = np.exp(-1.0)
"""The autocorrelation of an Ornstein-Uhlenbeck process after its correlation time."""


@dataclasses.dataclass(frozen=True)
class Discrepancy:
    """An Ornstein-Uhlenbeck process.

    Attributes:
        deviation: its standard deviation, in the signal's unit.
        time: its correlation time, after which the autocorrelation has fallen to 1/e, in s.

    Raises:
        ValueError: for a negative or infinite deviation, and a time that is not positive and finite.
    """

    deviation: float
    time: float

    def __post_init__(self):
        if not (0 <= self.deviation < np.inf and 0 < self.time < np.inf):
            raise ValueError(
                "discrepancy: expected a standard deviation of at least 0 and a correlation time above 0 s, "
                f"got {self.deviation:g} and {self.time:g}"
            )

    def covariance(self, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time time"]:
        """Covariance of its values at some times."""
        return self.deviation**2 * np.exp(-np.abs(times[:, None] - times) / self.time)

    def form(self, times: Float[np.ndarray, " time"], rows: Float[np.ndarray, "time n"]) -> Float[np.ndarray, "n n"]:
        """`rows.T @ covariance(times) @ rows` for increasing times, without that matrix, as the process is Markov.

        Sums over earlier times are computed recursively, so that time and memory are linear in the number of times.
        """
        if not len(times):
            return np.zeros((rows.shape[1], rows.shape[1]))
        bands = np.ones((2, len(times)))
        bands[1, :-1], bands[1, -1] = -np.exp(-np.diff(times) / self.time), 0.0
        half = rows.T @ scipy.linalg.solve_banded((1, 0), bands, rows)
        return self.deviation**2 * (half + half.T - rows.T @ rows)

    def whitened(
        self, times: Float[np.ndarray, " time"], values: Float[np.ndarray, "*n time"], noise: float
    ) -> Float[np.ndarray, "*n time"]:
        """Values of the process plus white noise, whitened to independent numbers of variance 1.

        Each is the scaled innovation, which earlier values do not predict (Kalman 1960): `inv(L) @ values` with the
        lower Cholesky factor L of their covariance, without that matrix.

        Args:
            times: increasing, in s.
            values: in the signal's unit.
            noise: standard deviation of the white noise, above 0.
        """
        found, mean, variance = np.empty(np.shape(values)), np.zeros(np.shape(values)[:-1]), self.deviation**2
        keep = np.exp(-np.diff(times, prepend=times[:1]) / self.time)
        for t, decay in enumerate(keep):
            mean, variance = decay * mean, decay**2 * variance + (1 - decay**2) * self.deviation**2
            unknown, total = values[..., t] - mean, variance + noise**2
            found[..., t] = unknown / np.sqrt(total)
            mean, variance = mean + unknown * variance / total, variance * noise**2 / total
        return found

    def draws(self, rng: np.random.Generator, n: int, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, "n time"]:
        """Independent draws of its values at increasing times, exact for any intervals."""
        keep = np.exp(-np.diff(times) / self.time)
        values = rng.standard_normal((n, len(times)))
        for t, decay in enumerate(keep, start=1):
            values[:, t] = decay * values[:, t - 1] + np.sqrt(1 - decay**2) * values[:, t]
        return self.deviation * values

    def draw(self, key: jax.Array, times: Float[np.ndarray, " time"]) -> Float[Array, " time"]:
        """One such draw in JAX, which can be compiled and mapped."""
        keep = np.exp(-np.diff(times, prepend=-np.inf) / self.time)  # nothing precedes the first one

        def following(before, inputs):
            decay, fresh = inputs
            value = decay * before + jnp.sqrt(1 - decay**2) * fresh
            return value, value

        fresh = jax.random.normal(key, times.shape)
        _, values = jax.lax.scan(following, jnp.zeros_like(fresh[0]), (jnp.asarray(keep, fresh.dtype), fresh))
        return self.deviation * values


def estimated(residuals: Sequence[np.ndarray], times: Sequence[np.ndarray], noise: float) -> Discrepancy:
    """The process estimated from the autocovariance of a fit's residuals.

    Args:
        residuals: of a signal in each episode; NaN where there is no sample. Shape [T] each.
        times: of the samples, in s.
        noise: the standard deviation of white noise, which is not a discrepancy.
    """
    sampled = [np.isfinite(own) for own in residuals]
    several = [(own[here], when[here]) for own, when, here in zip(residuals, times, sampled, strict=True) if here.any()]
    gaps = np.concatenate([np.diff(when) for _, when in several]) if several else np.zeros(0)
    spacing = float(np.median(gaps)) if len(gaps) else 1.0
    covariances = _autocovariances([_on_grid(own, when, spacing) for own, when in several])
    variance = max(covariances[0] - noise**2, 0.0)
    fallen = np.flatnonzero(covariances[1:] < _PERSISTS * variance)
    lag = 1 + fallen[0] if len(fallen) else len(covariances)
    return Discrepancy(float(np.sqrt(variance)), float(lag * spacing))


def _on_grid(values: np.ndarray, times: np.ndarray, spacing: float) -> np.ndarray:
    """Values at equal intervals, NaN between samples."""
    rows = np.round((times - times[0]) / spacing).astype(int)
    grid = np.full(rows[-1] + 1, np.nan)
    grid[rows] = values
    return grid


def _autocovariances(episodes: Sequence[np.ndarray]) -> np.ndarray:
    """Autocovariances about zero at lags up to half of the longest episode, by Fourier transforms for speed."""
    lags = max([len(own) // 2 for own in episodes] + [1])
    sums, counts = np.zeros(lags), np.zeros(lags)
    for own in episodes:
        there = np.isfinite(own)
        for total, values in ((sums, np.where(there, own, 0.0)), (counts, there.astype(float))):
            padded = scipy.fft.next_fast_len(2 * len(own), real=True)
            products = scipy.fft.irfft(np.abs(scipy.fft.rfft(values, padded)) ** 2, padded)[: min(lags, len(own))]
            total[: len(products)] += products
    counts = np.round(counts)
    return np.divide(sums, counts, out=np.zeros(lags), where=counts > 0)
