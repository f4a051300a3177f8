"""Simulating a batch of parameters, with every failure counted by its reason."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.distributions.precision import own, single
from jaxlfi.tasks import own_arrays
from jaxlfi.tasks.dispatch import stacked
from jaxlfi.tasks.host import numpy_generator
from jaxlfi.tasks.journal import Journal
from jaxlfi.tasks.reference import counted_from, summaries_in_double
from jaxlfi.tasks.task import Task


class Simulations(struct.PyTreeNode):
    """The simulations of one round, in the order of their attempt.

    Attributes:
        theta: parameters in inference space, shape [A, D].
        x: summaries, shape [A, S]; zero where failed.
        failure: 0 for success, else the code of the reason (`Task.reasons`), shape [A].
        counted: which simulations count as attempted, shape [A]: those up to the last one needed.
        kept: which are added to the dataset, shape [A].
        weight: of each in the loss, shape [A]: 1 for simulations drawn by the run itself.
    """

    theta: Float[Array, "*batch attempts dim"]
    x: Float[Array | np.ndarray, "*batch attempts obs"]
    failure: Int[Array, "*batch attempts"]
    counted: Bool[Array, "*batch attempts"]
    kept: Bool[Array, "*batch attempts"]
    weight: Float[Array, "*batch attempts"]

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


def trajectory_and_outcome(
    task: Task,
    key: jax.Array,
    theta: Float[Array | np.ndarray, " dim"],
    simulate: Callable[[jax.Array, Array], Any] | None = None,
) -> tuple[Array, Int[Array, ""]]:
    """One simulation at theta [D] in inference space: its trajectory, and 0 or the code of the reason why it failed.

    A given simulator replaces the task's own, for example for another design.
    """
    natural = task.space.to_natural(theta)
    with own():
        result = (simulate or task.simulate)(key, jnp.asarray(natural, float))
        trajectory, outcome = result if isinstance(result, tuple) else (result, jnp.asarray(0))
        trajectory, outcome = jnp.asarray(trajectory).astype(jnp.float32), _code(jnp.asarray(outcome))
    return with_outcome(task, trajectory, outcome)


def _code(outcome: Array) -> Array:
    """An outcome in 32 bits, clipped so that no large number becomes a small one."""
    if outcome.dtype.itemsize < 8:
        return outcome
    least = -1 if jnp.issubdtype(outcome.dtype, jnp.signedinteger) else 0
    return jnp.clip(outcome, least, own_arrays.CODES).astype("int32")


def with_outcome(task: Task, trajectory: Array, outcome: Array) -> tuple[Array, Int[Array, ""]]:
    """Turn a simulator's outcome of one trajectory into a failure code; non-finite numbers are a failure, too."""
    trajectory = trajectory.astype(jnp.float32)
    return trajectory, failure_code(task, jnp.all(jnp.isfinite(trajectory)), outcome)


def failure_code(task: Task, finite: Any, outcome: Any, numpy: Any = jnp) -> Any:
    """The code of the reason why a simulation failed, 0 for success.

    It depends on the simulator's outcome and on whether its trajectory is finite; `numpy` is NumPy or JAX's.
    """
    failure = numpy.where(outcome, 0, 1) if outcome.dtype == bool else outcome
    # The simulator's own reasons, from -1 downwards, come after the task's (`HostSimulator.reasons`).
    named, others = len(task.failures), len(task.reasons) - len(task.failures) - 1
    # A code that stands for no reason is still a failure, and must be counted as one.
    failure = numpy.where((failure < -others) | (failure > named), 1, failure)
    failure = numpy.where(failure < 0, named - failure, failure)
    return numpy.where((failure == 0) & ~finite, len(task.reasons), failure).astype(numpy.int32)


def summarised(task: Task, trajectory: Array, failure: Int[Array, ""]) -> tuple[Float[Array, " obs"], Int[Array, ""]]:
    """The summary of one trajectory; one that is not finite turns a success into the failure "non_finite"."""
    seen = jnp.where(failure == 0, trajectory, jnp.ones_like(trajectory))
    with own():
        x = task.summary(seen).astype(jnp.float32)
    broken = (failure == 0) & ~jnp.all(jnp.isfinite(x))
    failure = jnp.where(broken, len(task.reasons), failure)
    return jnp.where(failure == 0, x, 0.0), failure


def simulate(
    key: jax.Array, task: Task, theta: Float[Array, "attempts dim"]
) -> tuple[Float[Array, "attempts obs"], Int[Array, " attempts"]]:
    """Simulate every row of theta inside a compiled program: summaries [A, S] and failure codes [A]."""

    def one(key, theta):
        return summarised(task, *trajectory_and_outcome(task, key, theta))

    return jax.vmap(one)(jax.random.split(key, theta.shape[0]), theta)


def within_budget(
    theta: Float[Array, "attempts dim"],
    x: Float[Array, "attempts obs"],
    failure: Int[Array, " attempts"],
    simulations_per_round: Int[Array, ""] | int,
) -> Simulations:
    """Keep the first successes; what follows the last one needed does not count as attempted.

    Args:
        theta: proposals in the order they are attempted, shape [A, D]; A is the budget of attempts.
        x: summaries, shape [A, S].
        failure: failure codes, shape [A].
        simulations_per_round: largest number of simulations that a round adds.
    """
    success = failure == 0
    so_far = jnp.cumsum(success)
    kept = success & (so_far <= simulations_per_round)
    # The attempt after the last needed success would not have been made.
    counted = so_far - success < simulations_per_round
    return Simulations(theta, x, failure, counted, kept, weight=jnp.ones(theta.shape[0]))


