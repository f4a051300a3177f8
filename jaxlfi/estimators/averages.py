"""A long summary through means of neighbouring numbers: what networks and linear regressions see of it.

Regressions on S numbers, of N simulations, take S^2 N operations where S < N, and mostly learn noise where S > N.
Neighbours in a series or a picture tell nearly the same, so their means tell nearly all. What they do not, as where a
signal is fast, is left to a linear model of each single number (`jaxlfi.estimators.inverse_regression`) and to the
statistics of the whole series, which take S N operations.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

MOST = 256
"""Numbers of a summary up to which all of it is seen, and means of a longer one at most."""
MOST_MODELLED = 1024
"""The same of the robust model (`jaxlfi.estimators.robust_estimates`), which takes S N operations, but many of them."""
WORTH = 2.0
"""How much evidence for a response counts as none, of what errors alone make on average."""
MOST_CHANNELS = 16
"""Channels, of a longer one: as many as statistics can be taken of."""


def seen_channels(obs: int, channels: int) -> int:
    """Channels that are left of C in a summary of S numbers."""
    return _count(channels, MOST_CHANNELS) if obs > MOST else channels


def seen_size(obs: int, channels: int, most: int = MOST) -> int:
    """Numbers that are left of a summary of S numbers in records of C."""
    if obs <= most:
        return obs
    few = _count(channels, MOST_CHANNELS)
    return _count(obs // channels, most // few) * few


def seen(x: Float[Array, "*n obs"], channels: int, most: int = MOST) -> Float[Array, "*n few"]:
    """The summary, or means of neighbours in records and channels where it is longer than that.

    Args:
        x: shape [..., S].
        channels: numbers C of a record.
        most: numbers that are left, at most.
    """
    obs = x.shape[-1]
    if obs <= most:
        return x
    records = _means(x.reshape(*x.shape[:-1], obs // channels, channels), -1, MOST_CHANNELS)
    return _means(records, -2, most // records.shape[-1]).reshape(*x.shape[:-1], -1)


def as_series(x: Float[Array, "*n obs"], channels: int) -> Float[Array, "*n time few"]:
    """All records of a summary, with means of neighbouring channels where it is long and has many."""
    series = x.reshape(*x.shape[:-1], -1, channels)
    return _means(series, -1, MOST_CHANNELS) if x.shape[-1] > MOST else series


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
    """Responses of each number to some standardised terms, with those taken back that errors alone would explain.

    Of thousands of numbers many tell nothing, and what they seem to tell by chance adds up. The positive part of the
    estimator of James and Stein (1961), for each number, takes back less of it (`WORTH` is about 1 there).

    Args:
        responses: shape [..., P, S].
        errors: standard deviation of each number's errors, shape [S].
        rows: that the responses were fitted to.
    """
    evidence = rows * jnp.sum(responses**2, axis=-2, keepdims=True) / errors**2  # P on average where there is none
    return responses * jnp.maximum(1 - WORTH * responses.shape[-2] / jnp.maximum(evidence, 1e-6), 0.0)
