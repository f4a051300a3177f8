"""Continuing a saved run in Python, as `jaxlfi resume` does."""

import dataclasses
import warnings
from concurrent.futures import Executor
from pathlib import Path

from jaxlfi.io import workfolder
from jaxlfi.io.formats import RUN
from jaxlfi.io.locks import locked
from jaxlfi.runs import execute as executing
from jaxlfi.runs import folder as folders
from jaxlfi.runs.infer import Callback, executed
from jaxlfi.runs.load import load
from jaxlfi.runs.run import Run
from jaxlfi.tasks.executors import one_by_one
from jaxlfi.tasks.task import Task


def resume(
    folder: str | Path,
    task: Task | None = None,
    *,
    rounds: int | None = None,
    simulations: int | None = None,
    progress: bool = False,
    callback: Callback | None = None,
    executor: Executor | None = None,
) -> Run:
    """Continue a run that was interrupted, or a finished one with more simulations.

    Finished rounds stay as they are, bit for bit.

    Args:
        folder: folder of one run, made by `infer(..., out=folder)` or the command line. Folders made by `Run.save`
            cannot be continued.
        task: the run's task, if it was made in Python and has no name.
        rounds: total number of rounds; by default the number that the run was begun with.
        simulations: total number of valid simulations, in place of the rounds; the run makes as many rounds as that
            takes if none fails.
        progress: show a progress bar.
        callback: as in `infer`.
        executor: executor that makes the simulations of a host simulator one by one, for a run that was begun with one.

    Returns:
        The finished run, which is also in the folder.

    Raises:
        ValueError: for no more than the run has, or a folder that cannot be continued.

    Example:
        >>> run = resume("runs/spring", task, simulations=3000)  # doctest: +SKIP
    """
    folder = Path(folder)
    with locked(folder):
        if rounds is not None or simulations is not None:
            executing.extend(folder, rounds, simulations)
        config = folders.read_config(folder)
        if config["format"] != RUN:
            raise workfolder.StoreError(f"folder: expected that of one run, got {str(folder)!r}")
        if workfolder.is_finished(config):
            return load(folder, task)
        plan, observed = executing.reopen(folder, task)
        if executor is not None:
            if not config.get("one_by_one", False):
                raise ValueError(f"executor: expected none for {folder}, whose simulations were made in batches")
            plan = dataclasses.replace(plan, task=one_by_one(plan.task, executor))
        run = executed(plan, observed, progress, callback, folder)
        executing.finish(folder, plan, [run])
    for category, text in run.findings():
        warnings.warn(text, category, stacklevel=2)
    return run
