"""Run folders: what a run leaves behind, in plain files (JSON, .npz without pickles, CSV).

One run:        config.json ledger.jsonl posterior.npz dataset.npz history.npz observation.npz
                summary.json; failures.jsonl, where simulations say why they failed
Several seeds:  config.json seed_000/ seed_001/ ...                   each one a run folder
A comparison:   config.json table.csv CONFIGURATION/seed_000/ ...     each one a run folder

While a command runs its folder also holds `checkpoint/` (`jaxlfi.runs.checkpoint`).
"""

import csv
import importlib.metadata
import io
import json
import os
import platform
import shlex
import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

import jaxlfi
from jaxlfi.bayessim.batch import RunSpec
from jaxlfi.bayessim.record import FINAL, ledger_line
from jaxlfi.bayessim.settings import Settings
from jaxlfi.bayessim.widths import widths_note
from jaxlfi.io import files as atomic
from jaxlfi.io import run_summary, trees
from jaxlfi.io.formats import require_version
from jaxlfi.io.serialise import json_safe
from jaxlfi.io.shell import quoted
from jaxlfi.runs import describe
from jaxlfi.tasks import failures, priors, summaries
from jaxlfi.tasks.task import Task

if TYPE_CHECKING:  # runs know how to save themselves
    from jaxlfi.runs.run import Origin, Run

RUN, RUNS, COMPARE = "jaxlfi-run", "jaxlfi-runs", "jaxlfi-compare"
VERSION = 4
"""Of the format of all folders; it rises whenever an older one could be misread.

What is added to a folder without a new number, readers must do without: a new setting's default is what was done before
there was the setting. `tests/golden/formats/` has a folder of each number, and of each state of one.
"""
READ = (2, 3)
"""Older versions of which finished runs are read. In 2, normalisers counted from zero (`jaxlfi.runs.load`); in 3, an
unfinished run believed what it proposed by."""
PACKAGES = ("jax", "jaxlib", "flax", "optax", "distrax", "numpy")
TABLE_COLUMNS = ("configuration", "seed", "theta_error", "trajectory_error", "success_rate", "seconds")


class StoreError(ValueError):
    """A folder that cannot be read, resumed or written to."""


