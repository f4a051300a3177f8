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
    """How far draws of a posterior, and their simulations, are from the truth and the observation.

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
    # A difference is taken before it is rounded: trajectories from the host are in double precision.
    missing = gaps_of(task)
    first = observed[:1] if missing is None else 0.0
    difference, spread = jnp.asarray(trajectory - observed), jnp.asarray(observed - first)
    distance = _distance if missing is None else functools.partial(_distance_between_gaps, missing)
    error = jnp.where(failure == 0, jax.vmap(lambda one: distance(one, spread))(difference), jnp.nan)
    x = jnp.where((failure == 0)[:, None], x, jnp.nan)
    return Discrepancy(theta, _theta_error(task, theta), error, jnp.asarray(trajectory), x, jnp.asarray(len(theta)))


def not_simulated(
    task: Task, theta: Float[Array, "samples dim"], observed: Array | np.ndarray, obs: int
) -> Discrepancy:
    """A discrepancy from the truth alone: nothing is simulated, and what simulations would tell is NaN."""
    unknown = lambda *shape: jnp.full((len(theta), *shape), jnp.nan)
    return Discrepancy(
        theta, _theta_error(task, theta), unknown(), unknown(*observed.shape), unknown(obs), jnp.asarray(0)
    )


def _theta_error(task: Task, theta: Float[Array, "samples dim"]) -> Float[Array, "samples dim"]:
    truth = task.inference.truth
    return jnp.abs(theta - (jnp.nan if truth is None else truth))


def trajectory_distance(trajectory: Array, observed: Array) -> Float[Array, ""]:
    """Euclidean distance of two trajectories in units of the observed one's standard deviation, per record.

    Each channel is divided by its observed standard deviation, and the square root of the mean square is taken over
    records and channels: a distance of 1 is as far as the observed trajectory is from its own mean. The plain
    Euclidean distance that the paper names would make exp(-distance) zero for any two trajectories of a population.

    Raises:
        ValueError: for trajectories of different shapes.
    """
    if trajectory.size != observed.size or trajectory.shape[:1] != observed.shape[:1]:
        raise ValueError(
            f"trajectory, observed: expected the same shapes, got {list(trajectory.shape)} and {list(observed.shape)}"
        )
    return _distance(trajectory.reshape(observed.shape) - observed, observed - observed[:1])


def _distance(difference: Array, spread: Array) -> Float[Array, ""]:
    """The same from the difference, and the observed trajectory less its first record."""
    spread = spread.reshape(len(spread), -1)
    deviation = jnp.std(spread, axis=0)
    scale = jnp.where(deviation > 0, deviation, 1.0)
    return jnp.sqrt(jnp.mean((difference.reshape(spread.shape) / scale) ** 2))


def _distance_between_gaps(missing: np.ndarray, difference: Array, spread: Array) -> Float[Array, ""]:
    """The same of what is not missing."""
    there = ~missing.reshape(len(missing), -1)
    spread, difference = (jnp.where(there, values.reshape(there.shape), 0.0) for values in (spread, difference))
    deviation = jnp.std(spread, axis=0, where=there)
    scale = jnp.where(deviation > 0, deviation, 1.0)
    return jnp.sqrt(jnp.mean((difference / scale) ** 2, where=there))
