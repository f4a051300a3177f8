"""Run folders: the results of runs in plain files (JSON, .npz without pickles, CSV).

One run:        config.json ledger.jsonl posterior.npz dataset.npz history.npz observation.npz
                summary.json; failures.jsonl, if simulations say why they failed; polish.json, if polishing was tried
Several seeds:  config.json seed_000/ seed_001/ ...                   each one per run folder
A comparison:   config.json table.csv CONFIGURATION/seed_000/ ...     each one per run folder

While a command runs, its folder also holds `checkpoint/` (`jaxlfi.runs.checkpoint`).
"""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxlfi.bayessim.batch import RunSpec
from jaxlfi.bayessim.record import FINAL, ledger_line
from jaxlfi.bayessim.settings import Settings
from jaxlfi.bayessim.widths import widths_note
from jaxlfi.io import files as atomic
from jaxlfi.io import formats, provenance, run_summary, text_table, trees, workfolder
from jaxlfi.io.formats import COMPARE, RUN, RUNS
from jaxlfi.io.locks import locked
from jaxlfi.io.workfolder import StoreError
from jaxlfi.runs import account, describe
from jaxlfi.runs.result import Origin, Result
from jaxlfi.tasks import failures, priors, summaries
from jaxlfi.tasks.task import Task

OF_RUN = (
    "config.json", "ledger.jsonl", "posterior.npz", "dataset.npz", "history.npz", "observation.npz", "network.npz",
    "samples.csv", "report.html", "figures", "diagnostics", "checkpoint", run_summary.NAME, failures.FILE,
    "polish.json",
)  # fmt: skip
"""Names of the files and folders that commands may write into a run folder."""
POLISH = "polish.json"
"""File on how a posterior was polished, or why not (`jaxlfi.runs.result.PolishNotes`), if that was tried."""
UNPOLISHED = "unpolished_"
"""Prefix of the names in posterior.npz of the posterior before it was polished."""
TABLE_COLUMNS = ("configuration", "seed", "theta_error", "trajectory_error", "success_rate", "seconds")


def read_config(folder: Path) -> dict[str, Any]:
    """The config.json of a folder of runs of any kind.

    Raises:
        StoreError: for any other folder.
    """
    return workfolder.read(folder, RUN, RUNS, COMPARE)


def append_ledger(folder: Path, index: int, row: Mapping[str, np.ndarray], reasons: Sequence[str], seconds: float):
    """Add a round's line to ledger.jsonl."""
    line = atomic.json_line(ledger_line(index, row, tuple(reasons), seconds))
    atomic.append_line(folder / "ledger.jsonl", line)


def _task_of(run: Result) -> Task:
    if run.task is None:
        raise StoreError("save: expected a run whose task is known: jaxlfi.load(folder, task=...) takes one")
    return run.task


def write_run(folder: Path, run: Result, keep_network: bool = False) -> None:
    """Write the arrays of one finished run into its folder, which must exist and have its ledger.

    The network is written if posteriors need it, or on request.
    """
    task, history = _task_of(run), jax.device_get(run.history)
    belief, labels = jax.device_get(run.belief), np.asarray(run.space.labels)
    draws = run.draws()
    atomic.write_arrays(
        folder / "posterior.npz",
        {
            "logits": belief.mixture.logits,
            "means": belief.mixture.means,
            "scale_tril": belief.mixture.scale_tril,
            "support_low": belief.support.low,
            "support_high": belief.support.high,
            "draws": draws,
            "parameters": np.asarray(run.space.names),
            "log": np.asarray(run.space.log),
            "names": labels,
        }
        | _unpolished(run),
        durable=True,
    )
    if run.polish is not None:
        atomic.write_json(folder / POLISH, dataclasses.asdict(run.polish))
    atomic.write_json(folder / run_summary.NAME, account.summary(run, draws).at(run_summary.FOLDER).to_dict())
    dataset = jax.device_get(run.dataset)
    rows = slice(int(dataset.size))
    columns = {name: getattr(dataset, name)[rows] for name in ("theta", "x", "round", "weight")}
    atomic.write_arrays(folder / "dataset.npz", columns | {"names": labels}, durable=True)
    kept = history | {"reasons": np.asarray(task.reasons), "names": labels}
    atomic.write_arrays(folder / "history.npz", kept, durable=True)
    unknown = np.full(task.dim, np.nan, np.float32)
    atomic.write_arrays(
        folder / "observation.npz",
        {
            "trajectory": run.observed,
            "x": run.x,
            "layout": np.asarray(summaries.layout(task.summary, run.observed.shape, len(run.x))),
            "truth": unknown if task.truth is None else task.inference.truth,
            "names": labels,
            "summaries": np.asarray(task.named_summaries(len(run.x)), dtype=str),
            "channels": np.asarray(task.channels, dtype=str),
            "times": np.arange(len(run.observed)) if task.times is None else task.times,
            "record_label": np.asarray(task.record_label or ("record" if task.times is None else "time")),
        }
        | ({} if run.reference is None else {"reference": run.reference})
        | ({} if task.channel_noise is None else {"channel_noise": task.channel_noise}),
        durable=True,
    )
    if keep_network or run.amortised or not run.settings.estimator.closed_form:
        atomic.write_arrays(folder / "network.npz", trees.named_leaves(run.network), durable=True)


