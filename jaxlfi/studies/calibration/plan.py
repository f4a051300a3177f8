"""Plan: the finished run under test, and the settings of its diagnostics."""

import dataclasses
from pathlib import Path

import jax

from jaxlfi.heuristics.hyperparameters import check
from jaxlfi.io import formats
from jaxlfi.io.workfolder import StoreError
from jaxlfi.registry import TASKS
from jaxlfi.runs.load import load
from jaxlfi.runs.run import Run
from jaxlfi.tasks.observation import simulator_shapes
from jaxlfi.tasks.task import Task

MAX_DRAWS = 10_000_000
"""Largest total number of draws from the posteriors of all truths."""
MIN_COUNT = 20
"""Smallest number of truths, and of draws for each, that can show miscalibration."""
STREAM = 0xD1A6
"""Number that separates the keys from those of a run with the same seed."""
TRUTHS, RUNS, DRAWS, TIES, CLASSIFIER, PREDICTIVE, AGAINST = range(7)
"""Purposes of keys."""
POSTERIOR = "posterior"
"""The reference whose truths are drawn from the run's own posterior; any other is the name of a support."""


@dataclasses.dataclass(frozen=True)
class CalibrationPlan:
    """Settings of a run's diagnostics at one reference.

    Attributes:
        reference: name of the support that truths are drawn over, or `POSTERIOR`.
        truths: number N of truths.
        draws: number L of draws from the posterior of each truth.
        seed: seed of all random numbers.

    Raises:
        ValueError: for too few truths or draws, or too many.
    """

    reference: str
    truths: int = 100
    draws: int = 200
    seed: int = 0

    def __post_init__(self):
        for name in ("truths", "draws"):
            if getattr(self, name) < MIN_COUNT:
                raise ValueError(f"{name}: expected at least {MIN_COUNT}, got {getattr(self, name)}")
        if self.truths * self.draws > MAX_DRAWS:
            raise ValueError(
                f"truths, draws: expected at most {MAX_DRAWS} draws in all, got {self.truths} x {self.draws}"
            )
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed: expected at least 0 and less than 2^31, got {self.seed}")

    @property
    def at_posterior(self) -> bool:
        """Whether truths are drawn from the run's own posterior."""
        return self.reference == POSTERIOR

    @property
    def folder(self) -> str:
        """Name of the folder of the truths and their posteriors, within that of the diagnostics."""
        return POSTERIOR if self.at_posterior else "box"

    @property
    def where(self) -> str:
        """Where truths are drawn, in words."""
        return "at this run's posterior" if self.at_posterior else f"over the support {self.reference}"

    def key(self, purpose: int) -> jax.Array:
        """A key for one purpose; the two kinds of references have different keys."""
        stream = STREAM + self.at_posterior
        return jax.random.fold_in(jax.random.fold_in(jax.random.key(self.seed), stream), purpose)


def plans_of(references: str, task: Task, truths: int, draws: int, seed: int) -> tuple[CalibrationPlan, ...]:
    """The plans of the requested references.

    Args:
        references: `POSTERIOR`, the name of a support, or one of each, separated by a comma.
        task: the task, which has the supports.
        truths: number of truths of each reference.
        draws: number of draws from the posterior of each truth.
        seed: seed of all random numbers.

    Raises:
        ValueError: for invalid references, or too few or too many truths or draws.
    """
    names = references.split(",")
    boxes = [name for name in names if name != POSTERIOR]
    if len(set(names)) < len(names) or len(boxes) > 1 or not set(boxes) <= set(task.supports):
        known = ", ".join(sorted(task.supports))
        raise ValueError(
            f"reference: expected {POSTERIOR!r}, a support ({known}), or one of each with a comma between, "
            f"got {references!r}"
        )
    return tuple(CalibrationPlan(name, truths, draws, seed) for name in sorted(names, key=POSTERIOR.__ne__))


def read_run(folder: Path, task: Task | None = None) -> Run:
    """A finished run with its task, which must be given if it was made in Python and cannot be found by name.

    Raises:
        ValueError: for a folder without a finished run of one seed, a run of several rounds that began with given
            simulations, a task that cannot be found or has changed, or a heuristic that is not installed.
    """
    if formats.recorded(folder).get("format") == formats.GRID:
        raise StoreError(f"{folder}: expected the folder of one run, got a grid's, which keeps no posteriors")
    run = load(folder, task)
    if run.task is None and run.origin.reference is not None:
        try:
            TASKS.load(run.origin.reference)
        except ValueError as error:
            raise StoreError(
                f"{folder}: expected its task {run.origin.reference!r}, which cannot be loaded from here (--task names "
                f"another place): {error}"
            ) from error
    if run.task is None:
        raise StoreError(
            f"{folder}: expected a run whose task can be found by name, got one made in Python: give --task "
            "MODULE:TASK, where TASK is the task or its factory in the file MODULE.py in the current folder"
        )
    if run.origin.given_simulations and not run.amortised:
        raise StoreError(
            f"{folder}: expected a run that made all of its simulations, got one with "
            f"{run.origin.given_simulations} supplied ones, which cannot be repeated for other observations (a run "
            "of one round that kept its network can be diagnosed)"
        )
    if not run.task.on_host and (simulator_shapes(run.task).summary,) != run.x.shape:
        raise StoreError(
            f"{folder}: expected the task as it was when the run was made, with {run.x.shape[0]} summaries, "
            f"got {simulator_shapes(run.task).summary}"
        )
    check(run.heuristic, run.task.dim)
    return run