def environment() -> dict[str, Any]:
    """What a run was made with: versions, platform and command line."""
    return {
        "versions": versions(),
        "platform": {
            "system": platform.platform(),
            "processor": processor(),
            "backend": jax.default_backend(),
            "device": jax.devices()[0].device_kind,
            "cores": os.cpu_count(),
        },
        "command_line": command_line(sys.argv),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def as_json(value: Any) -> Any:
    """A value as it is read back after it was written."""
    return json.loads(json.dumps(json_safe(value)))


def versions() -> dict[str, str]:
    """Of Python, jaxlfi and the packages it computes with."""
    packages = {package: importlib.metadata.version(package) for package in PACKAGES}
    return {"python": platform.python_version(), "jaxlfi": jaxlfi.__version__} | packages


def command_line(argv: Sequence[str]) -> str:
    """A command as it is recorded with its results: without the folders of the machine it ran on.

    An absolute path is written relative to the working folder where it lies below it, and by its name alone elsewhere.

    Example:
        >>> command_line(["/usr/bin/jaxlfi", "report", "/elsewhere/runs/edge"])
        'jaxlfi report edge'
    """

    def portable(argument: str) -> str:
        flag, equals, value = argument.partition("=") if argument.startswith("-") else ("", "", argument)
        path = Path(value)
        if not path.is_absolute():
            return argument
        inside = path.is_relative_to(Path.cwd())
        return flag + equals + (str(path.relative_to(Path.cwd())) if inside else path.name)

    return shlex.join([Path(argv[0]).name, *(portable(argument) for argument in argv[1:])])


def processor() -> str:
    """The processor's name as the system reports it."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def refuse_occupied(folder: Path) -> None:
    """Refuse to write where something is.

    Raises:
        StoreError: if the folder exists and is not empty, or is a file, a link to nothing, or the current folder, which
            cannot be replaced.
    """
    if folder.is_symlink() and not folder.exists():
        raise StoreError(
            f"out: expected a new or empty folder, got {str(folder)!r}, a symbolic link to something that is not there"
        )
    if not folder.exists():
        return
    if folder.samefile(Path.cwd()):
        raise StoreError(f"out: expected a new or empty folder, got {str(folder)!r}, the current one")
    if not folder.is_dir() or any(folder.iterdir()):
        raise StoreError(
            f"out: expected a new or empty folder, got {str(folder)!r} which holds something: "
            f"take another name, or continue it with {quoted('jaxlfi', 'resume', folder)}"
        )


def create(folder: Path, config: Mapping[str, Any], fill: Callable[[Path], Any]) -> None:
    """Bring a run folder into being, complete or not at all.

    Args:
        folder: where; it must not exist or be empty.
        config: written as config.json.
        fill: called with the folder's temporary path, to write what else belongs into it.
    """
    refuse_occupied(folder)
    folder = folder.resolve()  # a link to an empty folder stands for that folder
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    except OSError as error:
        raise StoreError(f"out: expected a folder that can be written, got {str(folder)!r}: {error}") from error
    try:
        staging.chmod(0o755)
        fill(staging)
        atomic.write_json(staging / "config.json", config)
        staging.rename(folder)
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        raise


def read_config(folder: Path) -> dict[str, Any]:
    """The config.json of a run folder of any kind.

    Raises:
        StoreError: for folders that are none.
    """
    if not folder.is_dir():
        raise StoreError(f"expected a run folder, got {str(folder)!r} which is no folder")
    path = folder / "config.json"
    try:
        config = atomic.read_json(path)
    except ValueError as error:
        raise StoreError(f"expected a run folder, got {str(folder)!r} without a readable config.json") from error
    kind = config.get("format") if isinstance(config, dict) else None
    if kind not in (RUN, RUNS, COMPARE):
        known = isinstance(kind, str) and kind.startswith("jaxlfi-")
        found = f"is of format {kind!r}" if known else "is not of jaxlfi"
        raise StoreError(f"expected a run folder, got {str(folder)!r} whose config.json {found}")
    check_version(path, config)
    return config


def check_version(path: Path, config: Mapping[str, Any]) -> None:
    """Refuse a folder of another version of the format, but for finished runs of some older ones.

    Raises:
        StoreError: in one line.
    """
    runs = config.get("format") in (RUN, RUNS, COMPARE) and config.get("status", "finished") == "finished"
    if runs and config.get("version") in READ:
        return
    try:
        require_version(path, str(config.get("format")), VERSION, config.get("version"), config)
    except ValueError as error:
        raise StoreError(f"{error}; or run its command again") from error


def append_ledger(folder: Path, index: int, row: Mapping[str, np.ndarray], reasons: Sequence[str], seconds: float):
    """Add a round's line to ledger.jsonl."""
    line = atomic.json_line(ledger_line(index, row, tuple(reasons), seconds))
    atomic.append_line(folder / "ledger.jsonl", line)


def _task_of(run: "Run") -> Task:
    if run.task is None:
        raise StoreError("save: expected a run whose task is known: jaxlfi.load(folder, task=...) takes one")
    return run.task


def write_run(folder: Path, run: "Run", keep_network: bool = False) -> None:
    """Write the arrays of one finished run into its folder, which exists and has its ledger.

    Args:
        folder: of the run.
        run: one run, with the task.
        keep_network: save the network also where the posterior can do without.
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
        },
        durable=True,
    )
    atomic.write_json(folder / run_summary.NAME, run.summary(draws).to_dict())
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
        | ({} if run.reference is None else {"reference": run.reference}),
        durable=True,
    )
    if keep_network or run.amortised or not run.settings.estimator.closed_form:
        atomic.write_arrays(folder / "network.npz", trees.named_leaves(run.network), durable=True)


def save(run: "Run", folder: Path) -> Path:
    """Write one run into a new folder, complete or not at all.

    Raises:
        StoreError: for a run without its task, or one of an earlier version that lacks what is recorded now.
    """
    task = _task_of(run)

    def fill(staging: Path) -> None:
        for index, seconds in enumerate(np.asarray(run.history["seconds"])):
            row = {name: value[index] for name, value in run.history.items() if not name.startswith(FINAL)}
            try:
                append_ledger(staging, index, jax.device_get(row), task.reasons, seconds)
            except KeyError as missing:  # of a folder from before there was such a record
                raise StoreError(
                    f"save: expected a run whose history has {missing}, got one without, as earlier versions made it: "
                    "copy its folder"
                ) from missing
        failures.append(staging, run.failure_log.messages)
        write_run(staging, run)

    create(folder, run_config(task, run.origin, run.spec, run.settings), fill)
    return folder


def write_table(path: Path, lines: Sequence[Mapping[str, Any]]) -> None:
    """Write the table of a comparison, one line a configuration and seed; what is unknown stays empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, TABLE_COLUMNS, lineterminator="\n")
    writer.writeheader()
    for line in lines:
        writer.writerow({name: "" if value != value else value for name, value in line.items()})
    atomic.write_bytes(path, text.getvalue().encode(), durable=True)


def run_config(task: Task, origin: "Origin", spec: RunSpec, settings: Settings) -> dict[str, Any]:
    """The config.json of one run."""
    feasible = task.inference.feasible
    return {
        "format": RUN,
        "version": VERSION,
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
        **environment(),
    }


def read_ledger(folder: Path) -> list[dict[str, Any]]:
    """The ledger of a run folder, one dictionary a round; numbers that were not known are NaN.

    Raises:
        StoreError: if it is missing or damaged.
    """
    path = folder / "ledger.jsonl"
    try:
        lines = [json.loads(line) for line in path.read_text().splitlines()]
    except (OSError, ValueError, RecursionError) as error:
        raise StoreError(f"expected a ledger, got a missing or damaged {path}") from error
    return [{name: float("nan") if value is None else value for name, value in line.items()} for line in lines]


def read_table(path: Path) -> list[dict[str, Any]]:
    """The table of a comparison; what was unknown is NaN."""
    with path.open(newline="") as file:
        return [
            {name: line[name] if name == "configuration" else float(line[name] or "nan") for name in TABLE_COLUMNS}
            for line in csv.DictReader(file)
        ]
