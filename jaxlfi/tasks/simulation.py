"""Simulating a batch of parameters, with every failure counted by its reason."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.tasks.task import Task


@struct.dataclass
class Simulations:
    """The simulations of one round, in the order of their attempt.

    Attributes:
        theta: parameters in coordinates, shape [A, D].
        x: summaries, shape [A, S]; zero where failed.
        failure: 0 for success, else the code of the reason (`Task.reasons`), shape [A].
        counted: which simulations count as attempted, shape [A]: those up to the last one needed.
        kept: which are added to the dataset, shape [A].
    """

    theta: Float[Array, "*batch attempts dim"]
    x: Float[Array, "*batch attempts obs"]
    failure: Int[Array, "*batch attempts"]
    counted: Bool[Array, "*batch attempts"]
    kept: Bool[Array, "*batch attempts"]

    @property
    def attempted(self) -> Int[Array, "*batch"]:
        """Number of simulations attempted."""
        return jnp.sum(self.counted, axis=-1)

    @property
    def succeeded(self) -> Int[Array, "*batch"]:
        """Number of simulations added to the dataset."""
        return jnp.sum(self.kept, axis=-1)

    def failed(self, reasons: int) -> Int[Array, "*batch reason"]:
        """Number of counted failures for each of the reasons, in the order of their codes from 1."""
        codes = jnp.arange(1, reasons + 1)
        return jnp.sum((self.failure[..., None] == codes) & self.counted[..., None], axis=-2)


def trajectory_and_outcome(task: Task, key: jax.Array, theta: Float[Array, " dim"]) -> tuple[Array, Int[Array, ""]]:
    """One simulation at coordinates theta: its trajectory and 0, or the code of the reason it failed for."""
    result = task.simulate(key, task.to_natural(theta))
    trajectory, outcome = result if isinstance(result, tuple) else (result, jnp.asarray(0))
    return with_outcome(task, jnp.asarray(trajectory), jnp.asarray(outcome))


def with_outcome(task: Task, trajectory: Array, outcome: Array) -> tuple[Array, Int[Array, ""]]:
    """Turn what a simulator says of one trajectory into a failure code; non-finite numbers are a failure too."""
    failure = jnp.where(outcome, 0, 1) if outcome.dtype == bool else outcome
    # A code that stands for no reason is still a failure, and must be counted as one.
    failure = jnp.where((failure < 0) | (failure > len(task.failures)), 1, failure)
    finite = jnp.all(jnp.isfinite(trajectory))
    failure = jnp.where((failure == 0) & ~finite, len(task.reasons), failure).astype(jnp.int32)
    return trajectory.astype(jnp.float32), failure


def summarised(task: Task, trajectory: Array, failure: Int[Array, ""]) -> tuple[Float[Array, " obs"], Int[Array, ""]]:
    """The summary of one trajectory; one that is not finite turns a success into the failure "non_finite"."""
    x = task.summary(jnp.where(failure == 0, trajectory, jnp.ones_like(trajectory)))
    broken = (failure == 0) & ~jnp.all(jnp.isfinite(x))
    failure = jnp.where(broken, len(task.reasons), failure)
    return jnp.where(failure == 0, x, 0.0), failure


def simulate(
    key: jax.Array, task: Task, theta: Float[Array, "attempts dim"]
) -> tuple[Float[Array, "attempts obs"], Int[Array, " attempts"]]:
    """Simulate every row of theta: summaries [A, S] and failure codes [A]."""

    def one(key, theta):
        return summarised(task, *trajectory_and_outcome(task, key, theta))

    return jax.vmap(one)(jax.random.split(key, theta.shape[0]), theta)


def within_budget(
    theta: Float[Array, "attempts dim"],
    x: Float[Array, "attempts obs"],
    failure: Int[Array, " attempts"],
    simulations_per_round: Int[Array, ""] | int,
) -> Simulations:
    """Keep the first successes; what was drawn after the last one needed does not count as attempted.

    Args:
        theta: proposals in the order they are attempted, shape [A, D]; A is the budget of attempts.
        x: summaries, shape [A, S].
        failure: failure codes, shape [A].
        simulations_per_round: how many simulations a round adds at most.
    """
    success = failure == 0
    so_far = jnp.cumsum(success)
    kept = success & (so_far <= simulations_per_round)
    # The attempt after the last needed success would not have been made.
    counted = so_far - success < simulations_per_round
    return Simulations(theta=theta, x=x, failure=failure, counted=counted, kept=kept)
