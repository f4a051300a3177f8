"""Truths: parameters drawn over the reference support, each with a simulation."""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.bayessim.algorithm import algorithm as bayessim
from jaxlfi.bayessim.algorithm import host as black_box
from jaxlfi.studies.calibration.subject import TRUTHS, Plan, Subject
from jaxlfi.tasks.observation import SimulatorError, numpy_generator
from jaxlfi.tasks.simulation import summarised, trajectory_and_outcome, with_outcome
from jaxlfi.tasks.task import Task

TRIES = 16
"""Draws of a truth whose simulations may fail before it is given up."""


def simulate(
    key: jax.Array, task: Task, theta: jax.Array, shape: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Simulate every row of theta, in JAX or by a black box.

    Args:
        key: consumed.
        task: the task.
        theta: in coordinates, shape [N, D].
        shape: of a trajectory.

    Returns:
        Trajectories [N, ...], summaries [N, S] (zero where failed) and failure codes [N], 0 for success.
    """
    if task.black_box:
        called = black_box.call(task, numpy_generator(key), np.asarray(task.to_natural(theta)), shape)
        return jax.device_get(_told(task, *(jnp.asarray(array) for array in called)))
    return jax.device_get(_simulated(task, jax.random.split(key, len(theta)), theta))


@functools.partial(jax.jit, static_argnums=0)
def _simulated(task: Task, keys: jax.Array, theta: jax.Array):
    return jax.vmap(lambda key, theta: _summarised(task, *trajectory_and_outcome(task, key, theta)))(keys, theta)


@functools.partial(jax.jit, static_argnums=0)
def _told(task: Task, trajectories: jax.Array, outcomes: jax.Array):
    return jax.vmap(lambda *one: _summarised(task, *with_outcome(task, *one)))(trajectories, outcomes)


def _summarised(task: Task, trajectory: jax.Array, failure: jax.Array):
    return trajectory, *summarised(task, trajectory, failure)


def draw_truths(subject: Subject, plan: Plan) -> dict[str, np.ndarray]:
    """Truths from the prior over the reference support, with a simulation of each.

    A truth whose simulation fails is drawn again: inference learns from simulations that succeeded, so its posterior
    is that under the prior given success, and so must the truths be.

    Returns:
        `theta` [N, D], `observed` [N, ...], `x` [N, S], and `failed`, the failures by reason.

    Raises:
        SimulatorError: where a truth was drawn `TRIES` times in vain.
    """
    task, box = subject.task, subject.task.support(plan.reference)
    shape = subject.run.observed.shape
    missing = np.ones(plan.truths, bool)
    arrays = {
        "theta": np.zeros((plan.truths, task.dim), np.float32),
        "observed": np.zeros((plan.truths, *shape), np.float32),
        "x": np.zeros((plan.truths, *subject.run.x.shape), np.float32),
    }
    failed = np.zeros(len(task.reasons), int)
    for attempt in range(TRIES):
        key_theta, key_simulate = jax.random.split(jax.random.fold_in(plan.key(TRUTHS), attempt))
        # A compiled simulator takes all rows each time, a slow black box no more than it must.
        rows = np.flatnonzero(missing) if task.black_box else np.arange(plan.truths)
        theta = bayessim.prior_draws(key_theta, task, box, len(rows))
        drawn = dict(zip(("observed", "x", "failure"), simulate(key_simulate, task, theta, shape), strict=True))
        failure = np.where(missing[rows], drawn.pop("failure"), 0)
        failed += np.sum(failure[:, None] == 1 + np.arange(len(task.reasons)), axis=0)
        taken = missing[rows] & (failure == 0)
        for name, values in (drawn | {"theta": np.asarray(theta)}).items():
            arrays[name][rows[taken]] = values[taken]
        missing[rows[taken]] = False
        if not missing.any():
            return arrays | {"failed": failed}
    raise SimulatorError(
        f"simulate: expected a valid simulation of each truth drawn over {plan.reference!r}, got none in {TRIES} tries "
        f"for {missing.sum()} of {plan.truths}"
    )
