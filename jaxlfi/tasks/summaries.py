"""Named summaries of a trajectory, the network's input."""

import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Summary = Callable[[Array], Array]
LONG = 512
"""Numbers of a summary beyond which estimators see means of neighbours (`jaxlfi.estimators.averages`)."""


def identity(trajectory: Float[Array, "..."]) -> Float[Array, " obs"]:
    """The trajectory itself, flattened."""
    return jnp.ravel(trajectory)


def series(trajectory: Float[Array, "time channels"]) -> Float[Array, " obs"]:
    """Means, variances and correlations of a time series, shape [4 C + C (C - 1) / 2]: nine numbers for two channels.

    In this order: the means; log(variance + 1), the variances with divisor T - 1; for each channel its autocorrelations
    at lags 1 and 2; the correlations of each pair of channels. Lagged products of the standardised series are summed
    and divided by T - 1. These are the summaries that Papamakarios and Murray (2016) use for predators and prey.

    A channel that never changes has undefined correlations. They are 0: it says nothing about the others or its own
    future, and the simulation is a valid one that inference must be able to use.

    Args:
        trajectory: shape [T, C], T >= 3.
    """
    count, channels = trajectory.shape
    start = trajectory[0]  # differences to it, so that a large offset costs no precision
    mean = jnp.mean(trajectory - start, axis=0)
    centred = trajectory - start - mean
    variance = jnp.sum(centred**2, axis=0) / (count - 1)
    constant = jnp.all(trajectory == trajectory[0], axis=0)
    variance = jnp.where(constant, 0.0, variance)
    standardised = centred * jnp.where(constant, 0.0, jax.lax.rsqrt(jnp.where(constant, 1.0, variance)))
    memory = [jnp.sum(standardised[lag:] * standardised[:-lag], axis=0) / (count - 1) for lag in (1, 2)]
    first, second = np.triu_indices(channels, 1)
    coupling = jnp.sum(standardised[:, first] * standardised[:, second], axis=0) / (count - 1)
    return jnp.concatenate([start + mean, jnp.log1p(variance), jnp.stack(memory, axis=-1).ravel(), coupling])


def series_of(trajectory: Float[Array, "time channels"], there: np.ndarray) -> Float[Array, " obs"]:
    """The same for a series with gaps: means are over existing records, and products over existing pairs.

    For a series without gaps, these are the numbers of `series`.

    Args:
        trajectory: shape [T, C]; what is missing may be any number.
        there: true where a number is not missing, shape [T, C].
    """
    count, channels = trajectory.shape
    there = np.asarray(there, bool).reshape(count, channels)
    records = np.maximum(there.sum(axis=0), 1)
    start = trajectory[np.argmax(there, axis=0), np.arange(channels)]
    offset = jnp.where(there, trajectory - start, 0.0)
    mean = jnp.sum(offset, axis=0) / records
    constant = jnp.all(jnp.where(there, offset == 0, True), axis=0)
    centred = jnp.where(there, offset - mean, 0.0)
    variance = jnp.where(constant, 0.0, jnp.sum(centred**2, axis=0) / np.maximum(records - 1, 1))
    standardised = centred * jnp.where(constant, 0.0, jax.lax.rsqrt(jnp.where(constant, 1.0, variance)))

    def mean_product(first: Array, second: Array, pairs: np.ndarray, of_all: int) -> Array:
        return jnp.sum(first * second, axis=0) / np.maximum(pairs.sum(axis=0), 1) * (of_all / (count - 1))

    memory = [
        mean_product(standardised[lag:], standardised[:-lag], there[lag:] & there[:-lag], count - lag) for lag in (1, 2)
    ]
    first, second = np.triu_indices(channels, 1)
    pairs = there[:, first] & there[:, second]
    coupling = mean_product(standardised[:, first], standardised[:, second], pairs, count)
    return jnp.concatenate([start + mean, jnp.log1p(variance), jnp.stack(memory, axis=-1).ravel(), coupling])


def cross_correlation(trajectory: Float[Array, "time columns"], actions: int) -> Float[Array, " obs"]:
    """Products of states and actions, moments of states: psi of section VI-F, shape [Ds Da + 2 Ds].

    In this order: the dot products <S_i, A_j> over time, j fastest; the means of the states; their standard deviations
    (what the paper writes as Var: docs/paper.md, reading L).

    Args:
        trajectory: states [T, Ds] followed by actions [T, Da], shape [T, Ds + Da].
        actions: Da, the number of columns at the end that are actions.

    Raises:
        ValueError: if that leaves no states or no actions.

    Example:
        >>> cross_correlation(jnp.array([[1.0, 2.0, 1.0], [3.0, 2.0, -1.0]]), actions=1).tolist()
        [-2.0, 0.0, 2.0, 2.0, 1.0, 0.0]
    """
    if not 0 < actions < trajectory.shape[-1]:
        raise ValueError(f"actions: expected some of the {trajectory.shape[-1]} columns, got {actions}")
    states, applied = jnp.split(trajectory, [trajectory.shape[-1] - actions], axis=-1)
    products = jnp.einsum("ti,tj->ij", states, applied)
    spread = states - states[0]  # differences to the first, so that a large offset costs no precision
    return jnp.concatenate([products.ravel(), states[0] + jnp.mean(spread, axis=0), jnp.std(spread, axis=0)])


def one_after_another(summary: Summary, trials: int, trajectory: Float[Array, "..."]) -> Float[Array, " obs"]:
    """The concatenated summaries of concatenated trials, shape [n S].

    Args:
        summary: of one trial.
        trials: number of trials, n.
        trajectory: shape [n T, ...].
    """
    return jnp.ravel(jax.vmap(summary)(trajectory.reshape(trials, -1, *trajectory.shape[1:])))


def layout(summary: Summary, trajectory: tuple[int, ...], size: int) -> tuple[int, ...]:
    """The shape of which a summary's vector is the flattening, row by row: what an embedding sees.

    Args:
        summary: of a task.
        trajectory: shape of its argument, [T, ...].
        size: length S of its result.

    Returns:
        [T, C] for the trajectory itself, and [S / C, C] for more than `LONG` numbers of some of its rows (a summary
        whose `of_rows` is true), whose neighbours must be of one channel; else S single numbers [S, 1]; with a first
        axis of trials if they are summarised one after another.

    Example:
        >>> layout(identity, (151, 2), 302), layout(series, (151, 2), 9)
        ((151, 2), (9, 1))
    """
    if summary is identity:
        return trajectory[0], size // trajectory[0]
    if isinstance(summary, functools.partial) and summary.func is one_after_another:
        one, trials = summary.args
        return trials, *layout(one, (trajectory[0] // trials, *trajectory[1:]), size // trials)
    if size > LONG and getattr(getattr(summary, "func", summary), "of_rows", False):
        channels = math.prod(trajectory[1:])
        return size // channels, channels
    return size, 1


SUMMARIES: dict[str, Summary] = {"identity": identity, "series": series}
"""Summaries by name; each maps one trajectory to a vector [S]."""


def named(name: str) -> Summary:
    """The summary of that name.

    Raises:
        ValueError: for a name that is not in `SUMMARIES`.
    """
    if name not in SUMMARIES:
        raise ValueError(f"summary: expected one of {sorted(SUMMARIES)}, got {name!r}")
    return SUMMARIES[name]