def simulate_batch(
    key: jax.Array,
    task: Task,
    theta: Float[Array, "n dim"],
    shape: Sequence[int],
    wanted: Bool[np.ndarray, " n"] | None = None,
    journal: Journal | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Simulate every row of theta outside compiled programs, by a simulator in JAX or on the host.

    Args:
        key: consumed.
        task: the task.
        theta: in inference space, shape [N, D].
        shape: of a trajectory.
        wanted: rows that are needed, shape [N]; all by default. A simulator on the host is called only for these.
        journal: of simulations that are made one by one.

    Returns:
        Trajectories [N, ...], summaries [N, S] (zero where failed) and failure codes [N], 0 for success; of a simulator
        on the host in double precision.

    Raises:
        SimulatorError: from a host simulator that breaks its contract.
    """
    if task.on_host:
        rows = np.ones(len(theta), bool) if wanted is None else wanted
        trajectories, outcomes = np.zeros((len(theta), *shape)), np.ones(len(theta), int)
        natural = np.asarray(task.space.to_natural(theta))
        trajectories[rows], outcomes[rows] = _on_host(task, key, natural, shape, rows, journal)
        return trajectories, *summarised_batch(task, trajectories, outcomes)
    return jax.device_get(_simulate_batch(task, jax.random.split(key, len(theta)), theta))


def _on_host(task: Task, key: jax.Array, natural: np.ndarray, shape: Sequence[int], rows: np.ndarray, journal):
    """Trajectories and outcomes of some rows of parameters in natural units."""
    if not task.simulate.each:
        return task.simulate.batch(key, natural[rows], shape)
    return stacked(task.simulate.some(key, natural, shape, np.flatnonzero(rows), journal=journal), shape)


@functools.partial(jax.jit, static_argnums=0)
@single
def _simulate_batch(task: Task, keys: jax.Array, theta: Array):
    def one(key, theta):
        trajectory, failure = trajectory_and_outcome(task, key, theta)
        return trajectory, *summarised(task, trajectory, failure)

    return jax.vmap(one)(keys, theta)


def summarised_batch(task: Task, trajectories: np.ndarray, outcomes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Summaries [N, S] of a host simulator's results, in double precision and zero where failed, and failure codes [N].

    Numbers that single precision cannot hold count as not finite.
    """
    finite = lambda values: np.isfinite(_rounded(values)).reshape(len(values), -1).all(axis=1)
    failure = failure_code(task, finite(trajectories), outcomes, np)
    valid = (failure == 0).reshape(-1, *[1] * (trajectories.ndim - 1))
    x = summaries_in_double(task, np.where(valid, trajectories, 1.0))
    failure = np.where((failure == 0) & ~finite(x), len(task.reasons), failure)
    return np.where((failure == 0)[:, None], x, 0.0), failure


def _rounded(values: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def simulate_in_waves(
    key: jax.Array,
    task: Task,
    theta: Float[Array, "attempts dim"],
    wanted: int,
    shape: Sequence[int],
    journal: Journal | None = None,
    reference: np.ndarray | None = None,
) -> Simulations:
    """Simulate on the host, in the order of theta, until enough have succeeded or all are spent.

    The simulator is called for as many parameter vectors as are wanted, then for as many as failed, and so on: nothing
    is simulated that is not needed. Simulations that are made one by one are begun as others fail; only summaries that
    are not finite need another wave.

    Args:
        key: seeds the simulator's generator, or with its place that of each simulation.
        task: one whose simulator runs on the host.
        theta: proposals in inference space, shape [A, D].
        wanted: number of successes.
        shape: of a trajectory.
        journal: of simulations that are made one by one.
        reference: subtracted from summaries, shape [S] (`jaxlfi.tasks.reference`); by default nothing is.
    """
    natural = np.asarray(task.space.to_natural(theta))
    budget, each = len(natural), task.simulate.each
    trajectories = np.zeros((budget, *shape))
    outcomes = np.full(budget, 1)  # what was not attempted has not succeeded
    rng = None if each else numpy_generator(key)
    done, successes = 0, 0
    while done < budget and successes < wanted:
        if each:
            answers = task.simulate.some(key, natural, shape, range(done, budget), wanted - successes, journal)
            wave = slice(done, done + len(answers))
            trajectories[wave], outcomes[wave] = stacked(answers, shape)
        else:
            wave = slice(done, min(budget, done + wanted - successes))
            trajectories[wave], outcomes[wave] = task.simulate.batch(rng, natural[wave], shape)
        x, failure = summarised_batch(task, trajectories, outcomes)
        done = wave.stop
        successes = int(np.sum(failure[:done] == 0))
    x = np.where((failure == 0)[:, None], counted_from(reference, x), 0.0).astype(np.float32)
    return within_budget(jnp.asarray(theta), jnp.asarray(x), jnp.asarray(failure), wanted)
