"""Runs of our methods in batches, those of other libraries one by one, and the arrays that are kept."""

import dataclasses
import json
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

import jaxlfi
from experiments.sharpness import measures, references
from experiments.sharpness.problem import Case, Problem
from experiments.sota import cases as sota_cases
from experiments.sota.__main__ import at_most, inference
from experiments.sota.ours import settings_of
from jaxlfi.bayessim.presets import with_fields
from jaxlfi.bayessim.settings import Settings
from jaxlfi.distributions.support import Support
from jaxlfi.heuristics import Choice, Edge, Fixed
from jaxlfi.io import files as atomic
from jaxlfi.io.executables import QUICK, compiled
from jaxlfi.io.provenance import environment
from jaxlfi.io.workfolder import as_json
from jaxlfi.runs.describe import settings_to_json

OURS = ("bayessim", "tsnpe", "npe", "apt", "snle")
OTHERS = {
    "sbi-npe": "sbi-npe",
    "sbi-npe-c": "sbi-apt",
    "sbi-tsnpe": "sbi-tsnpe",
    "sbi-nle": "sbi-snle",
    "bayesflow": "bayesflow-npe",
}
"""Methods of other libraries, and their names in `experiments.sota`, whose adapters run them."""
METHODS = (*OURS, *OTHERS)
THRESHOLDS = (0.005, 0.12, 0.18, 0.25)
PLAIN = {f"edge-{tau:g}": Edge(mass_threshold=tau, uninformed_factor=1.0) for tau in THRESHOLDS}
"""EDGE with a threshold that does not depend on the posterior."""
RULES = {"fixed": Fixed(), "edge": Edge(), **PLAIN}
BOXES = ("right", "one", "all")
DRAWS = 2000
"""Draws from each posterior of our methods."""
TOGETHER = 8
"""Largest number of runs in a batch."""
LIMIT = 900
"""Seconds after which a run of another library is given up."""


@dataclasses.dataclass(frozen=True)
class Job:
    """One run.

    Attributes:
        case: truth and observation.
        box: of `BOXES`.
        heuristic: of `RULES`.
    """

    case: Case
    box: str
    heuristic: str

    @property
    def label(self) -> str:
        """Its label in results."""
        return f"{self.box}/{self.heuristic}/{self.case.label}"

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the box that it begins with, in inference space."""
        if self.box == "right":
            return self.case.problem.box
        return self.case.problem.wrong_box(self.case.truth, self.case.seed, self.box)


def settings_for_run(method: str, simulations: int, given: Mapping[str, Any]) -> Settings:
    """A method's defaults for a budget shared by ten rounds, with fields of the run or the estimator replaced."""
    fields = {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}
    return with_fields(settings_of(method, simulations), fields).check()


def program(problem: Problem, settings: Settings, devices: Sequence[Any]) -> Any:
    """A batch of runs by the default call of `jaxlfi.infer`, compiled once for all boxes and heuristics."""

    def one(key, x, truth, low, high, place):
        rule = Choice(index=place, rules=tuple(RULES.values()))
        key_run, key_draw = jax.random.split(key)
        run = jaxlfi.infer(
            key_run, problem.task, x, support=Support(low, high), space="inference", heuristic=rule, settings=settings
        )
        posterior = run.posterior
        draws = posterior.sample(key_draw, DRAWS, space="inference")
        density = posterior.log_prob(draws, space="inference")
        rank = jnp.mean(density > posterior.log_prob(truth, space="inference"))
        end = run.belief.support
        made = jnp.sum(run.history["attempted"])
        return {"draws": draws, "rank": rank, "low": end.low, "high": end.high, "made": made}

    many = jax.vmap(one)
    if len(devices) > 1:
        # Divided by shard_map, as while-loops must not get predicates that cross devices.
        split = PartitionSpec("runs")
        many = jax.shard_map(
            many, mesh=Mesh(np.asarray(devices), ("runs",)), in_specs=split, out_specs=split, check_vma=False
        )
    return jax.jit(many)


