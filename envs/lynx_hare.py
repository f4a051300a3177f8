"""Real data: lynx and hare pelts of the Hudson's Bay Company, 1900-1920."""

import dataclasses
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.distributions.support import Support
from jaxlfi.envs.lotka_volterra.ode import lognormal_noise, populations
from jaxlfi.tasks.task import Task

SUBSTEPS = 25
"""Integration steps per year."""


@dataclasses.dataclass(frozen=True)
class Nuisance:
    """Distributions of the unknowns that are not inferred, which every simulation redraws.

    Attributes:
        initial_sd: standard deviation of the logarithm of the initial populations, about that of the first record.
        noise: median scale of the log-normal measurement error; the scale is drawn for each species.
        noise_sd: standard deviation of the logarithm of that scale.
    """

    initial_sd: float = 0.25
    noise: float = 0.25
    noise_sd: float = 0.3


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
    with resources.files("jaxlfi.envs").joinpath("data/lynx_hare.csv").open() as file:
        table = np.loadtxt(file, delimiter=",", skiprows=1, dtype=np.float32)
    return table[:, 0], table[:, 1:]


def growth(trajectory: Float[Array, "years 2"]) -> Float[Array, "12"]:
    """Twelve summaries: each species' growth as a function of the other, its level, variation and autocorrelation.

    Integrated over a year, the equations are linear in the rates: the logarithm of X grows by theta_1 times the mean
    of Y, minus theta_2, and that of Y by theta_3, minus theta_4 times the mean of X. The slopes and intercepts of these
    two regressions (the mean over a year by the trapezoidal rule, in units of its geometric mean over all years) are
    four numbers with most of the information that 21 noisy years hold about the rates. The others are the means and
    the logarithms of the standard deviations of the log-series, and their autocorrelations at one and three years.
    """
    level = jnp.log(jnp.clip(trajectory, 1e-6, 1e9))
    gain = jnp.diff(level, axis=0)
    other = jnp.log(jnp.clip(0.5 * (trajectory[1:] + trajectory[:-1]), 1e-6, 1e9))[:, ::-1]
    mean, sd = jnp.mean(level, axis=0), jnp.std(level, axis=0) + 1e-6
    driver = jnp.exp(other) / jnp.exp(jnp.mean(other, axis=0))
    centred = driver - jnp.mean(driver, axis=0)
    slope = jnp.mean(centred * gain, axis=0) / (jnp.mean(centred**2, axis=0) + 1e-6)
    intercept = jnp.mean(gain, axis=0) - slope * jnp.mean(driver, axis=0)
    deviation = (level - mean) / sd
    memory = [jnp.mean(deviation[lag:] * deviation[:-lag], axis=0) for lag in (1, 3)]
    return jnp.concatenate([slope, intercept, mean, jnp.log(sd), *memory])


SUMMARY_NAMES = tuple(
    f"{name} {species}"
    for name in ("slope", "intercept", "mean", "log sd", "lag 1", "lag 3")
    for species in ("lynx", "hare")
)
"""Names of the summaries of `growth`."""


def task(nuisance: Nuisance = Nuisance()) -> Task:
    """Infer the four log-rates (1/year) of the Lotka-Volterra equations from 21 years of pelts.

    "misspecified" excludes the reference posterior in the predators' death rate.
    """
    years, pelts = load()

    def simulate(key: jax.Array, log_rates: Float[Array, "4"]) -> Float[Array, "years 2"]:
        key_initial, key_scale, key_noise = jax.random.split(key, 3)
        initial = pelts[0] * jnp.exp(nuisance.initial_sd * jax.random.normal(key_initial, (2,)))
        scale = nuisance.noise * jnp.exp(nuisance.noise_sd * jax.random.normal(key_scale, (2,)))
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
        summary=growth,
        summary_names=SUMMARY_NAMES,
        observation=pelts,
        channels=("lynx (thousands of pelts)", "hare (thousands of pelts)"),
        times=years,
    )