def _unpolished(run: Result) -> dict[str, Any]:
    """The posterior before it was polished, as arrays with prefixed names."""
    if run.unpolished is None:
        return {}
    mixture, support = jax.device_get((run.unpolished.mixture, run.unpolished.support))
    arrays = {name: getattr(mixture, name) for name in ("logits", "means", "scale_tril")}
    arrays |= {"support_low": support.low, "support_high": support.high}
    return {UNPOLISHED + name: array for name, array in arrays.items()}


def save(run: Result, folder: Path, exist_ok: bool = False) -> Path:
    """Write one run into a folder, complete or not at all.

    Args:
        run: one run, with its task.
        folder: a new or empty folder.
        exist_ok: whether it may also hold a finished run, which is replaced.

    Raises:
        StoreError: if the folder holds something else; for a run without its task, or one of an earlier version that
            lacks what is recorded now.
    """
    task = _task_of(run)
    replace = exist_ok and folder.is_dir() and any(folder.iterdir())
    if replace:
        _require_replaceable(folder)

    def fill(staging: Path) -> None:
        for index, seconds in enumerate(np.asarray(run.history["seconds"])):
            row = {name: value[index] for name, value in run.history.items() if not name.startswith(FINAL)}
            try:
                append_ledger(staging, index, jax.device_get(row), task.reasons, seconds)
            except KeyError as missing:  # a folder from before this record existed
                raise StoreError(
                    f"save: expected a run whose history has {missing}, got one without, as earlier versions made it: "
                    "copy its folder"
                ) from missing
        failures.append(staging, run.failure_log.messages)
        write_run(staging, run)

    with locked(folder) if replace else contextlib.nullcontext():
        workfolder.create(folder, run_config(task, run.origin, run.spec, run.settings), fill, replace)
    return folder


def _require_replaceable(folder: Path) -> None:
    """Refuse a folder that holds anything but a finished run and what commands write beside one.

    Raises:
        StoreError: naming what it holds.
    """
    config = workfolder.read(folder, RUN)
    if not workfolder.is_finished(config) or not (folder / "posterior.npz").exists():
        raise StoreError(f"save: expected a finished run to replace, got {str(folder)!r}, which is not")
    if others := sorted(path.name for path in folder.iterdir() if path.name not in OF_RUN):
        raise StoreError(f"save: expected a folder with only a run to replace, got {str(folder)!r} with {others[0]!r}")


def write_table(path: Path, lines: Sequence[Mapping[str, Any]]) -> None:
    """Write the table of a comparison, one line for each configuration and seed; unknown values stay empty."""
    rows = (["" if line[name] != line[name] else line[name] for name in TABLE_COLUMNS] for line in lines)
    atomic.write_bytes(path, text_table.as_csv(TABLE_COLUMNS, rows).encode(), durable=True)


def run_config(task: Task, origin: Origin, spec: RunSpec, settings: Settings) -> dict[str, Any]:
    """The config.json of one run."""
    feasible = task.inference.feasible
    return {
        "format": RUN,
        "version": formats.VERSION,
        "task": origin.reference,
        "task_name": task.name,
        "parameters": list(task.names),
        "log": list(task.space.log),
        "names": list(task.space.labels),
        "units": list(task.units),
        "prior": None if task.prior is None else type(task.prior).__name__,
        "prior_log_density": priors.fingerprint(task.inference.prior, feasible),
        "prior_bounded": priors.is_bounded(task.inference.prior, feasible),
        "feasible_low": np.asarray(feasible.low).tolist(),
        "feasible_high": np.asarray(feasible.high).tolist(),
        "configuration": spec.configuration,
        "support": {"name": spec.support_name} | describe.support_to_json(spec.support),
        "heuristic": describe.heuristic_to_json(spec.heuristic),
        "preset": origin.preset,
        "given_simulations": origin.given_simulations,
        "one_by_one": task.one_by_one,
        "simulation_timeout": task.simulate.timeout if task.one_by_one else None,
        "settings": describe.settings_to_json(settings),
        "seed": spec.seed,
        "widths": widths_note(settings, spec.heuristic),
        **provenance.environment(),
    }