def arguments_of(jobs: Sequence[Job]) -> tuple:
    """The arguments of a batch; a run has the same key in any batch."""
    keys = jnp.stack([jax.random.fold_in(jax.random.key(job.case.seed), job.case.kind == "near") for job in jobs])
    bounds = [job.bounds for job in jobs]
    vectors = (
        [job.case.x for job in jobs],
        [job.case.truth for job in jobs],
        [low for low, _ in bounds],
        [high for _, high in bounds],
    )
    places = jnp.array([list(RULES).index(job.heuristic) for job in jobs])
    return keys, *(jnp.asarray(np.stack(one), jnp.float32) for one in vectors), places


@dataclasses.dataclass(frozen=True)
class Folder:
    """The arrays of one problem, method and budget, and the settings that they were made with."""

    path: Path

    def rows(self) -> dict[str, np.ndarray]:
        """The rows that exist; empty if nothing was run."""
        return atomic.read_arrays(self.path) if self.path.exists() else {}

    def begin(self, config: Mapping[str, Any]) -> None:
        """Write the configuration.

        Raises:
            ValueError: if there are rows of other settings.
        """
        there = self.path.with_suffix(".json")
        config = as_json(config)
        if self.path.exists() and there.exists():
            before = json.loads(there.read_text())
            if any(before.get(name) != value for name, value in config.items()):
                raise ValueError(f"{self.path}: expected results of the same settings, got others: take another --out")
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        atomic.write_json(there, config | environment())

    def add(self, new: Sequence[Mapping[str, Any]]) -> None:
        """Add rows to those that exist."""
        before = self.rows()
        stacked = {name: np.stack([np.asarray(row[name]) for row in new]) for name in new[0]}
        if before:
            unknown = np.full(len(before["label"]), np.nan)  # rows of earlier versions lack `made`
            stacked = {name: np.concatenate([before.get(name, unknown), values]) for name, values in stacked.items()}
        atomic.write_arrays(self.path, stacked)


def jobs_of(problem: Problem, boxes: Sequence[str], heuristics: Sequence[str], cases: Sequence[Case]) -> list[Job]:
    """The runs of a problem: wrong boxes only with heuristics that can move them, and only for its own truth."""
    return [
        Job(case, box, heuristic)
        for box in boxes
        for heuristic in heuristics
        if box == "right" or heuristic != "fixed"
        for case in cases
        if box == "right" or case.kind == "own"
    ]


def row_of(job: Job, found: Mapping[str, Any], seconds: float, compiling: float) -> dict:
    """A run's row, without the exact posterior if its reference is refused.

    `made` counts its simulations, failures included.
    """
    low, high = job.bounds
    end = np.asarray(found["low"], float), np.asarray(found["high"], float)
    draws = np.asarray(found["draws"], float)
    try:
        own = references.on_box(job.case, references.reference(job.case), *end)
    except ValueError as error:
        warnings.warn(str(error), stacklevel=2)
        own = None
    what = {"label": job.label, "box": job.box, "heuristic": job.heuristic, "kind": job.case.kind}
    return {
        **what,
        "seed": job.case.seed,
        "low": low,
        "high": high,
        "made": float(found.get("made", np.nan)),
        **measures.judged(job.case, draws, float(found["rank"]), end, own),
        "seconds": seconds,
        "compile_seconds": compiling,
    }


def run_ours(problem: Problem, jobs: Sequence[Job], settings: Settings, folder: Folder) -> None:
    """Run jobs in batches, of which the last is padded, and write their rows as each batch ends."""
    count = min(TOGETHER, len(jobs))
    devices = jax.local_devices()
    devices = devices if count % len(devices) == 0 else devices[:1]
    began = time.perf_counter()
    filled = lambda start: [jobs[place] for place in np.minimum(np.arange(start, start + count), len(jobs) - 1)]
    batch = compiled(program(problem, settings, devices), arguments_of(filled(0)), QUICK)
    compiling = time.perf_counter() - began
    for start in range(0, len(jobs), count):
        arguments = arguments_of(filled(start))
        began = time.perf_counter()
        found = jax.device_get(jax.block_until_ready(batch(*arguments)))
        seconds = (time.perf_counter() - began) / count
        rows = [
            row_of(
                job,
                {name: value[place] for name, value in found.items()},
                seconds,
                compiling,
            )
            for place, job in enumerate(jobs[start : start + count])
        ]
        folder.add(rows)


