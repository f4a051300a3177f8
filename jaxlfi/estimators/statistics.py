"""General statistics of a series: the spread, shape and memory of its raw numbers, in a few features."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

LEAST = 10
"""Smallest number of records of a series; shorter summaries have no statistics."""
LAGS = (1, 2, 3, 4, 5)
"""Lags of the autocorrelations, of the values and of their squared deviations."""
STEPS = (1, 2, 4, 8)
"""Lags of the differences: noise makes all of them equally large, a drift makes those of longer lags larger."""
RESIDUAL_SIZES = 3 + len(STEPS) + 1
"""Number of `residual_sizes` of a channel."""
FARTHEST = 3.0
"""Standard deviations at which residuals and their differences are clipped before they are squared."""
SMALLEST = 1e-3
"""Number added to the size of residuals, in standard deviations, so that zero has a finite logarithm."""
QUANTILES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
"""Levels of the quantiles."""
MOST_CHANNELS = 8
"""Largest number of channels for which each pair's correlation is a statistic."""


def statistics_size(records: int, channels: int) -> int:
    """Length of `statistics` for a series of T records of C channels; 0 if it is too short."""
    if records < LEAST:
        return 0
    pairs = channels * (channels - 1) // 2 if channels <= MOST_CHANNELS else 0
    return channels * (7 + len(STEPS) + 2 * len(LAGS) + len(QUANTILES)) + pairs


def statistics(series: Float[Array, "*n time channels"]) -> Float[Array, "*n stat"]:
    """Moments, memory and quantiles of each channel, and the correlation of each pair of channels.

    In this order, each for all channels: mean, log standard deviation, log root mean squares of differences (`STEPS`)
    and of second differences, log spreads of values and of differences by the mean root of their distances, which is
    robust to outliers, skewness, kurtosis, autocorrelations (`LAGS`), those of the squared deviations, which are all
    the memory that a series of varying volatility has (McLeod and Li 1983), quantiles (`QUANTILES`); then the
    correlations. Location and scale are removed before anything is squared, so that no unit overflows. For a constant
    channel the log of its last place replaces the log of zero, and undefined statistics are 0.

    Args:
        series: shape [..., T, C], T >= `LEAST`.

    Returns:
        Shape [..., M], M of `statistics_size`.
    """
    count, channels = series.shape[-2:]
    first = series[..., :1, :]
    low, high = jnp.min(series, axis=-2), jnp.max(series, axis=-2)
    last_place = jnp.finfo(series.dtype).eps * jnp.maximum(jnp.abs(low), jnp.abs(high))
    span = jnp.maximum(jnp.maximum(high - low, last_place), jnp.finfo(series.dtype).tiny)
    values = (series - first) / span[..., None, :]
    mean = jnp.mean(values, axis=-2)
    centred = values - mean[..., None, :]
    deviation = jnp.sqrt(jnp.mean(centred**2, axis=-2))
    varies = high - low > last_place
    floor = jnp.finfo(series.dtype).eps
    z = jnp.where(varies, 1 / jnp.maximum(deviation, floor), 0.0)[..., None, :] * centred
    log = lambda value: jnp.log(span) + jnp.log(jnp.maximum(value, floor))
    spread = lambda away: log(jnp.mean(jnp.sqrt(jnp.abs(away)), axis=-2) ** 2)
    size = lambda away: log(jnp.sqrt(jnp.mean(away**2, axis=-2)))
    differences = [values[..., lag:, :] - values[..., :-lag, :] for lag in STEPS]
    kurtosis = jnp.mean(z**4, axis=-2)
    squares = jnp.where(varies, 1 / jnp.sqrt(jnp.maximum(kurtosis - 1, floor)), 0.0)[..., None, :] * (z**2 - 1)
    ordered = jnp.sort(series, axis=-2)
    median = (ordered[..., count // 2, :] - first[..., 0, :]) / span
    places = [round(place * (count - 1)) for place in QUANTILES]
    parts = [
        first[..., 0, :] + span * mean,
        log(deviation),
        *map(size, differences),
        size(jnp.diff(differences[0], axis=-2)),
        spread(values - median[..., None, :]),
        spread(differences[0]),
        jnp.mean(z**3, axis=-2),
        kurtosis,
        *(jnp.mean(of[..., lag:, :] * of[..., :-lag, :], axis=-2) for of in (z, squares) for lag in LAGS),
        *(ordered[..., place, :] for place in places),
    ]
    if 1 < channels <= MOST_CHANNELS:
        one, other = np.triu_indices(channels, 1)
        parts.append(jnp.mean(z[..., one] * z[..., other], axis=-2))
    return jnp.concatenate(parts, axis=-1)


def residual_sizes(residuals: Float[Array, "*n time channels"]) -> Float[Array, "*n size"]:
    """Sizes of each channel's residuals, which measure the noise of a series whose signal changes faster.

    The differences of such a series are dominated by the signal, those of its residuals by the noise if a model of the
    numbers follows the signal. Otherwise, the signal that it misses changes less from one record to the next than noise
    does.

    In this order, each for all channels, as logarithms: medians of absolute values, of the residuals and of their
    differences, which are robust to outliers; root mean squares, clipped at `FARTHEST`, of the residuals, of
    differences (`STEPS`) and of second differences, which are more informative without outliers.

    Args:
        residuals: in standard deviations, shape [..., T, C], T >= `LEAST`.

    Returns:
        Shape [..., C * `RESIDUAL_SIZES`].
    """
    differences = [residuals[..., lag:, :] - residuals[..., :-lag, :] for lag in STEPS]
    usual = lambda away: jnp.log(jnp.median(jnp.abs(away), axis=-2) + SMALLEST)
    size = lambda away: 0.5 * jnp.log(jnp.mean(jnp.clip(away, -FARTHEST, FARTHEST) ** 2, axis=-2) + SMALLEST**2)
    squared = [residuals, *differences, jnp.diff(differences[0], axis=-2)]
    return jnp.concatenate([usual(residuals), usual(differences[0]), *map(size, squared)], axis=-1)


def first_statistics(channels: int) -> Int[np.ndarray, " stat"]:
    """Places of the statistics used by networks that were saved by earlier versions."""
    scales = 2 + len(STEPS) + 3
    lags = scales + 2 + np.arange(2 * len(LAGS))
    kept = np.r_[:3, scales : lags[len(LAGS)], lags[-1] + 1 + np.arange(len(QUANTILES))]
    each = (kept[:, None] * channels + np.arange(channels)).ravel()
    size = statistics_size(LEAST, channels)
    return np.r_[each, channels * (lags[-1] + 1 + len(QUANTILES)) : size]
