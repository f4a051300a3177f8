"""Discrepancies of a posterior from the truth."""

import functools

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.belief import RESTRICTIONS, Belief
from jaxlfi.simulation import summarised, trajectory_and_outcome
from jaxlfi.task import Task

POSTERIOR_SAMPLES = 20
"""Posterior samples a discrepancy is averaged over (section V)."""


@struct.dataclass
class Discrepancy:
    """How far draws of a belief, and their simulations, are from the truth and the observation.

    Attributes:
        theta: the draws, shape [N, D].
        theta_error: |theta - theta_gt| for each draw and parameter, shape [N, D]; NaN where the truth is unknown.
        trajectory_error: distance of each draw's trajectory from the observed one, shape [N]; NaN where it failed.
        trajectory: the simulated trajectories, shape [N, T, C].
        x: their summaries, shape [N, S]; NaN where the simulation failed or its summary is not finite.
    """

    theta: Float[Array, "*batch samples dim"]
    theta_error: Float[Array, "*batch samples dim"]
    trajectory_error: Float[Array, "*batch samples"]
    trajectory: Float[Array, "*shape"]
    x: Float[Array, "*batch samples obs"]


def discrepancy(
    key: jax.Array, task: Task, belief: Belief, observed: Array, restriction: str = "clip", n: int = POSTERIOR_SAMPLES
) -> Discrepancy:
    """Draw from a belief, simulate, and compare (section V).

    Where the posterior is a flow, the belief is the mixture fitted to it (`jaxlfi.posterior.posterior`), and so are the
    draws.

    Args:
        key: consumed.
        task: a task whose simulator is in JAX.
        belief: the mixture and the support its draws are kept in.
        observed: the real trajectory, shape [T, C] or [T].
        restriction: how draws are kept in the support.
        n: number of draws.
    """
    key_draw, key_simulate = jax.random.split(key)
    theta = RESTRICTIONS[restriction](key_draw, belief, n)
    simulate = jax.vmap(lambda key, theta: trajectory_and_outcome(task, key, theta))
    trajectory, failure = simulate(jax.random.split(key_simulate, n), theta)
    x, unusable = jax.vmap(functools.partial(summarised, task))(trajectory, failure)
    truth = jnp.full(task.dim, jnp.nan) if task.truth is None else task.truth
    error = jnp.where(failure == 0, jax.vmap(lambda t: trajectory_distance(t, observed))(trajectory), jnp.nan)
    x = jnp.where((unusable == 0)[:, None], x, jnp.nan)
    return Discrepancy(theta, jnp.abs(theta - truth), error, trajectory, x)


def trajectory_distance(trajectory: Array, observed: Array) -> Float[Array, ""]:
    """Euclidean distance of two trajectories in units of the observed one's spread, per record.

    Each channel is divided by its observed standard deviation, and the square root of the mean square is taken over
    records and channels: a distance of 1 is as far as the observed trajectory is from its own mean. The plain
    Euclidean distance that the paper names would make exp(-distance) zero for any two trajectories of a population.
    """
    observed = observed.reshape(observed.shape[0], -1)
    spread = jnp.std(observed, axis=0)
    scale = jnp.where(spread > 0, spread, 1.0)
    return jnp.sqrt(jnp.mean(((trajectory.reshape(observed.shape) - observed) / scale) ** 2))
