"""A long summary through means of neighbouring numbers: what networks and linear regressions see of it.

Regressions on S numbers, of N simulations, take S^2 N operations where S < N, and mostly learn noise where S > N.
Neighbours in a series or a picture tell nearly the same, so their means tell nearly all. What they do not, as where a
signal is fast, is left to a linear model of each single number (`jaxlfi.estimators.inverse_regression`) and to the
statistics of the whole series, which take S N operations.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.tasks.summaries import LONG

MOST = 256
"""Means that are seen of a summary of more than `LONG` numbers, at most."""
MOST_MODELLED = 1024
"""The same for the robust model (`jaxlfi.estimators.robust_estimates`): it takes S N operations, but many of them."""
NEIGHBOURS = 16
"""Numbers that tell together how much of their responses is chance."""
MOST_CHANNELS = 16
"""Channels of its records, at most: each has dozens of statistics."""


def seen_channels(obs: int, channels: int) -> int:
    """Channels that are left of C in a summary of S numbers."""
    return _count(channels, MOST_CHANNELS) if obs > LONG else channels


def seen_size(obs: int, channels: int, most: int = MOST) -> int:
    """Numbers that are left of a summary of S numbers in records of C."""
    if obs <= max(most, LONG):
        return obs
    few = _count(channels, MOST_CHANNELS)
    return _count(obs // channels, most // few) * few


def seen(x: Float[Array, "*n obs"], channels: int, most: int = MOST) -> Float[Array, "*n few"]:
    """The summary, or means of neighbours in channels and records of one that is too long.

    Args:
        x: shape [..., S].
        channels: numbers C of a record.
        most: means that are left, at most. It is not too long with as many numbers, nor with `LONG`.
    """
    obs = x.shape[-1]
    if obs <= max(most, LONG):
        return x
    records = _means(x.reshape(*x.shape[:-1], obs // channels, channels), -1, MOST_CHANNELS)
    return _means(records, -2, most // records.shape[-1]).reshape(*x.shape[:-1], -1)


def as_series(x: Float[Array, "*n obs"], channels: int) -> Float[Array, "*n time few"]:
    """All records of a summary, with means of neighbouring channels where it is long and has many."""
    series = x.reshape(*x.shape[:-1], -1, channels)
    return _means(series, -1, MOST_CHANNELS) if x.shape[-1] > LONG else series


def _count(size: int, most: int) -> int:
    """Groups of neighbours, all of one size but the last."""
    return -(-size // -(-size // most))


def _means(values: Array, axis: int, most: int) -> Array:
    """Of neighbours along an axis, so that at most so many are left."""
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
    """Responses of each number to some standardised terms, by as much smaller as errors explain of them.

    Of thousands of numbers many tell nothing, and what they seem to tell by chance adds up. How much that is, is
    estimated from `NEIGHBOURS` together: a number by itself says little of how much of its response is chance. With
    normal responses of one size among neighbours, these are the posterior means (Efron and Morris 1973).

    Args:
        responses: shape [..., P, S].
        errors: standard deviation of each number's errors, shape [S].
        rows: that the responses were fitted to.
    """
    few = responses.shape[-1]
    evidence = rows * jnp.mean(responses**2, axis=-2) / errors**2  # 1 on average where there is none
    groups = -(-few // NEIGHBOURS)
    together = jnp.repeat(_means(evidence, -1, groups), -(-few // groups), axis=-1)[..., :few]
    return responses * (1 - 1 / jnp.maximum(together, 1.0))[..., None, :]
