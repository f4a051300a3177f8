"""Existing simulations as the first round of a run."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.distributions.region import region
from jaxlfi.distributions.support import Support
from jaxlfi.io import files
from jaxlfi.tasks import own_arrays
from jaxlfi.tasks.observation import simulator_shapes
from jaxlfi.tasks.simulation import Simulations, summarised_batch
from jaxlfi.tasks.task import Task

ARRAYS = ("theta", "trajectory", "x", "log_density", "low", "high")
"""Names of the arrays of a file of simulations."""
MIN_ROWS = 2
"""Smallest number of simulations that a network can be fitted to."""


def read_simulations(path: str | Path) -> dict[str, np.ndarray]:
    """The arrays of an .npz of simulations; see `presimulated`.

    Raises:
        ValueError: for a file that cannot be read.
    """
    try:
        return files.read_arrays(Path(path))
    except ValueError as error:
        raise ValueError(f"simulations: {error}") from error


def presimulated(task: Task, arrays: Mapping[str, Any], support: Support | None = None) -> tuple[Simulations, Support]:
    """Pairs of parameters and simulations as a first round, and the support they fill.

    Without a density they count as uniform over their box. With one, each is weighted by the prior divided by the
    density it was drawn from; weights are limited to sqrt(n) times their mean (Ionides 2008). Simulations that are not
    finite count as failures, as do those with masked entries.

    Args:
        task: for names, summary and prior.
        arrays: `theta` [N, D] in natural units; `trajectory` [N, ...] or their summaries `x` [N, S]; if they were not
            drawn uniformly, `log_density` [N], the log-density over natural units that they were drawn from; and `low`
            and `high` [D], in natural units, of the box that they fill: by default that of the parameters.
        support: Theta_0 in inference space, if the run begins on another box; simulations outside it are left out, as
            are those where the task's prior is zero.

    Returns:
        The simulations, and Theta_0 in inference space.

    Raises:
        ValueError: for arrays that are missing, of other names, or of shapes that do not fit.
    """
    if not isinstance(arrays, Mapping) or not all(isinstance(name, str) for name in arrays):
        raise ValueError(f"simulations: expected a mapping of arrays, or an .npz file, got {arrays!r}")
    if unknown := sorted(set(arrays) - set(ARRAYS)):
        raise ValueError(f"simulations: expected arrays among {', '.join(ARRAYS)}, got {', '.join(unknown)}")
    theta = _array(arrays, "theta", (None, task.dim)).astype(np.float32)
    rows = len(theta)
    if rows < MIN_ROWS:
        raise ValueError(f"simulations: expected at least {MIN_ROWS}, got {rows}")
    if not np.isfinite(theta).all() or bool(np.any(theta[:, np.asarray(task.space.log)] <= 0)):
        raise ValueError(f"simulations: expected finite parameters, positive ones of {task.log or 'log parameters'}")
    inner = task.space.to_inference(jnp.asarray(theta))
    if support is None:
        low = _array(arrays, "low", (task.dim,)) if "low" in arrays else theta.min(axis=0)
        high = _array(arrays, "high", (task.dim,)) if "high" in arrays else theta.max(axis=0)
        support = task.support(Support(low.tolist(), high.tolist()))
    x, failure = _summaries(task, arrays, rows)
    inside = np.asarray(region(support, task.inference.prior).contains(inner))
    kept = inside & (failure == 0)
    if not kept.any():
        raise ValueError(f"simulations: expected some inside the support, got {inside.sum()} of {rows}, none finite")
    return (
        Simulations(
            *(inner, x, jnp.asarray(failure), jnp.asarray(inside), jnp.asarray(kept)),
            weight=_weights(task, arrays, inner, kept),
        ),
        support,
    )


def _summaries(task: Task, arrays: Mapping[str, Any], rows: int) -> tuple[np.ndarray, np.ndarray]:
    if ("x" in arrays) == ("trajectory" in arrays):
        raise ValueError("simulations: expected either 'trajectory' or 'x' (summaries), got both or neither")
    if "trajectory" in arrays:
        trajectory = _numbers(arrays["trajectory"], "trajectory")
        if trajectory.ndim < 2 or len(trajectory) != rows:
            raise ValueError(f"simulations: expected {rows} trajectories, got shape {list(trajectory.shape)}")
        if not task.on_host and trajectory.shape[1:] != (shape := simulator_shapes(task).trajectory):
            raise ValueError(
                f"simulations: expected trajectories of shape {list(shape)}, as the task's simulator makes, "
                f"got {list(trajectory.shape[1:])}"
            )
        return summarised_batch(task, trajectory, np.zeros(rows, np.int32))
    x = _array(arrays, "x", (rows, None))
    finite = np.asarray(np.isfinite(x.astype(np.float32)).all(axis=1))
    return np.where(finite[:, None], x, 0.0), np.where(finite, 0, len(task.reasons)).astype(np.int32)


def _weights(task: Task, arrays: Mapping[str, Any], inner: jax.Array, kept: np.ndarray) -> jax.Array:
    """The prior divided by the density that the parameters were drawn from, of mean 1."""
    rows, prior = len(inner), task.inference.prior
    log_weight = np.zeros(rows) if prior is None else np.asarray(prior.log_prob(inner), float)
    if "log_density" in arrays:
        density = _array(arrays, "log_density", (rows,))
        log_weight = log_weight - (density + np.asarray(task.space.log_jacobian(inner)))
    if not np.isfinite(log_weight[kept]).all():  # of `log_density`: the prior is finite at all that is kept
        raise ValueError("simulations: expected finite log-densities")
    weight = np.where(kept, np.exp(log_weight - np.max(log_weight[kept])), 0.0)
    limit = np.sqrt(kept.sum()) * weight[kept].mean()
    weight = np.minimum(weight, limit)
    return jnp.asarray(np.where(kept, weight / weight[kept].mean(), 1.0), jnp.float32)


def _array(arrays: Mapping[str, Any], name: str, shape: tuple[int | None, ...]) -> np.ndarray:
    if name not in arrays:
        raise ValueError(f"simulations: expected an array {name!r}, got {', '.join(arrays) or 'none'}")
    array = _numbers(arrays[name], name)
    fits = array.ndim == len(shape) and all(want in (None, got) for want, got in zip(shape, array.shape, strict=True))
    if not fits:
        expected = ["N" if length is None else length for length in shape]
        raise ValueError(f"simulations: expected numbers {name} of shape {expected}, got shape {list(array.shape)}")
    return array


def _numbers(value: Any, name: str) -> np.ndarray:
    try:
        array = own_arrays.array(value)
    except ValueError:  # rows of several lengths
        array = np.zeros(0, object)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"simulations: expected numbers {name}, got an array of type {array.dtype}")
    return array.astype(float)
