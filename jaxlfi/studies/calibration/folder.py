"""Folder: the diagnostics of a run, from a plan to complete files, resumable at any chunk."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from jaxlfi import diagnostics
from jaxlfi.io import files as atomic
from jaxlfi.io import serialise as describe
from jaxlfi.runs import folder as run_store
from jaxlfi.runs.folder import StoreError
from jaxlfi.studies.calibration.checks import Check, against, calibration, predictive
from jaxlfi.studies.calibration.repeat import chunk_length, posteriors, read_arrays
from jaxlfi.studies.calibration.subject import Plan, Subject
from jaxlfi.studies.calibration.truths import draw_truths

FORMAT, VERSION = "jaxlfi-diagnostics", 1


def begin(out: Path, subject: Subject, plan: Plan) -> dict[str, Any]:
    """Bring the folder of the diagnostics into being, or find it as the same command left it.

    Returns:
        plan.json.

    Raises:
        StoreError: where the folder holds something else, or diagnostics that were asked for differently.
    """
    told = description(subject, plan)
    path = out / "plan.json"
    if path.exists():
        found = read_plan(path)
        changed = [name for name in told if found.get(name) != told[name]]
        if changed:
            raise StoreError(
                f"out: expected diagnostics of the same run and settings in {str(out)!r}, got some with another "
                f"{', '.join(changed)}: take another folder by --out, or remove that one"
            )
        return found
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise StoreError(f"out: expected a new or empty folder, got {str(out)!r} which holds something")
    (out / "chunks").mkdir(parents=True, exist_ok=True)
    found = told | {"chunk_length": chunk_length(subject, plan), "devices": jax.local_device_count()}
    atomic.write_json(path, found)
    return found


def read_plan(path: Path) -> dict[str, Any]:
    """The plan.json of a folder of diagnostics.

    Raises:
        StoreError: for one that is damaged or of another kind.
    """
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: expected a plan, got a damaged one: {error}") from error
    if not isinstance(found, dict) or (found.get("format"), found.get("version")) != (FORMAT, VERSION):
        raise StoreError(f"{path}: expected format {FORMAT!r}, version {VERSION}, got another")
    return found


def description(subject: Subject, plan: Plan) -> dict[str, Any]:
    """All that the results depend on, as JSON values."""
    run = subject.run
    files = [run.folder / name for name in ("posterior.npz", "network.npz")]
    content = b"".join(path.read_bytes() for path in files if path.exists())
    shared = ("task", "names", "units", "configuration", "support", "heuristic", "settings", "seed")
    box = subject.task.support(plan.reference)
    return {
        "format": FORMAT,
        "version": VERSION,
        "run": {name: run.config.get(name) for name in shared} | {"files": hashlib.sha256(content).hexdigest()[:32]},
        "reference": {"name": plan.reference} | describe.support_to_json(box),
        "truths": plan.truths,
        "draws": plan.draws,
        "seed": plan.seed,
    }


def run(
    out: Path, subject: Subject, plan: Plan, console: Console, reference: tuple[str, np.ndarray] | None = None
) -> list[Check]:
    """Make all checks, and write their numbers and arrays.

    Args:
        out: the folder of the diagnostics.
        subject: the run.
        plan: what is asked of it.
        console: for progress, and for what is left out.
        reference: the name of reference samples of the run's posterior, and they themselves in coordinates [n, D].

    Raises:
        StoreError: for a folder that holds something else.
        SimulatorError: for a simulator that breaks its contract or fails always.
    """
    found = begin(out, subject, plan)
    lines: list[Check] = []
    arrays: dict[str, np.ndarray] = {}
    failed = None
    if subject.task.black_box and not subject.amortised:
        console.print(
            "A black box is not repeated for other truths: calibration is left out. It needs a run of one round whose "
            "network was kept (--rounds 1 --keep-network).",
            soft_wrap=True,
        )
    else:
        truths = _truths(out / "truths.npz", subject, plan)
        failed = dict(zip(subject.task.reasons, truths["failed"].tolist(), strict=True))
        told = posteriors(out, subject, plan, truths, found["chunk_length"], console)
        lines, arrays = calibration(subject, plan, truths, told)
        arrays |= {name: truths[name] for name in ("theta", "x")} | told
    own, of_own = predictive(subject, plan)
    lines, arrays = [*lines, own], arrays | of_own
    if reference is not None:
        lines.append(against(subject, plan, *reference))
    names = {"names": np.asarray(subject.task.coordinates), "units": np.asarray(subject.task.units)}
    atomic.write_arrays(out / "diagnostics.npz", arrays | names)
    atomic.write_json(
        out / "diagnostics.json",
        found
        | {
            "way": None if failed is None else "amortised" if subject.amortised else "repeated",
            "failed_truths": failed,
            "significance": diagnostics.SIGNIFICANCE,
            "checks": [dataclasses.asdict(check) for check in lines],
        }
        | run_store.environment(),
    )
    return lines


def _truths(path: Path, subject: Subject, plan: Plan) -> dict[str, np.ndarray]:
    """The truths of a folder, drawn where they are not there yet."""
    if path.exists():
        return read_arrays(path)
    truths = draw_truths(subject, plan)
    atomic.write_arrays(path, truths, durable=True)
    return truths
