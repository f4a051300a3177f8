"""Run folders: what a run leaves behind, in plain files (JSON, .npz without pickles, CSV).

One run:        config.json ledger.jsonl posterior.npz dataset.npz history.npz observation.npz
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
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxlfi
from jaxlfi.bayessim.record import ledger_line, own_evidence, stacked_rounds
from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.io import files as atomic
from jaxlfi.io import serialise as describe
from jaxlfi.tasks.task import Task

RUN, RUNS, COMPARE = "jaxlfi-run", "jaxlfi-runs", "jaxlfi-compare"
VERSION = 1
PACKAGES = ("jax", "jaxlib", "flax", "optax", "distrax", "numpy")
TABLE_COLUMNS = ("configuration", "seed", "theta_error", "trajectory_error", "success_rate", "seconds")


class StoreError(ValueError):
    """A folder that cannot be read, resumed or written to."""


def environment() -> dict[str, Any]:
    """What a run was made with: versions, platform and command line."""
    return {
        "versions": {
            "python": platform.python_version(),
            "jaxlfi": jaxlfi.__version__,
            **{package: importlib.metadata.version(package) for package in PACKAGES},
        },
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


def command_line(argv: Sequence[str]) -> str:
    """A command as its results tell of it: without the folders of the machine it ran on.

    An absolute path is told from the working folder on where it lies below it, and by its name alone elsewhere.

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
    """The processor's name as the system tells it."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def refuse_occupied(folder: Path) -> None:
    """Refuse to write where something is.

    Raises:
        StoreError: if the folder exists and is not empty, or is a file.
    """
    if not folder.exists():
        return
    if not folder.is_dir() or any(folder.iterdir()):
        raise StoreError(
            f"out: expected a new or empty folder, got {str(folder)!r} which holds something: "
            f"take another name, or continue it with 'jaxlfi resume {folder}'"
        )


def create(folder: Path, config: Mapping[str, Any], fill) -> None:
    """Bring a run folder into being, complete or not at all.

    Args:
        folder: where; it must not exist or be empty.
        config: written as config.json.
        fill: called with the folder's temporary path, to write what a resume needs besides.
    """
    refuse_occupied(folder)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        beside = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    except OSError as error:
        raise StoreError(f"out: expected a folder that can be written, got {str(folder)!r}: {error}") from error
    try:
        beside.chmod(0o755)
        fill(beside)
        atomic.write_json(beside / "config.json", config)
        beside.rename(folder)
    except BaseException:
        shutil.rmtree(beside, ignore_errors=True)
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
        config = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise StoreError(f"expected a run folder, got {str(folder)!r} without a readable config.json") from error
    kind = config.get("format") if isinstance(config, dict) else None
    if kind not in (RUN, RUNS, COMPARE):
        known = isinstance(kind, str) and kind.startswith("jaxlfi-")
        told = f"is of format {kind!r}" if known else "is not of jaxlfi"
        raise StoreError(f"expected a run folder, got {str(folder)!r} whose config.json {told}")
    if config.get("version") != VERSION:
        raise StoreError(f"{path}: expected version {VERSION} of the format, got {config.get('version')}")
    return config


def write_ledger(
    folder: Path, rows: Sequence[Mapping[str, np.ndarray]], reasons: Sequence[str], seconds: Sequence[float]
):
    """Write ledger.jsonl anew from the records of the rounds so far."""
    lines = [ledger_line(i, row, tuple(reasons), s) for i, (row, s) in enumerate(zip(rows, seconds, strict=True))]
    atomic.write_json_lines(folder / "ledger.jsonl", lines)


def write_results(
    folder: Path,
    task: Task,
    rows: Sequence[Mapping[str, np.ndarray]],
    seconds: Sequence[float],
    final: Mapping[str, np.ndarray],
    draws: np.ndarray,
    dataset: Any,
    observed: np.ndarray,
    x: np.ndarray,
) -> None:
    """Write everything but config.json of one run.

    Args:
        folder: the run's folder, which exists.
        task: for names and times.
        rows: the rounds' records of this one lane.
        seconds: of each round.
        final: what is kept of the last round only (`jaxlfi.bayessim.record.apart`): the simulations of its posterior samples,
            shape [N, T, C], and their summaries, shape [N, S].
        draws: of the last posterior, shape [n, D].
        dataset: `jaxlfi.estimators.dataset.Dataset` of this one lane.
        observed: the observed trajectory.
        x: its summary.
    """
    names = np.asarray(task.coordinates)
    write_ledger(folder, rows, task.reasons, seconds)
    last = rows[-1]
    belief = {name: last[name] for name in ("logits", "means", "scale_tril", "support_low", "support_high")}
    atomic.write_arrays(folder / "posterior.npz", belief | {"draws": draws, "names": names})
    size = int(dataset.size)
    atomic.write_arrays(
        folder / "dataset.npz",
        {"theta": dataset.theta[:size], "x": dataset.x[:size], "round": dataset.round[:size], "names": names},
    )
    atomic.write_arrays(
        folder / "history.npz",
        stacked_rounds(list(rows))
        | {
            "reasons": np.asarray(task.reasons),
            "names": names,
            "seconds": np.asarray(seconds, np.float64),
        }
        | dict(final),
    )
    unknown = np.full(task.dim, np.nan, np.float32)
    atomic.write_arrays(
        folder / "observation.npz",
        {
            "trajectory": observed,
            "x": x,
            "truth": unknown if task.truth is None else task.truth,
            "names": names,
            "summaries": np.asarray(task.named_summaries(len(x)), dtype=str),
            "channels": np.asarray(task.channels, dtype=str),
            "times": np.arange(len(observed)) if task.times is None else task.times,
            "record_label": np.asarray(task.record_label or ("record" if task.times is None else "time")),
        },
    )


def write_table(path: Path, lines: Sequence[Mapping[str, Any]]) -> None:
    """Write the table of a comparison, one line a configuration and seed; what is unknown stays empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, TABLE_COLUMNS, lineterminator="\n")
    writer.writeheader()
    for line in lines:
        writer.writerow({name: "" if value != value else value for name, value in line.items()})
    atomic.write_bytes(path, text.getvalue().encode())


