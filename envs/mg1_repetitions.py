"""The M/G/1 queue, restarted from empty: many jobs in one run, or few jobs in many runs, at the same cost."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxlfi.distributions.support import Support
from jaxlfi.envs.mg1 import PERCENTILES
from jaxlfi.tasks.task import Task

COST = 60
"""Budget: the number of jobs that can be served without a restart."""
SETUP = 3.0
"""Cost of a restart, in jobs."""


def task() -> Task:
    """How many jobs to serve before the queue is emptied and restarted: each restart costs as much as three jobs.

    Parameters are those of `jaxlfi.envs.mg1`, with the width of the service time's interval in place of its upper
    bound, so that the posterior has one mode. A trajectory has two rows: inter-departure times in order of departure,
    0 once the budget is spent, and the kind of each job: the first after a start (2), another (1), or none (0). The
    summary is the percentiles of all times, and the mean time to the first departure.

    Example:
        >>> task().design.labels
        ('jobs',)
    """

    def simulate(key: jax.Array, theta: Float[Array, "3"], design: Float[Array, "1"]) -> Float[Array, "2 jobs"]:
        key_service, key_gap = jax.random.split(key)
        service = theta[0] + theta[1] * jax.random.uniform(key_service, (COST,))
        gaps = jax.random.exponential(key_gap, (COST,)) / theta[2]
        jobs = jnp.round(design[0])
        place = jnp.arange(COST)
        first = place % jobs == 0
        repetitions = jnp.maximum(jnp.floor((COST + SETUP) / (jobs + SETUP)), 1.0)
        used = place < jnp.minimum(repetitions * jobs, COST)

        def depart(backlog: Array, job: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            own, gap, begins = job
            idle = jnp.where(begins, gap, jnp.maximum(gap - backlog, 0.0))
            waiting = jnp.where(begins, 0.0, jnp.maximum(backlog - gap, 0.0))
            return waiting + own, idle + own

        _, times = lax.scan(depart, jnp.zeros(()), (service, gaps, first))
        return jnp.stack([jnp.where(used, times, 0.0), jnp.where(used, 1.0 + first, 0.0)])

    return Task(
        simulate,
        name="mg1_repetitions",
        names=("service min", "service width", "arrival rate"),
        units=("time", "time", "1/time"),
        supports={"guess": Support([0.0, 0.5, 0.03], [5.0, 9.0, 0.4])},
        feasible=Support([0.0, 0.5, 0.03], [5.0, 9.0, 0.4]),
        summary=_summary,
        summary_names=[*(f"percentile {p:g}" for p in PERCENTILES), "mean first"],
        truth=np.array([1.0, 4.0, 0.2]),
        design={"jobs": (1.0, float(COST))},
    )


def _summary(trajectory: Float[Array, "2 jobs"]) -> Float[Array, "6"]:
    times, kind = trajectory
    ordered = jnp.sort(jnp.where(kind > 0, times, jnp.inf))
    position = jnp.asarray(PERCENTILES) / 100 * (jnp.sum(kind > 0) - 1)
    below = jnp.floor(position).astype(int)
    above = jnp.ceil(position).astype(int)
    found = ordered[below] + (position - below) * (ordered[above] - ordered[below])
    return jnp.concatenate([found, jnp.sum(times * (kind > 1))[None] / jnp.sum(kind > 1)])
