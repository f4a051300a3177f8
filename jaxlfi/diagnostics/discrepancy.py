"""Discrepancies of a posterior from the truth and from the observation (section V)."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from jaxlfi.tasks.gaps import gaps_of
from jaxlfi.tasks.simulation import summarised, trajectory_and_outcome
from jaxlfi.tasks.task import Task

POSTERIOR_SAMPLES = 20
"""Number of posterior draws that a discrepancy is averaged over (section V)."""


class Discrepancy(struct.PyTreeNode):
    """Distances of posterior draws from the truth, and of their simulations from the observation.

    Attributes:
        theta: the draws in inference space, shape [N, D].
        theta_error: |theta - theta_gt| for each draw and parameter, shape [N, D]; NaN where the truth is unknown.
        trajectory_error: distance of each draw's trajectory from the observed one, shape [N]; NaN where it failed or
            was not simulated.
        trajectory: the simulated trajectories, shape [N, T, C].
        x: their summaries, shape [N, S]; NaN where the simulation failed or its summary is not finite.
        simulated: number of simulations made, shape [].
    """

    theta: Float[Array, "*batch samples dim"]
    theta_error: Float[Array, "*batch samples dim"]
    trajectory_error: Float[Array, "*batch samples"]
    trajectory: Float[Array, "*shape"]
    x: Float[Array, "*batch samples obs"]
    simulated: Int[Array, "*batch"]


def discrepancy(key: jax.Array, task: Task, theta: Float[Array, "samples dim"], observed: Array) -> Discrepancy:
    """Simulate posterior draws, and compare them with truth and observation (section V).

    Args:
        key: consumed.
        task: a task whose simulator is in JAX.
        theta: draws of the posterior, in inference space, shape [N, D].
        observed: the real trajectory, shape [T, C] or [T].
    """
    keys = jax.random.split(key, len(theta))
    trajectory, failure = jax.vmap(lambda key, theta: trajectory_and_outcome(task, key, theta))(keys, theta)
    x, failure = jax.vmap(lambda *one: summarised(task, *one))(trajectory, failure)
    return compared(task, theta, trajectory, x, failure, observed)


def compared(
    task: Task,
    theta: Float[Array, "samples dim"],
    trajectory: Array | np.ndarray,
    x: Float[Array | np.ndarray, "samples obs"],
    failure: Int[Array | np.ndarray, " samples"],
    observed: Array | np.ndarray,
) -> Discrepancy:
    """Simulations of posterior draws, compared with truth and observation.

    Args:
        task: for the truth.
        theta: the draws in inference space, shape [N, D].
        trajectory: of each, shape [N, ...].
        x: their summaries, shape [N, S].
        failure: 0 where the simulation succeeded and its summary is finite, shape [N].
        observed: the real trajectory.
    """
    # Subtract before rounding: trajectories from the host are in double precision.
    missing = gaps_of(task)
    first = observed[:1] if missing is None else 0.0
    difference, spread = jnp.asarray(trajectory - observed), jnp.asarray(observed - first)
    distance = _distance if missing is None else functools.partial(_distance_between_gaps, missing)
    noise = 0.0 if task.channel_noise is None else task.channel_noise
    error = jnp.where(failure == 0, jax.vmap(lambda one: distance(one, spread, noise))(difference), jnp.nan)
    x = jnp.where((failure == 0)[:, None], x, jnp.nan)
    return Discrepancy(theta, _theta_error(task, theta), error, jnp.asarray(trajectory), x, jnp.asarray(len(theta)))


def not_simulated(
    task: Task, theta: Float[Array, "samples dim"], observed: Array | np.ndarray, obs: int
) -> Discrepancy:
    """A discrepancy from the truth alone: nothing is simulated, and what needs simulations is NaN."""
    unknown = lambda *shape: jnp.full((len(theta), *shape), jnp.nan)
    return Discrepancy(
        theta, _theta_error(task, theta), unknown(), unknown(*observed.shape), unknown(obs), jnp.asarray(0)
    )


def _theta_error(task: Task, theta: Float[Array, "samples dim"]) -> Float[Array, "samples dim"]:
    truth = task.inference.truth
    return jnp.abs(theta - (jnp.nan if truth is None else truth))


def trajectory_distance(
    trajectory: Array, observed: Array, noise: Float[Array | np.ndarray, " channels"] | float = 0.0
) -> Float[Array, ""]:
    """Euclidean distance between two trajectories in units of the observed one's standard deviation, per record.

    The root of the mean square of `channel_errors`: a distance of 1 is as far as the observed trajectory is from its
    own mean. The plain Euclidean distance that the paper names would make exp(-distance) zero for any two trajectories
    of a population.

    Raises:
        ValueError: for trajectories of different shapes.
    """
    return _distance(*_compared(trajectory, observed), noise)


def channel_errors(
    trajectory: Array, observed: Array, noise: Float[Array | np.ndarray, " channels"] | float = 0.0
) -> Float[Array, " channels"]:
    """Root mean square difference between two trajectories in each channel, shape [C].

    Args:
        trajectory: shape [T, C] or [T].
        observed: the same shape.
        noise: standard deviation of the measurement noise of each channel, shape [C], or of all.

    Returns:
        Differences in units of the channel's observed standard deviation, or of its noise if that is larger, so that a
        channel that hardly moves does not count more than one that is known as well; unscaled if both are 0.

    Raises:
        ValueError: for trajectories of different shapes.

    Example:
        >>> observed = jnp.stack([jnp.arange(4.0), jnp.zeros(4)], axis=1)
        >>> [round(float(e), 2) for e in channel_errors(observed + 0.1, observed, noise=jnp.array([0.1, 0.1]))]
        [0.09, 1.0]
    """
    difference, spread = _compared(trajectory, observed)
    return jnp.sqrt(jnp.mean((difference / _scale(jnp.std(spread, axis=0), noise)) ** 2, axis=0))


def _compared(trajectory: Array, observed: Array) -> tuple[Array, Array]:
    """The difference of two trajectories, and the observed one minus its first record, shape [T, C] each."""
    if trajectory.size != observed.size or trajectory.shape[:1] != observed.shape[:1]:
        raise ValueError(
            f"trajectory, observed: expected the same shapes, got {list(trajectory.shape)} and {list(observed.shape)}"
        )
    difference, spread = trajectory.reshape(observed.shape) - observed, observed - observed[:1]
    return jnp.asarray(difference.reshape(len(observed), -1)), jnp.asarray(spread.reshape(len(observed), -1))


def _scale(deviation: Array, noise: Array | np.ndarray | float) -> Array:
    """Units of the errors of channels."""
    largest = jnp.maximum(deviation, noise)
    return jnp.where(largest > 0, largest, 1.0)


def _distance(difference: Array, spread: Array, noise: Array | np.ndarray | float) -> Float[Array, ""]:
    """The same from the difference, and the observed trajectory minus its first record."""
    spread = spread.reshape(len(spread), -1)
    return jnp.sqrt(jnp.mean((difference.reshape(spread.shape) / _scale(jnp.std(spread, axis=0), noise)) ** 2))


def _distance_between_gaps(
    missing: np.ndarray, difference: Array, spread: Array, noise: Array | np.ndarray | float
) -> Float[Array, ""]:
    """The same over the numbers that are not missing."""
    there = ~missing.reshape(len(missing), -1)
    spread, difference = (jnp.where(there, values.reshape(there.shape), 0.0) for values in (spread, difference))
    scale = _scale(jnp.std(spread, axis=0, where=there), noise)
    return jnp.sqrt(jnp.mean((difference / scale) ** 2, where=there))
