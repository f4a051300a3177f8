"""Tasks of the benchmark, as `experiments.sbibm.tasks:two_moons` on the command line.

Two come with the benchmark's observations and reference posteriors. Two have posteriors that can be sampled exactly;
their observations are simulated here, from draws of the prior, as the benchmark did for its own.
"""

import bz2
from pathlib import Path

import distrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from jaxlfi.distributions.support import Support
from jaxlfi.tasks.task import Task

DATA = Path(__file__).parent / "data"
SCALE = float(np.sqrt(0.1))
"""Standard deviation of the linear tasks' noise, and of the Gaussian prior."""


def two_moons() -> Task:
    """Two crescents: parameters in two dimensions, whose posterior has two curved modes."""

    def simulate(key: jax.Array, theta: jax.Array) -> jax.Array:
        key_angle, key_radius = jax.random.split(key)
        angle = jax.random.uniform(key_angle, minval=-jnp.pi / 2, maxval=jnp.pi / 2)
        radius = 0.1 + 0.01 * jax.random.normal(key_radius)
        moon = jnp.array([radius * jnp.cos(angle) + 0.25, radius * jnp.sin(angle)])
        return moon + jnp.array([-jnp.abs(theta[0] + theta[1]), theta[1] - theta[0]]) / jnp.sqrt(2.0)

    box = Support([-1.0, -1.0], [1.0, 1.0])
    return Task(simulate, name="two_moons", names=("a", "b"), supports={"prior": box}, feasible=box)


def gaussian_linear() -> Task:
    """The mean of a Gaussian in ten dimensions, under a Gaussian prior; all variances are 0.1."""
    prior = distrax.MultivariateNormalDiag(jnp.zeros(10), jnp.full(10, SCALE))
    return _ten_means("gaussian_linear", 2.0, prior)  # six standard deviations of the prior


def gaussian_linear_uniform() -> Task:
    """The same under a uniform prior, whose box truncates the posterior."""
    return _ten_means("gaussian_linear_uniform", 1.0, None)


def _ten_means(name: str, bound: float, prior: distrax.Distribution | None) -> Task:
    def simulate(key: jax.Array, theta: jax.Array) -> jax.Array:
        return theta + SCALE * jax.random.normal(key, theta.shape)

    box = Support([-bound] * 10, [bound] * 10)
    names = tuple(f"m{i}" for i in range(1, 11))
    return Task(simulate, name=name, names=names, supports={"prior": box}, feasible=box, prior=prior)


def gaussian_mixture() -> Task:
    """The common mean of a wide and a narrow Gaussian in two dimensions: a posterior with a narrow peak."""

    def simulate(key: jax.Array, theta: jax.Array) -> jax.Array:
        key_which, key_noise = jax.random.split(key)
        scale = jnp.where(jax.random.bernoulli(key_which), 1.0, 0.1)
        return theta + scale * jax.random.normal(key_noise, theta.shape)

    box = Support([-10.0, -10.0], [10.0, 10.0])
    return Task(simulate, name="gaussian_mixture", names=("a", "b"), supports={"prior": box}, feasible=box)


TASKS = {
    "two_moons": two_moons,
    "gaussian_linear": gaussian_linear,
    "gaussian_linear_uniform": gaussian_linear_uniform,
    "gaussian_mixture": gaussian_mixture,
}
PUBLISHED = ("two_moons", "gaussian_linear")
"""Tasks with the benchmark's own observations and references."""
DRAWS = 10_000


def observation(task: str, number: int) -> np.ndarray:
    """An observation by its number, shape [S]: the published one, if there is one."""
    if task not in PUBLISHED:
        made = TASKS[task]()
        key_theta, key_x = jax.random.split(jax.random.key(number))
        return np.asarray(made.simulate(key_x, made.support().sample(key_theta, 1)[0]), np.float64)
    return np.loadtxt(DATA / task / f"observation_{number}" / "observation.csv", delimiter=",", skiprows=1)


def reference(task: str, number: int) -> np.ndarray:
    """10,000 draws of the reference posterior of an observation, shape [10000, D]."""
    if task == "gaussian_linear_uniform":
        return _truncated_normal(observation(task, number), SCALE, 1.0, number)
    if task == "gaussian_mixture":
        x = observation(task, number)
        wide, narrow = (_truncated_normal(x, scale, 10.0, number) for scale in (1.0, 0.1))
        # Each component is weighted by its mass in the box.
        mass = [np.prod(np.diff(stats.norm.cdf([[-10.0], [10.0]], x, scale), axis=0)) for scale in (1.0, 0.1)]
        is_wide = np.random.default_rng(number).random(DRAWS) < mass[0] / sum(mass)
        return np.where(is_wide[:, None], wide, narrow)
    path = DATA / task / f"observation_{number}" / "reference_posterior_samples.csv.bz2"
    with bz2.open(path, "rt") as lines:
        return np.loadtxt(lines, delimiter=",", skiprows=1)


def _truncated_normal(mean: np.ndarray, scale: float, bound: float, seed: int) -> np.ndarray:
    """Draws of independent normals truncated to [-bound, bound]^D."""
    low, high = (-bound - mean) / scale, (bound - mean) / scale
    rng = np.random.default_rng([seed, round(1000 * scale)])
    return stats.truncnorm.rvs(low, high, loc=mean, scale=scale, size=(DRAWS, len(mean)), random_state=rng)
