"""Subject: the finished run that is diagnosed, and what is asked of it."""

import dataclasses
from pathlib import Path

import jax

from jaxlfi.heuristics import Heuristic
from jaxlfi.io import serialise as describe
from jaxlfi.runs import load as sampling
from jaxlfi.runs.folder import StoreError
from jaxlfi.runs.inference import check_heuristic, simulator_shapes
from jaxlfi.runs.load import Finished
from jaxlfi.studies import grid as sweep
from jaxlfi.tasks.registry import registry as tasks
from jaxlfi.tasks.task import Task

MIN_COUNT = 20
"""Fewest truths, and draws for each, that tell anything."""
STREAM = 0xD1A6
"""What sets the keys apart from those of a run of the same seed."""
TRUTHS, RUNS, DRAWS, TIES, CLASSIFIER, PREDICTIVE, AGAINST = range(7)
"""Purposes of keys."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """What is asked of a run.

    Attributes:
        reference: name of the support that truths are drawn over.
        truths: how many, N.
        draws: from the posterior of each, L.
        seed: of all random numbers.

    Raises:
        ValueError: for too few truths or draws.
    """

    reference: str
    truths: int = 100
    draws: int = 200
    seed: int = 0

    def __post_init__(self):
        for name in ("truths", "draws"):
            if getattr(self, name) < MIN_COUNT:
                raise ValueError(f"{name}: expected at least {MIN_COUNT}, got {getattr(self, name)}")
        if not 0 <= self.seed < 2**31:
            raise ValueError(f"seed: expected at least 0 and less than 2^31, got {self.seed}")

    def key(self, purpose: int) -> jax.Array:
        """A key for one purpose."""
        return jax.random.fold_in(jax.random.fold_in(jax.random.key(self.seed), STREAM), purpose)


@dataclasses.dataclass(frozen=True)
class Subject:
    """A finished run, and what is needed to repeat it.

    Attributes:
        run: as its folder tells of it.
        task: what was inferred.
        heuristic: how the support was adapted.
    """

    run: Finished
    task: Task
    heuristic: Heuristic

    @property
    def amortised(self) -> bool:
        """Whether its network has learnt the posterior of any observation, not that of its own alone."""
        return self.run.settings.rounds == 1 and self.run.network is not None


def read_subject(folder: Path) -> Subject:
    """A finished run and its task.

    Raises:
        ValueError: for a folder that holds no finished run of one seed, a task that is not there or has changed, or a
            heuristic that is not of the library.
    """
    if sweep.is_grid(folder):
        raise StoreError(f"{folder}: expected the folder of one run, got a grid's, which keeps no posteriors")
    run = sampling.read_run(folder)
    task = tasks.load(run.config["task"])
    heuristic = describe.heuristic_from_json(run.config["heuristic"])
    sizes = (run.x.shape[0],) if task.black_box else (simulator_shapes(task).summary,)
    if list(task.coordinates) != list(run.config["names"]) or sizes != run.x.shape:
        raise StoreError(
            f"{folder}: expected the task as it was when the run was made, with parameters {run.config['names']} and "
            f"{run.x.shape[0]} summaries, got {list(task.coordinates)} and {sizes[0]}"
        )
    check_heuristic(heuristic, task)
    return Subject(run, task, heuristic)
