"""Real data: lynx and hare pelts of the Hudson's Bay Company, 1900-1920."""

import dataclasses
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from envs.lotka_volterra_ode import lognormal_noise, populations
from jaxlfi.support import Support
from jaxlfi.task import Task

SUBSTEPS = 25
"""Integration steps a year."""


@dataclasses.dataclass(frozen=True)
class Nuisance:
    """What is drawn anew in every simulation, because it is unknown and not of interest.

    Attributes:
        initial_spread: the populations of 1900 are the first record times a log-normal of this scale.
        noise: median scale of the log-normal measurement error, drawn for each species.
        noise_spread: log-normal scale of that scale itself.
    """

    initial_spread: float = 0.25
    noise: float = 0.25
    noise_spread: float = 0.3


REFERENCE_MEAN = np.array([0.024, 0.800, 0.545, 0.028])
"""Posterior means of theta_1..theta_4 by Hamiltonian Monte Carlo with the exact likelihood (Carpenter 2018)."""
REFERENCE_SD = np.array([0.004, 0.092, 0.064, 0.004])
"""Their standard deviations."""


def reference_log_rates() -> tuple[np.ndarray, np.ndarray]:
    """The reference posterior's mean and standard deviation of the log-rates, to second order, shape [4] each."""
    relative = REFERENCE_SD / REFERENCE_MEAN
    return np.log(REFERENCE_MEAN) - 0.5 * relative**2, relative


def load() -> tuple[np.ndarray, np.ndarray]:
    """Years [21], and thousands of pelts of lynx and hare, shape [21, 2]."""
    with resources.files("envs").joinpath("data/lynx_hare.csv").open() as file:
        table = np.loadtxt(file, delimiter=",", skiprows=1, dtype=np.float32)
    return table[:, 0], table[:, 1:]


def log_series(trajectory: Float[Array, "years 2"]) -> Float[Array, " obs"]:
    """Logarithms of both series, one after the other, shape [42]: the noise is log-normal."""
    return jnp.log(jnp.maximum(trajectory, 1e-6)).T.ravel()


def task(nuisance: Nuisance = Nuisance()) -> Task:
    """Infer the four log-rates (1/year) of the Lotka-Volterra equations from 21 years of pelts.

    "misspecified" excludes the reference posterior in the predators' death rate.
    """
    years, pelts = load()

    def simulate(key: jax.Array, log_rates: Float[Array, "4"]) -> Float[Array, "years 2"]:
        key_initial, key_scale, key_noise = jax.random.split(key, 3)
        initial = pelts[0] * jnp.exp(nuisance.initial_spread * jax.random.normal(key_initial, (2,)))
        scale = nuisance.noise * jnp.exp(nuisance.noise_spread * jax.random.normal(key_scale, (2,)))
        clean = populations(jnp.exp(log_rates), initial, interval=1.0, records=len(years), substeps=SUBSTEPS)
        return lognormal_noise(key_noise, clean, scale)

    return Task(
        simulate,
        name="lynx_hare",
        names=("ln predator birth", "ln predator death", "ln prey birth", "ln prey death"),
        units=("ln(1/year)",) * 4,
        supports={
            "ok": Support([-5.5, -2.0, -2.0, -5.5], [-2.0, 1.0, 1.0, -2.0]),
            "misspecified": Support([-5.5, -2.0, -2.0, -5.5], [-2.0, -0.8, 1.0, -2.0]),
            "broad": Support([-7.0, -3.0, -3.0, -7.0], [0.0, 2.0, 2.0, 0.0]),
        },
        feasible=Support([-7.0, -3.0, -3.0, -7.0], [0.0, 2.0, 2.0, 0.0]),
        summary=log_series,
        observation=pelts,
        channels=("lynx (thousands of pelts)", "hare (thousands of pelts)"),
        times=years,
    )
