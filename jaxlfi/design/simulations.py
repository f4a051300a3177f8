"""Simulations of all designs at all parameter vectors, compiled or on the host, and their derivatives."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlfi.distributions.precision import own, single
from jaxlfi.tasks.experiments import at, simulator_at
from jaxlfi.tasks.simulation import simulate_batch, summarised, trajectory_and_outcome
from jaxlfi.tasks.task import Task

CHUNK = 8
"""Number of designs simulated at once. It is fixed, so that one compiled program serves all."""


@dataclasses.dataclass(frozen=True, eq=False)
class Simulated:
    """Simulations of M designs at N parameter vectors.

    Attributes:
        trajectory: simulated trajectories, shape [M, N, ...].
        x: summaries, shape [M, N, S]; zero for failed simulations.
        fine: whether each simulation succeeded and was safe, shape [M, N].
    """

    trajectory: np.ndarray
    x: np.ndarray
    fine: Bool[np.ndarray, "designs n"]


def simulated(
    key: jax.Array, task: Task, theta: Float[np.ndarray, "n dim"], designs: Float[np.ndarray, "designs k"]
) -> Simulated:
    """Simulate every design at every parameter vector, which has the same noise under all designs.

    Args:
        key: random key of the noise.
        task: task of one experiment (`jaxlfi.tasks.experiments.single`).
        theta: parameters in inference space, shape [N, D].
        designs: the designs' variables, shape [M, K].
    """
    inner, key = jnp.asarray(theta, jnp.float32), jax.random.clone(key)
    if task.on_host:
        shape = np.shape(task.simulate(jax.random.clone(key), np.asarray(task.space.to_natural(inner[0])))[0])
        parts = [simulate_batch(jax.random.clone(key), at(task, design), inner, shape) for design in designs]
        trajectory, x, failure = (np.stack([part[i] for part in parts]) for i in range(3))
        safe = [_safe_each(task, each) for each in trajectory]
        return Simulated(trajectory, x, (failure == 0) & np.stack(safe))
    keys = jax.random.split(key, len(inner))
    return Simulated(*in_chunks(lambda part: _simulated(task, jax.random.clone(keys), inner, part), designs))


def in_chunks(function: Callable[[Array], Any], designs: np.ndarray) -> Any:
    """Apply a function of `CHUNK` designs to any number of designs; its results become NumPy arrays."""
    designs = np.asarray(designs, np.float32)
    parts = []
    for first in range(0, len(designs), CHUNK):
        part = designs[first : first + CHUNK]
        padded = np.concatenate([part, np.repeat(part[-1:], CHUNK - len(part), axis=0)])
        parts.append(jax.tree.map(lambda leaf, n=len(part): np.asarray(leaf)[:n], function(jnp.asarray(padded))))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


@functools.partial(jax.jit, static_argnums=0)
@single
def _simulated(task: Task, keys: jax.Array, theta: Array, designs: Array) -> tuple[Array, Array, Array]:
    def one(key, theta, design):
        trajectory, failure = one_of(task, key, theta, design)
        x, failure = summarised(task, trajectory, failure)
        return trajectory, x, (failure == 0) & _safe(task, trajectory)

    over_theta = jax.vmap(one, (0, 0, None))
    return jax.vmap(over_theta, (None, None, 0))(keys, theta, designs)


def one_of(task: Task, key: jax.Array, theta: Array, design: Array) -> tuple[Array, Array]:
    """One simulation at theta [D] in inference space, and its outcome; the key may be reused for other designs."""
    return trajectory_and_outcome(task, jax.random.clone(key), theta, simulator_at(task, design))


def _safe(task: Task, trajectory: Array) -> Array:
    if task.design.safe is None:
        return jnp.asarray(True)
    with own():
        return jnp.all(jnp.asarray(task.design.safe(trajectory)))


def _safe_each(task: Task, trajectories: np.ndarray) -> np.ndarray:
    if task.design.safe is None:
        return np.ones(len(trajectories), bool)
    return np.array([bool(np.all(task.design.safe(one))) for one in trajectories])


def noise_of(task: Task) -> tuple[float, ...] | None:
    """Standard deviation of the noise of each column of a trajectory; None if any is unknown or zero."""
    noise = task.design.noise
    if noise is None and task.channel_noise is not None:
        noise = tuple(map(float, task.channel_noise))
    return noise if noise is not None and min(noise) > 0 else None


def flat_noise(noise: tuple[float, ...], shape: tuple[int, ...]) -> Array:
    """Standard deviations of all elements of a flattened trajectory.

    Raises:
        ValueError: if the number of standard deviations is neither one nor the number of columns.
    """
    columns = shape[1] if len(shape) > 1 else 1
    if len(noise) not in (1, columns):
        raise ValueError(f"noise: expected a standard deviation for each of {columns} columns, got {len(noise)}")
    return jnp.broadcast_to(jnp.asarray(noise), shape if len(shape) > 1 else (shape[0], 1)).ravel()


def response(task: Task, key: jax.Array, theta: Array, design: Array) -> Array:
    """A trajectory without noise, or with the same noise for all parameters, shape [T] or [T, C]."""
    if task.design.response is None:
        return one_of(task, key, theta, design)[0]
    natural = task.space.to_natural(theta)
    with own():
        found = task.design.response(jnp.asarray(natural, float), jnp.asarray(design, float))
        return jnp.asarray(found).astype(jnp.float32)


def differentiable(function: Callable[[Array], Array], theta: Array) -> bool:
    """Whether JAX can differentiate a function in forward mode."""
    try:
        jax.eval_shape(jax.jacfwd(function), theta)
    except Exception:
        return False
    return True


def jacobian(function: Callable[[Array], Array], theta: Array, steps: Array) -> tuple[Array, Array]:
    """The value of a vector function at theta, and its derivatives with respect to the parameters, shape [..., D].

    They are computed by JAX if it can differentiate the function, otherwise by central differences.

    Args:
        function: function of theta [D].
        theta: point of evaluation.
        steps: step sizes of the differences, shape [D].
    """
    if differentiable(function, theta):
        return function(theta), jax.jacfwd(function)(theta)
    offsets = jnp.diag(steps)
    ahead, behind = jax.vmap(function)(theta + offsets), jax.vmap(function)(theta - offsets)
    return function(theta), jnp.moveaxis((ahead - behind) / (2 * steps.reshape(-1, *[1] * (ahead.ndim - 1))), 0, -1)
