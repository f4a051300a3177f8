"""Recordings with gaps: what is missing from an observation is left out of every simulation, too.

This makes the posterior given the recorded numbers exact: the gaps are the same in everything that the network learns
from, so that it needs no mask.
"""

import dataclasses
import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.tasks.summaries import Summary, identity, one_after_another, series, series_of
from jaxlfi.tasks.task import Task
from jaxlfi.tasks.trials import pooled, summary_of_trials


@dataclasses.dataclass(frozen=True)
class Gaps:
    """Which numbers of a trajectory are missing; hashable, as a part of a compiled simulator.

    Attributes:
        shape: of the trajectory.
        places: of the missing numbers in the flattened trajectory.
    """

    shape: tuple[int, ...]
    places: tuple[int, ...]

    @property
    def missing(self) -> np.ndarray:
        """True where a number is missing, in the trajectory's shape."""
        flat = np.zeros(int(np.prod(self.shape)), bool)
        flat[list(self.places)] = True
        return flat.reshape(self.shape)


def with_gaps(task: Task, missing: Any, keep_places: bool = False) -> Task:
    """The task of a recording in which some numbers are missing.

    `jaxlfi.infer` makes it from an observation with NaN. The summary "identity" then has only the numbers that are
    there, "series" is computed from the records and pairs of records that are there, and a user's own summary sees NaN
    in the same places of the observation and of all simulations. A traced observation cannot be inspected: under `vmap`
    or `jit`, pass a task made by this function.

    Args:
        task: of a whole recording.
        missing: true where a number is missing, in the trajectory's shape.
        keep_places: whether "identity" keeps the places of missing numbers, as zeros: an embedding sees whole records.

    Returns:
        The task; the given one if nothing is missing.

    Raises:
        ValueError: if everything is missing, or a summary of several recordings has no meaning with these gaps.

    Example:
        >>> from jaxlfi.envs.gaussian_linear import task
        >>> with_gaps(task(), np.arange(8) == 3).summary(jnp.arange(8.0)).tolist()
        [0.0, 1.0, 2.0, 4.0, 5.0, 6.0, 7.0]
    """
    missing = np.asarray(missing, bool)
    if not missing.any():
        return task
    if missing.all():
        raise ValueError("observation: expected some numbers, got an array of which all are missing")
    gaps = Gaps(missing.shape, tuple(np.flatnonzero(missing).tolist()))
    return dataclasses.replace(
        task,
        summary=functools.partial(_of_what_is_there, task.summary, gaps, keep_places),
        summary_names=_names(task, missing, keep_places),
    )


def gaps_of(task: Task) -> np.ndarray | None:
    """True where numbers of this task's recording are missing, in the trajectory's shape; None without gaps."""
    summary = task.summary
    known = isinstance(summary, functools.partial) and summary.func is _of_what_is_there
    return summary.args[1].missing if known else None


def _of_what_is_there(summary: Summary, gaps: Gaps, keep_places: bool, trajectory: Float[Array, "..."]) -> Array:
    """The summary of a recording with gaps."""
    missing = gaps.missing
    if summary is identity:
        if keep_places:
            return jnp.ravel(jnp.where(missing, 0.0, trajectory))
        return jnp.ravel(trajectory)[np.flatnonzero(~missing)]
    if summary is series:
        return series_of(trajectory, ~missing)
    if isinstance(summary, functools.partial) and summary.func in (one_after_another, summary_of_trials):
        one, trials, *pooling = summary.args
        whole = trajectory.reshape(trials, -1, *trajectory.shape[1:])
        each = [
            _of_what_is_there(one, Gaps(own.shape, tuple(np.flatnonzero(own).tolist())), keep_places, trial)
            for trial, own in zip(whole, missing.reshape(whole.shape), strict=True)
        ]
        if not pooling:
            return jnp.concatenate(each)
        if len({len(x) for x in each}) > 1:
            raise ValueError(
                "observation: expected trials with the same gaps, as moments are taken of their numbers, got others: "
                "use summary='series', or a summary that handles NaN"
            )
        return pooled(jnp.stack(each), *pooling)
    return summary(jnp.where(missing, jnp.nan, trajectory))


def _names(task: Task, missing: np.ndarray, keep_places: bool) -> tuple[str, ...]:
    """Names of the numbers that are left, by channel and record if a series has no names."""
    names = tuple(task.summary_names)
    channels = missing.size // len(missing)
    if not names and len(task.channels) == channels:
        names = tuple(
            f"{channel} at record {record + 1}" for record in range(len(missing)) for channel in task.channels
        )
    if task.summary is not identity or keep_places or len(names) != missing.size:
        return tuple(task.summary_names)
    return tuple(name for name, gone in zip(names, missing.ravel(), strict=True) if not gone)
