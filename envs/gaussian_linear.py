"""Gaussian location model: the task whose posterior is known in closed form."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.tasks.task import Task

DIM = 2
NOISE = np.array([0.3, 0.5], np.float32)
"""Standard deviation of the observation in each dimension."""
MIXING = np.array([[1.0, 0.4], [-0.2, 0.8]], np.float32)
"""Matrix in x = MIXING theta + noise; it is not symmetric, so that swapped axes would be noticed."""


def simulate(key: jax.Array, theta: jax.Array) -> jax.Array:
    """One observation x ~ N(MIXING theta, diag(NOISE^2)), shape [2]."""
    return MIXING @ theta + NOISE * jax.random.normal(key, (DIM,))


def posterior(x: jax.Array | np.ndarray) -> GaussianMixture:
    """The exact posterior under a flat prior, one Gaussian; inside a box it is this, truncated.

    Args:
        x: the observation, shape [2].
    """
    precision = MIXING.T @ np.diag(NOISE.astype(np.float64) ** -2) @ MIXING
    covariance = np.linalg.inv(precision)
    mean = jnp.asarray(np.linalg.inv(MIXING), jnp.float32) @ jnp.asarray(x)
    return GaussianMixture(jnp.zeros(1), mean[None], jnp.asarray(np.linalg.cholesky(covariance), jnp.float32)[None])


def task() -> Task:
    """Two locations observed through a linear map with Gaussian noise; simulations never fail."""
    return Task(
        simulate,
        name="gaussian_linear",
        names=("first", "second"),
        units=("1", "1"),
        supports={
            "ok": Support([-3.0, -3.0], [3.0, 3.0]),
            "misspecified": Support([-3.0, -3.0], [0.0, 3.0]),
            "broad": Support([-10.0, -10.0], [10.0, 10.0]),
        },
        feasible=Support([-10.0, -10.0], [10.0, 10.0]),
        truth=np.array([1.0, -0.5]),
        channels=("x",),
    )
