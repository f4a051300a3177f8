"""The Lotka-Volterra equations, solved deterministically and observed with noise."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxlfi.distributions.support import Support
from jaxlfi.envs.lotka_volterra.jump_process import SUMMARY_NAMES, lotka_volterra_nine
from jaxlfi.tasks.task import Task

NAMES = ("predator birth", "predator death", "prey birth", "prey death")
"""theta_1..theta_4 of the paper."""

Noise = Callable[[jax.Array, Array], Array]


def populations(
    rates: Float[Array, "4"], initial: Float[Array, "2"], interval: float, records: int, substeps: int
) -> Float[Array, "records 2"]:
    """Predators X and prey Y at times 0, interval, 2 interval, ... (section III-A).

    dX/dt = theta_1 X Y - theta_2 X and dY/dt = theta_3 Y - theta_4 X Y, by the classical Runge-Kutta method in the
    logarithms of the populations, which keeps them positive. Rates too fast for the step give non-finite numbers,
    which count as failed simulations.

    Args:
        rates: theta_1..theta_4, 1 / time, shape [4].
        initial: X and Y at time 0, shape [2].
        interval: time between records.
        records: number of records, the initial one included.
        substeps: number of integration steps per interval.
    """
    predator_birth, predator_death, prey_birth, prey_death = rates
    dt = interval / substeps

    def slope(log_state):
        predators, prey = jnp.exp(log_state)
        return jnp.stack([predator_birth * prey - predator_death, prey_birth - prey_death * predators])

    def advance(state, _):
        k1 = slope(state)
        k2 = slope(state + 0.5 * dt * k1)
        k3 = slope(state + 0.5 * dt * k2)
        k4 = slope(state + dt * k3)
        return state + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4), None

    def record(state, _):
        state, _ = lax.scan(advance, state, length=substeps)
        return state, state

    start = jnp.log(initial)
    _, states = lax.scan(record, start, length=records - 1)
    return jnp.exp(jnp.concatenate([start[None], states]))


def gaussian_noise(key: jax.Array, trajectory: Float[Array, "records 2"], scale: float = 1.0) -> Array:
    """Independent additive noise of standard deviation `scale` (individuals) on every record."""
    return trajectory + scale * jax.random.normal(key, trajectory.shape)


def lognormal_noise(key: jax.Array, trajectory: Float[Array, "records 2"], scale: float | Array = 0.25) -> Array:
    """Independent multiplicative noise: normal errors of the logarithms, with standard deviation `scale`."""
    return trajectory * jnp.exp(scale * jax.random.normal(key, trajectory.shape))


NOISES: dict[str, Noise] = {"gaussian": gaussian_noise, "lognormal": lognormal_noise}
"""Measurement noise by name."""


def task(noise: Literal["gaussian", "lognormal"] = "gaussian", duration: float = 200.0, interval: float = 0.1) -> Task:
    """The noisy ODE of appendix A: initially X = 9 predators and Y = 40 prey, rates in natural units.

    Args:
        noise: "gaussian" or "lognormal".
        duration: simulated time; by default that of the tutorial that the appendix follows (`short` follows the
            appendix to the letter).
        interval: time between records.

    Raises:
        ValueError: for an unknown noise.
    """
    if noise not in NOISES:
        raise ValueError(f"noise: expected one of {sorted(NOISES)}, got {noise!r}")
    records = round(duration / interval) + 1
    solve = functools.partial(
        populations, initial=jnp.array([9.0, 40.0]), interval=interval, records=records, substeps=2
    )

    def simulate(key: jax.Array, rates: Float[Array, "4"]) -> Float[Array, "records 2"]:
        return NOISES[noise](key, solve(rates))

    return Task(
        simulate,
        name="lotka_volterra_ode",
        names=NAMES,
        units=("1/time",) * 4,
        supports={
            "ok": Support([0.005, 0.005, 0.05, 0.01], [0.03, 0.15, 0.15, 0.03]),
            "misspecified": Support([0.015, 0.12, 0.05, 0.01], [0.04, 0.3, 0.15, 0.03]),
        },
        feasible=Support([0.001, 0.001, 0.01, 0.001], [0.1, 0.5, 0.5, 0.1]),
        summary=lotka_volterra_nine,
        truth=np.array([0.01, 0.1, 0.1, 0.02]),
        summary_names=SUMMARY_NAMES,
        channels=("predators", "prey"),
        times=np.arange(records) * interval,
    )


def short(noise: Literal["gaussian", "lognormal"] = "gaussian") -> Task:
    """The appendix exactly as written: 200 steps of 0.1, a duration of 20, a quarter of a cycle at the truth.

    The tutorial that it follows simulates a duration of 200 in steps of 0.1, as `task` does.

    Args:
        noise: "gaussian" or "lognormal".
    """
    return dataclasses.replace(task(noise, duration=20.0), name="lotka_volterra_ode_short")
