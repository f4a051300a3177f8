"""Truths: parameters drawn over the reference support, each with a simulation."""

import jax
import numpy as np

from jaxlfi.runs.run import Run
from jaxlfi.studies.calibration.plan import TRUTHS, CalibrationPlan
from jaxlfi.tasks.host import SimulatorError
from jaxlfi.tasks.priors import prior_draws
from jaxlfi.tasks.simulation import simulate_batch

TRIES = 16
"""Draws of a truth whose simulations may fail before it is given up."""


def draw_truths(run: Run, plan: CalibrationPlan) -> dict[str, np.ndarray]:
    """Truths from the prior over the reference support, with a simulation of each.

    A truth whose simulation fails is drawn again: inference learns from simulations that succeeded, so its posterior
    is that under the prior given success, and so must the truths be.

    Returns:
        `theta` [N, D], `observed` [N, ...], `x` [N, S], and `failed`, the failures by reason.

    Raises:
        SimulatorError: where a truth was drawn `TRIES` times in vain.
    """
    task, box = run.task, run.task.support(plan.reference)
    shape = run.observed.shape
    missing = np.ones(plan.truths, bool)
    arrays = {
        "theta": np.zeros((plan.truths, task.dim), np.float32),
        "observed": np.zeros((plan.truths, *shape), np.float32),
        "x": np.zeros((plan.truths, *run.x.shape), np.float32),
    }
    failed = np.zeros(len(task.reasons), int)
    for attempt in range(TRIES):
        key_theta, key_simulate = jax.random.split(jax.random.fold_in(plan.key(TRUTHS), attempt))
        theta = prior_draws(key_theta, task.inference.prior, box, plan.truths)
        observed, x, failure = simulate_batch(key_simulate, task, theta, shape, missing)
        failure = np.where(missing, failure, 0)
        failed += np.sum(failure[:, None] == 1 + np.arange(len(task.reasons)), axis=0)
        taken = missing & (failure == 0)
        for name, values in {"theta": np.asarray(theta), "observed": observed, "x": x}.items():
            arrays[name][taken] = values[taken]
        missing &= ~taken
        if not missing.any():
            return arrays | {"failed": failed}
    raise SimulatorError(
        f"simulate: expected a valid simulation of each truth drawn over {plan.reference!r}, got none in {TRIES} tries "
        f"for {missing.sum()} of {plan.truths}"
    )