def run_on_host(problem: Problem, jobs: Sequence[Job], settings: Settings, folder: Folder) -> None:
    """Run jobs of a simulator that is not in JAX, one after another; the first one's seconds include compiling."""
    for job in jobs:
        key, x, truth, low, high, _ = (one[0] for one in arguments_of([job]))
        key_run, key_draw = jax.random.split(key)
        began = time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of bounds: the table says what came of them
            run = jaxlfi.infer(
                key_run,
                problem.task,
                np.asarray(x),
                support=Support(np.asarray(low), np.asarray(high)),
                space="inference",
                heuristic=RULES[job.heuristic],
                settings=settings,
            )
        seconds = time.perf_counter() - began
        draws = run.posterior.sample(key_draw, DRAWS, space="inference")
        density = run.posterior.log_prob(draws, space="inference")
        found = {
            "draws": draws,
            "rank": np.mean(density > run.posterior.log_prob(truth, space="inference")),
            "low": run.belief.support.low,
            "high": run.belief.support.high,
            "made": np.sum(run.history["attempted"]),
        }
        folder.add([row_of(job, found, seconds, np.nan)])


def run_others(problem: Problem, method: str, simulations: int, jobs: Sequence[Job], folder: Folder) -> None:
    """Run another library's method on jobs, one after another; those that fail are left out with a warning."""
    infer = inference(OTHERS[method])
    for job in jobs:
        low, high = job.bounds
        box = Support(*(jnp.asarray(bound, jnp.float32) for bound in (low, high)))
        case = sota_cases.Case(
            problem.task, box, job.case.seed, job.case.x.astype(np.float32), job.case.truth.astype(np.float32), None
        )
        try:
            with at_most(LIMIT):
                found = infer(OTHERS[method], case, simulations)
        except Exception as error:  # what another library raises is a result of the comparison
            warnings.warn(f"{problem.name}, {method}, {job.label}: {error}", stacklevel=2)
            continue
        draws = np.asarray(found.draws, float)
        given = {
            "draws": draws,
            "rank": measures.ellipsoid_rank(draws, job.case.truth),
            "low": low,
            "high": high,
        }
        folder.add([row_of(job, given, found.seconds, found.compile_seconds)])


def run(
    problem: Problem,
    method: str,
    simulations: int,
    jobs: Sequence[Job],
    given: Mapping[str, Any],
    out: Path,
) -> None:
    """Run the missing jobs of a problem with a method.

    Raises:
        ValueError: if the existing results are of other settings.
    """
    if method in OTHERS:
        # Adapters have only uniform and normal priors, only simulators in JAX, and no heuristics.
        theirs = problem.prior is None and problem.declared is None
        jobs = [job for job in jobs if theirs and job.box == "right" and job.heuristic == "fixed"]
    folder = Folder(out / problem.name / f"{method}-{simulations}.npz")
    there = set(folder.rows().get("label", np.zeros(0, str)).tolist())
    left = [job for job in jobs if job.label not in there]
    if not left:
        return
    settings = settings_for_run(method, simulations, given) if method in OURS else None
    folder.begin(
        {
            "problem": problem.name,
            "method": method,
            "simulations": simulations,
            "settings": None if settings is None else settings_to_json(settings),
        }
    )
    if settings is None:
        run_others(problem, method, simulations, left, folder)
    elif problem.task.on_host:
        run_on_host(problem, left, settings, folder)
    else:
        run_ours(problem, left, settings, folder)
