"""Tasks of the benchmark, as `experiments.sbibm.tasks:two_moons` on the command line."""

import bz2
from pathlib import Path

import distrax
import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.support import Support
from jaxlfi.task import Task

DATA = Path(__file__).parent / "data"


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
    scale = np.sqrt(0.1).astype(np.float32)

    def simulate(key: jax.Array, theta: jax.Array) -> jax.Array:
        return theta + scale * jax.random.normal(key, theta.shape)

    box = Support([-2.0] * 10, [2.0] * 10)  # six standard deviations of the prior
    return Task(
        simulate,
        name="gaussian_linear",
        names=tuple(f"m{i}" for i in range(1, 11)),
        supports={"prior": box},
        feasible=box,
        prior=distrax.MultivariateNormalDiag(jnp.zeros(10), jnp.full(10, scale)),
    )


TASKS = {"two_moons": two_moons, "gaussian_linear": gaussian_linear}


def observation(task: str, number: int) -> np.ndarray:
    """A published observation, shape [S]."""
    return np.loadtxt(DATA / task / f"observation_{number}" / "observation.csv", delimiter=",", skiprows=1)


def reference(task: str, number: int) -> np.ndarray:
    """10,000 draws of the reference posterior of an observation, shape [10000, D]."""
    path = DATA / task / f"observation_{number}" / "reference_posterior_samples.csv.bz2"
    with bz2.open(path, "rt") as lines:
        return np.loadtxt(lines, delimiter=",", skiprows=1)
