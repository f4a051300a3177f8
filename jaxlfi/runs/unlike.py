"""Findings on how the observation of a finished run is unlike its simulations."""

from collections.abc import Sequence

import numpy as np

from jaxlfi.diagnostics.misspecification import RECORDS, Finding, unlike
from jaxlfi.runs.result import Result
from jaxlfi.tasks import summaries
from jaxlfi.tasks.task import Task


def observation_findings(run: Result) -> list[Finding]:
    """The findings of `jaxlfi.diagnostics.unlike` on the observation and all simulations of one run."""
    rows = slice(int(run.dataset.size))
    names: tuple[str, ...] | None = None
    channels: tuple[str, ...] = ()
    if run.task is not None:
        names, channels = names_of(run.task, np.shape(run.observed), len(run.x))
    return unlike(np.asarray(run.x), np.asarray(run.dataset.x)[rows], names, channels)


def names_of(task: Task, trajectory: Sequence[int], size: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of a summary's numbers, and of its channels if it is a series of unchanged records.

    The trajectory has the given shape, and the summary the given size S.

    Returns:
        S names; and C names, or none if it is not a series.
    """
    names, channels = task.named_summaries(size), tuple(task.channels)
    if task.summary is not summaries.identity or task.summary_names or len(trajectory) > 2:
        return names, ()
    # A vector may be a series, or single numbers with different units.
    if len(trajectory) == 1 and (size < RECORDS or (not channels and task.times is None)):
        return names, ()
    count = 1 if len(trajectory) == 1 else trajectory[1]
    return names, channels if len(channels) == count else tuple(f"channel {c + 1}" for c in range(count))
