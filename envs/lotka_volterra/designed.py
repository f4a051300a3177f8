"""Experimental design for Lotka-Volterra: when to take ten counts, or which populations to release.

The equations are those of `ode`. The logarithms of both populations are observed with known standard deviation.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.distributions.support import Support
from jaxlfi.envs.lotka_volterra.ode import NAMES, populations
from jaxlfi.tasks.design import Design
from jaxlfi.tasks.task import Task

NOISE = 0.1
"""Standard deviation of the logarithm of a count: one in ten individuals is missed, or counted twice."""
DURATION = 100.0
"""Duration of an experiment: one and a half cycles at the truth."""
INTERVAL = 1.0
"""Integration step; counts in between are interpolated, with errors below a tenth of the noise."""
COUNTS = 10
"""Number of counts in an experiment."""
INITIAL = (9.0, 40.0)
"""Predators and prey that are released by default."""
TRUTH = np.array([0.01, 0.1, 0.1, 0.02])
"""Rates in the tutorial that the paper's appendix A follows."""
WIDE = 4.0
"""Factor between the truth and the bounds of the first guess, which are also those of Phi."""


def log_counts(
    rates: Float[Array, "4"], initial: Float[Array, "2"], times: Float[Array, " counts"]
) -> Float[Array, "counts 2"]:
    """Logarithms of predators and prey at some times from 0 to `DURATION`, without noise.

    Args:
        rates: theta_1..theta_4, 1 / time.
        initial: predators and prey at time 0.
        times: times of the counts, in any order.
    """
    grid = jnp.arange(round(DURATION / INTERVAL) + 1) * INTERVAL
    path = jnp.log(populations(rates, initial, INTERVAL, len(grid), substeps=1))
    return jnp.stack([jnp.interp(times, grid, path[:, species]) for species in range(2)], axis=1)


def times() -> Task:
    """When to count: a design is ten times, in any order; by default they are equally spaced.

    Example:
        >>> times().design.names[0], times().design.nominal[:3]
        ('time 1', (10.0, 20.0, 30.0))
    """

    def response(rates: Array, design: Array) -> Array:
        return log_counts(rates, jnp.asarray(INITIAL), jnp.sort(design))

    variables = {f"time {i + 1}": (0.0, DURATION) for i in range(COUNTS)}
    evenly = (np.arange(COUNTS) + 1) * DURATION / COUNTS
    return _task("lotka_volterra_times", response, Design(variables, evenly, response, NOISE))


def starts() -> Task:
    """Which populations to release and count at ten equally spaced times; by default 9 predators and 40 prey.

    Example:
        >>> starts().design.labels
        ('predators', 'prey')
    """
    evenly = (np.arange(COUNTS) + 1) * DURATION / COUNTS

    def response(rates: Array, design: Array) -> Array:
        return log_counts(rates, design, jnp.asarray(evenly))

    variables = {"predators": (1.0, 50.0), "prey": (2.0, 100.0)}
    return _task("lotka_volterra_starts", response, Design(variables, INITIAL, response, NOISE))


def _task(name: str, response: Callable[[Array, Array], Array], design: Design) -> Task:
    def simulate(key: jax.Array, rates: Float[Array, "4"], design: Array) -> Float[Array, "counts 2"]:
        clean = response(rates, design)
        return clean + NOISE * jax.random.normal(key, clean.shape)

    box = Support(TRUTH / WIDE, TRUTH * WIDE)
    return Task(
        simulate,
        name=name,
        names=NAMES,
        units=("1/time",) * 4,
        log=NAMES,
        supports={"guess": box},
        feasible=box,
        truth=TRUTH,
        channels=("ln predators", "ln prey"),
        channel_noise=[NOISE, NOISE],
        summary_names=[f"ln {species} {i + 1}" for i in range(COUNTS) for species in ("predators", "prey")],
        design=design,
    )
