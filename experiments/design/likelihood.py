"""The known likelihood of recordings: a response with independent normal noise."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.tasks.task import Task

IMPOSSIBLE = -1e30
"""Log-likelihood of a simulation that fails."""


@functools.lru_cache
def log_likelihood(task: Task) -> Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """A function of recordings [E, T, ...], their designs [E, K], and parameters [N, D] in inference space: [N, E]."""
    return functools.partial(_on_host, task) if task.on_host else _in_jax(task)


def _in_jax(task: Task) -> Callable:
    noise = jnp.asarray(task.design.noise or task.channel_noise, jnp.float32)

    @jax.jit
    def of(recorded, designs, theta):
        def one(theta):
            natural = task.space.to_natural(theta)
            clean = jax.vmap(lambda design: task.design.response(natural, design))(designs)
            shape = (1,) * (recorded.ndim - 1) if len(noise) == 1 else (1,) * (recorded.ndim - 2) + noise.shape
            squared = ((recorded - clean) / noise.reshape(1, *shape[1:])) ** 2
            log = -0.5 * jnp.sum(squared, axis=range(1, recorded.ndim))
            return jnp.nan_to_num(log, nan=IMPOSSIBLE, neginf=IMPOSSIBLE)

        return jax.vmap(one)(theta)

    def called(recorded, designs, theta):
        single = (jnp.asarray(each, jnp.float32) for each in (recorded, designs, theta))
        return np.asarray(of(*single), float)

    return called


def _on_host(task: Task, recorded: np.ndarray, designs: np.ndarray, theta: np.ndarray) -> np.ndarray:
    log = -0.5 * np.sum(residuals(task, recorded, designs, theta) ** 2, axis=(2, 3))
    return np.nan_to_num(log, nan=IMPOSSIBLE, neginf=IMPOSSIBLE)


def residuals(task: Task, recorded: np.ndarray, designs: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Residuals of a response outside JAX, in standard deviations of the noise, shape [N, E, T, C]; NaN if it fails."""
    log = np.asarray(task.space.log)  # in double precision, which differences need
    natural = np.where(log, np.exp(np.where(log, theta, 0.0)), theta)
    clean = np.stack([task.design.response(natural, design) for design in np.asarray(designs, float)], axis=1)
    return (np.asarray(recorded) - clean) / np.asarray(task.design.noise)
