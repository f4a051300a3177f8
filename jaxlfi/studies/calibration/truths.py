"""Truths: parameters drawn over a reference support or from the run's posterior, each with a simulation."""

from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.distributions.support import Support
from jaxlfi.runs.run import Run
from jaxlfi.studies.calibration.plan import TRUTHS, CalibrationPlan
from jaxlfi.tasks.host import SimulatorError
from jaxlfi.tasks.observation import Shapes
from jaxlfi.tasks.priors import prior_draws
from jaxlfi.tasks.simulation import simulate_batch
from jaxlfi.tasks.task import Task

TRIES = 16
"""Largest number of attempts to draw a truth whose simulation succeeds."""


def draw_truths(run: Run, plan: CalibrationPlan) -> dict[str, np.ndarray]:
    """Truths from the prior over the reference support or from the run's posterior, with a simulation of each.

    Raises:
        SimulatorError: if no simulation of a truth succeeds in `TRIES` attempts.
    """
    shapes = Shapes(run.observed.shape, run.x.shape[0])
    if not plan.at_posterior:
        return simulated_truths(plan.key(TRUTHS), run.task, run.task.support(plan.reference), plan.truths, shapes)
    draw = lambda key, count: run.posterior.sample(key, count, space="inference")
    return _simulated(plan.key(TRUTHS), run.task, draw, plan.truths, shapes, "from the run's posterior")


def simulated_truths(key: jax.Array, task: Task, box: Support, count: int, shapes: Shapes) -> dict[str, np.ndarray]:
    """Truths from the prior over a box, with a simulation of each.

    A truth whose simulation fails is drawn again: inference learns from successful simulations only, so its prior is
    the prior given success, and truths must be drawn from that, too.

    Returns:
        `theta` [N, D], `observed` [N, ...], `x` [N, S], and `failed`, the number of failures by reason.

    Raises:
        SimulatorError: if no simulation of a truth succeeds in `TRIES` attempts.
    """
    draw = lambda key, count: prior_draws(key, task.inference.prior, box, count)
    sides = (f"[{low:g}, {high:g}]" for low, high in zip(box.low.tolist(), box.high.tolist(), strict=True))
    return _simulated(key, task, draw, count, shapes, f"over {' x '.join(sides)}")


def _simulated(
    key: jax.Array,
    task: Task,
    draw: Callable[[jax.Array, int], Float[Array, "n dim"]],
    count: int,
    shapes: Shapes,
    where: str,
) -> dict[str, np.ndarray]:
    """Truths from any sampler, each with a simulation."""
    missing = np.ones(count, bool)
    precision = np.float64 if task.on_host else np.float32
    arrays = {
        "theta": np.zeros((count, task.dim), np.float32),
        "observed": np.zeros((count, *shapes.trajectory), precision),
        "x": np.zeros((count, shapes.summary), precision),
    }
    failed = np.zeros(len(task.reasons), int)
    for attempt in range(TRIES):
        key_theta, key_simulate = jax.random.split(jax.random.fold_in(key, attempt))
        theta = draw(key_theta, count)
        observed, x, failure = simulate_batch(key_simulate, task, theta, shapes.trajectory, missing)
        failure = np.where(missing, failure, 0)
        failed += np.sum(failure[:, None] == 1 + np.arange(len(task.reasons)), axis=0)
        taken = missing & (failure == 0)
        for name, values in {"theta": np.asarray(theta), "observed": observed, "x": x}.items():
            arrays[name][taken] = values[taken]
        missing &= ~taken
        if not missing.any():
            return arrays | {"failed": failed}
    raise SimulatorError(
        f"simulate: expected a valid simulation of each truth drawn {where}, got none in {TRIES} "
        f"tries for {missing.sum()} of {count}"
    )
