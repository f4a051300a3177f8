"""Means of neighbouring numbers of a long summary, as inputs of networks and linear regressions.

Regressions on S numbers of N simulations take S^2 N operations if S < N, and mostly learn noise if S > N. Neighbours in
a series or a picture are nearly redundant, so their means contain nearly all of the information. The rest, such as a
fast signal, is left to a linear model of each single number (`jaxlfi.estimators.inverse_regression`) and to the
statistics of the whole series, which take S N operations.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.tasks.summaries import LONG

MOST = 256
"""Largest number of means that replace a summary of more than `LONG` numbers."""
MOST_MODELLED = 1024
"""The same for the robust model (`jaxlfi.estimators.robust_estimates`): it takes S N operations, but many of them."""
NEIGHBOURS = 16
"""Number of neighbours from which it is estimated how much of their responses is due to chance."""
MOST_CHANNELS = 16
"""Largest number of channels kept of a long summary: each has dozens of statistics."""


def seen_channels(obs: int, channels: int) -> int:
    """Number of channels kept of C in a summary of S numbers."""
    return _count(channels, MOST_CHANNELS) if obs > LONG else channels


def seen_size(obs: int, channels: int, most: int = MOST) -> int:
    """Number of means kept of a summary of S numbers in records of C."""
    if obs <= max(most, LONG):
        return obs
    few = _count(channels, MOST_CHANNELS)
    return _count(obs // channels, most // few) * few


def seen(x: Float[Array, "*n obs"], channels: int, most: int = MOST) -> Float[Array, "*n few"]:
    """The summary; if it is too long, means over neighbouring channels and records.

    Args:
        x: shape [..., S].
        channels: numbers C of a record.
        most: largest number of means. A summary of up to `most` or `LONG` numbers stays as it is.
    """
    obs = x.shape[-1]
    if obs <= max(most, LONG):
        return x
    records = _means(x.reshape(*x.shape[:-1], obs // channels, channels), -1, MOST_CHANNELS)
    return _means(records, -2, most // records.shape[-1]).reshape(*x.shape[:-1], -1)


def as_series(x: Float[Array, "*n obs"], channels: int) -> Float[Array, "*n time few"]:
    """All records of a summary; if it is long and has many channels, means of neighbouring ones."""
    series = x.reshape(*x.shape[:-1], -1, channels)
    return _means(series, -1, MOST_CHANNELS) if x.shape[-1] > LONG else series


def _count(size: int, most: int) -> int:
    """Number of groups of neighbours; all but the last have the same size."""
    return -(-size // -(-size // most))


def _means(values: Array, axis: int, most: int) -> Array:
    """Means of neighbours along an axis, at most `most` of them."""
    size = values.shape[axis]
    each = -(-size // most)
    if each == 1:
        return values
    moved = jnp.moveaxis(values, axis, -1)
    count = _count(size, most)
    padded = jnp.pad(moved, [(0, 0)] * (moved.ndim - 1) + [(0, count * each - size)])
    there = np.minimum(each, size - each * np.arange(count))
    return jnp.moveaxis(padded.reshape(*moved.shape[:-1], count, each).sum(axis=-1) / there, -1, axis)


def shrunk(responses: Float[Array, "*n term few"], errors: Float[Array, " few"], rows: Array) -> Array:
    """Responses of each number to some standardised terms, shrunk by the share of them that errors explain.

    Of thousands of numbers many are uninformative, and their spurious responses add up. The share that is due to chance
    is estimated from `NEIGHBOURS` together, as a single number hardly determines it. If responses are normal, with one
    variance among neighbours, the results are the posterior means (Efron and Morris 1973).

    Args:
        responses: shape [..., P, S].
        errors: standard deviation of each number's errors, shape [S].
        rows: number of rows that the responses were fitted to.
    """
    few = responses.shape[-1]
    evidence = rows * jnp.mean(responses**2, axis=-2) / errors**2  # 1 on average where there is none
    groups = -(-few // NEIGHBOURS)
    together = jnp.repeat(_means(evidence, -1, groups), -(-few // groups), axis=-1)[..., :few]
    return responses * (1 - 1 / jnp.maximum(together, 1.0))[..., None, :]
