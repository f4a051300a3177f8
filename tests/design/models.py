"""Models whose best experiments are known."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.design.regions import Region, region
from jaxlfi.distributions.support import Support
from jaxlfi.tasks.design import Design
from jaxlfi.tasks.task import Task

SIGMA = 0.5
"""Standard deviation of the noise of the linear model."""


def rows(design):
    """Rows of the linear model: three measurements along a direction in the plane, shape [3, 2]."""
    strength = jnp.array([1.0, 0.6, 0.3])
    return strength[:, None] * jnp.stack([jnp.cos(design[0]), jnp.sin(design[0])])


def linear(response: bool = True, noise: bool = True, **design) -> Task:
    """y = A(d) theta + e: a measurement of theta along an angle that is chosen, from 0 to 180 degrees."""
    more = {"noise": SIGMA} if noise else {}
    if response:
        more["response"] = lambda theta, design: rows(design) @ theta
    return Task(
        lambda key, theta, design: rows(design) @ theta + SIGMA * jax.random.normal(key, (3,)),
        ["a", "b"],
        {"guess": box(2)},
        box(2),
        design=Design({"angle": (0.0, np.pi, "rad")}, **more, **design),
    )


def box(dim: int, low: float = -9.0, high: float = 9.0) -> Support:
    return Support([low] * dim, [high] * dim)


def gaussian(mean, covariance, count: int = 40_000, weight: float = 1.0, seed: int = 0) -> Region:
    """A Gaussian belief."""
    rng = np.random.default_rng(seed)
    return region(weight, rng.multivariate_normal(mean, covariance, count))


def information(covariance, angles) -> float:
    """Expected information of measurements of the linear model along some angles, in bits, in closed form."""
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    matrix = (1.0**2 + 0.6**2 + 0.3**2) * directions.T @ directions
    return 0.5 * np.log2(np.linalg.det(np.eye(2) + covariance @ matrix / SIGMA**2))