def lane_rows(rows: Sequence[Mapping[str, np.ndarray]], lane: int, place: int | None) -> list[dict[str, Any]]:
    """One lane's records out of those of all lanes."""
    return [own_evidence({name: value[lane] for name, value in row.items()}, place) for row in rows]


def run_config(
    *,
    task: Task,
    reference: str,
    support_name: str,
    support: Any,
    heuristic: Any,
    preset: str | None,
    settings: Any,
    seed: Any,
    configuration: str | None = None,
) -> dict[str, Any]:
    """The config.json of one run.

    Args:
        task: for names and units.
        reference: by which the task was found (`jaxlfi.tasks.registry.load`).
        support_name: of Theta_0.
        support: Theta_0.
        heuristic: how it was adapted.
        preset: the settings were made from.
        settings: all of them.
        seed: of the run.
        configuration: what a comparison calls the run.
    """
    return {
        "format": RUN,
        "version": VERSION,
        "task": reference,
        "names": list(task.coordinates),
        "units": list(task.units),
        "feasible_low": np.asarray(task.feasible.low).tolist(),
        "feasible_high": np.asarray(task.feasible.high).tolist(),
        "configuration": configuration,
        "support": {"name": support_name} | describe.support_to_json(support),
        "heuristic": describe.heuristic_to_json(heuristic),
        "preset": preset,
        "settings": describe.settings_to_json(settings),
        "seed": seed,
        **environment(),
    }


def read_belief(folder: Path) -> Belief:
    """The posterior of a run folder.

    Raises:
        StoreError: if it is missing or damaged.
    """
    try:
        arrays = atomic.read_arrays(folder / "posterior.npz")
        mixture = GaussianMixture(arrays["logits"], arrays["means"], arrays["scale_tril"])
        # jnp: plain arrays would be checked as a reader's bounds are, and adapted boxes may be degenerate.
        support = Support(jnp.asarray(arrays["support_low"]), jnp.asarray(arrays["support_high"]))
    except (ValueError, KeyError) as error:
        raise StoreError(f"{folder / 'posterior.npz'}: expected a whole posterior, got {error}") from error
    return Belief(mixture, support, jnp.asarray(True))


def read_ledger(folder: Path) -> list[dict[str, Any]]:
    """The ledger of a run folder, one dictionary a round; numbers that were not known are NaN.

    Raises:
        StoreError: if it is missing or damaged.
    """
    path = folder / "ledger.jsonl"
    try:
        lines = [json.loads(line) for line in path.read_text().splitlines()]
    except (OSError, ValueError) as error:
        raise StoreError(f"expected a ledger, got a missing or damaged {path}") from error
    return [{name: float("nan") if value is None else value for name, value in line.items()} for line in lines]


def read_table(path: Path) -> list[dict[str, Any]]:
    """The table of a comparison; what was unknown is NaN."""
    with path.open(newline="") as file:
        return [
            {name: value if name == "configuration" else float(value or "nan") for name, value in line.items()}
            for line in csv.DictReader(file)
        ]
