"""Folder: the diagnostics of a run, from a plan to complete files, resumable at any chunk."""

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from jaxlfi import diagnostics
from jaxlfi.io import files as atomic
from jaxlfi.io import formats, provenance, workfolder
from jaxlfi.io.formats import DIAGNOSTICS, PLAN
from jaxlfi.io.workfolder import StoreError
from jaxlfi.runs import describe
from jaxlfi.runs import folder as run_store
from jaxlfi.runs.run import Run
from jaxlfi.studies.calibration.checks import Check, against, calibration, predictive
from jaxlfi.studies.calibration.plan import CalibrationPlan
from jaxlfi.studies.calibration.repeat import chunk_length, cost, posteriors, read_arrays
from jaxlfi.studies.calibration.truths import draw_truths
from jaxlfi.studies.calibration.widths import Widths, arrays_of, measured
from jaxlfi.tasks.host import SimulatorError


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """Results of the diagnostics of a run.

    Attributes:
        widths: verdicts on the widths of its method's intervals, one per reference.
        checks: checks of its method over a support, if truths were drawn over one, and of its own posterior.
    """

    widths: tuple[Widths, ...]
    checks: tuple[Check, ...]


def begin(out: Path, run: Run, plans: Sequence[CalibrationPlan]) -> dict[str, Any]:
    """Create the folder of the diagnostics, or accept one that the same command left.

    Returns:
        plan.json.

    Raises:
        StoreError: if the folder contains something else, or diagnostics with other settings.
    """
    wanted = workfolder.as_json(description(run, plans))
    path = out / PLAN
    if workfolder.begun(out, PLAN):
        found = read_plan(path)
        changed = [name for name in wanted if found.get(name) != wanted[name]]
        if changed:
            raise StoreError(
                f"out: expected diagnostics of the same run and settings in {str(out)!r}, got some with another "
                f"{', '.join(changed)}: choose another folder with --out, or remove that one"
            )
        return found
    found = wanted | {"chunk_length": chunk_length(run, plans[0]), "devices": jax.local_device_count()}
    atomic.write_json(path, found)
    return found


def read_plan(path: Path) -> dict[str, Any]:
    """The plan.json of a folder of diagnostics.

    Raises:
        StoreError: for a file that is damaged or of another format.
    """
    try:
        found = atomic.read_json(path)
    except ValueError as error:
        raise StoreError(f"{path}: expected a plan, got a damaged one: {error}") from error
    if not isinstance(found, dict) or found.get("format") != DIAGNOSTICS:
        raise StoreError(f"{path}: expected format {DIAGNOSTICS!r}, got another")
    workfolder.require_format(path, found)
    return found


def description(run: Run, plans: Sequence[CalibrationPlan]) -> dict[str, Any]:
    """Everything that the results depend on, as JSON values."""
    arrays = [np.asarray(leaf) for leaf in jax.tree.leaves((run.belief, run.network))]
    content = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
    config = run_store.run_config(run.task, run.origin, run.spec, run.settings)
    shared = ("task", "names", "units", "configuration", "support", "heuristic", "settings", "seed")
    plan = plans[0]
    return {
        "format": DIAGNOSTICS,
        "version": formats.VERSION,
        "run": {name: config[name] for name in shared} | {"arrays": hashlib.sha256(content).hexdigest()[:32]},
        "references": [_reference(run, plan) for plan in plans],
        "truths": plan.truths,
        "draws": plan.draws,
        "seed": plan.seed,
    }


def _reference(run: Run, plan: CalibrationPlan) -> dict[str, Any]:
    name = {"name": plan.reference}
    return name if plan.at_posterior else name | describe.support_to_json(run.task.support(plan.reference))


def diagnose(
    out: Path,
    run: Run,
    plans: Sequence[CalibrationPlan],
    console: Console,
    reference: tuple[str, np.ndarray] | None = None,
) -> Diagnosis:
    """Make all checks, and write their numbers and arrays.

    Args:
        out: the folder of the diagnostics.
        run: the run under test.
        plans: one plan per reference, with the same numbers of truths and draws and the same seed (`plans_of`).
        console: console for the expected cost and for progress.
        reference: name of reference samples of the run's posterior, and the samples in inference space, shape [n, D].

    Raises:
        StoreError: for a folder that contains something else.
        SimulatorError: for a simulator that breaks its contract or always fails; if that happens while truths are
            drawn, a new folder is removed again.
    """
    new = not (out / PLAN).exists()
    found = begin(out, run, plans)
    console.print(cost(run, plans), markup=False, soft_wrap=True, highlight=False)
    try:
        truths = [_truths(out / plan.folder / "truths.npz", run, plan) for plan in plans]
    except SimulatorError:
        if new:
            shutil.rmtree(out)  # there is nothing in it to continue from
        raise
    widths, lines, arrays = [], [], {}
    for plan, own_truths in zip(plans, truths, strict=True):
        posterior = posteriors(
            out / plan.folder, run, plan, own_truths, found["chunk_length"], _fingerprint(found, plan), console
        )
        widths.append(measured(plan, run.task.names, own_truths, posterior))
        own_arrays = {name: own_truths[name] for name in ("theta", "x")} | posterior
        if plan.at_posterior:
            arrays |= {f"{plan.reference}/{name}": array for name, array in own_arrays.items()}
            continue
        over_box, of_box = calibration(run, plan, own_truths, posterior)
        lines, arrays = [*lines, *over_box], arrays | of_box | own_arrays
    last = plans[-1]
    own, of_own = predictive(run, last)
    lines, arrays = [*lines, own], arrays | of_own | arrays_of(widths)
    if reference is not None:
        lines.append(against(run, last, *reference))
    names = {"names": np.asarray(run.task.space.labels), "units": np.asarray(run.task.units)}
    atomic.write_arrays(out / "diagnostics.npz", arrays | names)
    failed = {
        plan.reference: dict(zip(run.task.reasons, own["failed"].tolist(), strict=True))
        for plan, own in zip(plans, truths, strict=True)
    }
    atomic.write_json(
        out / "diagnostics.json",
        found
        | {
            "way": "amortised" if run.amortised else "repeated",
            "failed_truths": failed,
            "line": widths[0].line,
            "widths": [one.as_json() for one in widths],
            "significance": diagnostics.SIGNIFICANCE,
            "checks": [dataclasses.asdict(check) for check in lines],
        }
        | provenance.environment(),
    )
    return Diagnosis(tuple(widths), tuple(lines))


def _fingerprint(found: dict[str, Any], plan: CalibrationPlan) -> str:
    """A hash of everything that the posteriors at one reference depend on."""
    return hashlib.sha256(json.dumps([found, plan.reference], sort_keys=True).encode()).hexdigest()[:32]


def _truths(path: Path, run: Run, plan: CalibrationPlan) -> dict[str, np.ndarray]:
    """The truths of a folder, drawn if they are not there yet."""
    if path.exists():
        return read_arrays(path)
    truths = draw_truths(run, plan)
    path.parent.mkdir(exist_ok=True)
    atomic.write_arrays(path, truths, durable=True)
    return truths
