"""Summaries in double precision, as differences from a reference that single precision can hold.

Networks are trained in single precision, whose seven digits may be too few: for a mains frequency near 50 Hz that
varies by 0.1 mHz, or a pressure near 101,325 Pa that varies by 0.01 Pa. A simulator on the host gives more digits. Its
summaries are computed in double precision, and the observed one is subtracted before they are rounded.
"""

import functools
from typing import Any

import jax
import numpy as np

from jaxlfi.tasks.task import Task

RESOLVED = 8.0
"""Range of a number, in units of the last place of its largest value, up to which it counts as not varying."""


def summaries_in_double(task: Task, trajectories: np.ndarray) -> np.ndarray:
    """Summaries of trajectories [N, ...] as float64, shape [N, S]; as precise as `task.summary` calculates."""
    try:
        with jax.enable_x64(True):
            return np.asarray(_summaries(task.summary, np.asarray(trajectories, np.float64)), np.float64)
    except TypeError:  # the summary mixes dtypes through jax.lax, so it takes single precision only
        return np.asarray(_summaries(task.summary, np.asarray(trajectories, np.float32)), np.float64)


@functools.partial(jax.jit, static_argnums=0)
def _summaries(summary: Any, trajectories: jax.Array) -> jax.Array:
    return jax.vmap(summary)(trajectories)


def reference_of(x: np.ndarray, record_size: int = 0) -> np.ndarray:
    """The reference of summaries: the observed one.

    Args:
        x: the observed summary, shape [S].
        record_size: if not 0, the summary consists of records of this many numbers, whose common reference is their
            mean (`Normaliser`).
    """
    x = np.asarray(x, np.float64)
    if not 0 < record_size < x.size:
        return x
    return np.tile(x.reshape(-1, record_size).mean(axis=0), x.size // record_size)


def raw(x: Any, size: int, reference: np.ndarray | None) -> Any:
    """Summaries [C, S] as the simulator gave them, from differences to a reference; the first `size` are filled."""
    if reference is None:
        return x
    return np.where(np.arange(len(x))[:, None] < size, np.asarray(x, np.float64) + reference, 0.0)


def counted_from(reference: np.ndarray | None, x: Any) -> Any:
    """Summaries minus a reference, rounded to single precision; unchanged without a reference."""
    return x if reference is None else np.asarray(np.asarray(x, np.float64) - reference, np.float32)
