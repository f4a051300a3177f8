"""A grid's folder: how it is begun, resumed and finished.

    config.json            axes, settings, versions, and whether it is finished
    observation.npz        the observation of each seed
    chunks/000.npz ...     results by chunk; an existing chunk is not computed again
    grid.npz               arrays with leading axes [axis..., seed]
    table.csv              one line per combination and seed

Several joined processes (`jaxlfi.io.processes`) share the runs of every chunk, and the first one writes.
"""

import hashlib
import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from jaxlfi.bayessim.batch import RunSpec
from jaxlfi.io import files as atomic
from jaxlfi.io import provenance, serialise, text_table, workfolder
from jaxlfi.io.formats import GRID
from jaxlfi.io.processes import ALONE, Processes
from jaxlfi.io.progress import RoundProgress
from jaxlfi.io.workfolder import StoreError
from jaxlfi.registry import TASKS
from jaxlfi.runs import describe
from jaxlfi.runs import folder as run_store
from jaxlfi.runs.result import Origin
from jaxlfi.studies.chunk_store import ChunkStore
from jaxlfi.studies.grid.chunks import MEASURES, Work, arranged, prepare, run_chunk
from jaxlfi.studies.grid.grid import Axis, Grid, combinations, hyperparameters, observations


def description(work: Work) -> dict[str, Any]:
    """Everything that the results depend on, as JSON values."""
    grid = work.grid
    spec = RunSpec("", grid.support_name, grid.support, grid.rule, 0)
    origin = Origin(grid.reference, "", grid.support_name, grid.preset)
    run = run_store.run_config(grid.task, origin, spec, grid.settings)
    left_out = ("configuration", "seed", "versions", "platform", "command_line", "started")
    defaults = hyperparameters(grid.rule)
    truth = np.asarray(np.nan if grid.task.truth is None else grid.task.truth, np.float32)
    return {name: value for name, value in run.items() if name not in left_out} | {
        "format": GRID,
        "axes": [
            {"name": axis.name, "values": list(axis.values), "default": serialise.plain_value(defaults[axis.name])}
            for axis in grid.axes
        ],
        "seeds": list(grid.seeds),
        "runs_per_chunk": work.length,
        "observation": _digest(*map(np.ascontiguousarray, (work.observed, work.x, truth))),
    }


def fingerprint(work: Work) -> str:
    """A hash of the description; chunks with another fingerprint belong to another grid."""
    return _digest(json.dumps(workfolder.as_json(description(work)), sort_keys=True).encode())


def _digest(*parts) -> str:
    whole = hashlib.sha256()
    for part in parts:
        whole.update(part)
    return whole.hexdigest()[:32]


def begin(
    folder: Path, grid: Grid, observation: Any = None, runs_per_chunk: int | None = None, processes: Processes = ALONE
) -> Work:
    """Check everything and compile, then create the folder; nothing is written before.

    Args:
        folder: a new or empty folder.
        grid: the grid of runs.
        observation: see `observations`.
        runs_per_chunk: see `prepare`.
        processes: processes that share a chunk's runs.

    Raises:
        ValueError: for a folder that is in use, and for arguments that `prepare` refuses.
    """
    if processes.writes:
        workfolder.refuse_occupied(folder)
        work = prepare(grid, observation, runs_per_chunk, processes)
        create(folder, work, processes)
    else:
        work = Work(grid, *observations(grid, observation), length=0)
    observed, x, length = processes.broadcast((work.observed, work.x, np.asarray(work.length)))
    return Work(grid, observed, x, int(length))


def create(folder: Path, work: Work, processes: Processes = ALONE) -> None:
    """Create the folder of prepared work."""

    def fill(staging: Path) -> None:
        atomic.write_arrays(staging / "observation.npz", {"trajectory": work.observed, "x": work.x}, durable=True)

    workfolder.create(
        folder,
        description(work)
        | provenance.environment()
        | {
            "status": "running",
            "devices": jax.local_device_count() * processes.count,
            "processes": processes.count,
            "runs": work.grid.size,
            "fingerprint": fingerprint(work),
        },
        fill,
    )


def reopen(folder: Path) -> Work:
    """The work of a folder, finished or not; it is not compiled.

    Raises:
        StoreError: for a folder that is damaged or whose configuration or task has changed since it was begun.
    """
    config = workfolder.read(folder, GRID)
    try:
        grid = Grid(
            task=TASKS.load(config["task"]),
            support=describe.support_from_json(config["support"]),
            rule=describe.heuristic_from_json(config["heuristic"]),
            axes=tuple(Axis(axis["name"], tuple(axis["values"])) for axis in config["axes"]),
            seeds=tuple(config["seeds"]),
            settings=describe.settings_from_json(config["settings"]),
            reference=config["task"],
            preset=config["preset"],
            support_name=config["support"]["name"],
        )
        start = atomic.read_arrays(folder / "observation.npz")
        work = Work(grid, start["trajectory"], start["x"], config["runs_per_chunk"])
        now = workfolder.as_json(description(work))
        same = fingerprint(work) == config["fingerprint"] and all(config.get(name) == now[name] for name in now)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise StoreError(f"{folder}: expected a complete description of a grid, got: {error}") from error
    if not same:
        raise StoreError(
            f"{folder}: expected config.json, observation.npz and the task as they were when the grid was begun, "
            "got changed ones: start a new grid in another folder"
        )
    return work


def store_of(folder: Path, work: Work) -> ChunkStore:
    """The store of a grid's chunks."""
    return ChunkStore(folder / "chunks", work.grid.size, work.length, fingerprint(work), MEASURES)


def advance(folder: Path, work: Work, console: Console, processes: Processes = ALONE) -> dict[str, np.ndarray]:
    """Compute the missing chunks, then write the results.

    Args:
        folder: folder made by `begin`, finished or not.
        work: the folder's work.
        console: console for progress.
        processes: processes that share a chunk's runs. Only the one that writes needs the folder.

    Returns:
        The arrays of grid.npz; none in a process that writes nothing.

    Raises:
        StoreError: for a damaged chunk, before anything is computed.
        SimulatorError: for a simulator that always fails.
    """
    store, rounds = store_of(folder, work), work.grid.settings.rounds
    done = len(store.done()) if processes.writes else 0
    label = f"{work.grid.task.name}: {work.grid.size} runs in {len(store.chunks)} chunks of {work.length}"
    with RoundProgress(console, rounds * len(store.chunks), rounds * done, label) as progress:
        chunk = lambda places: run_chunk(work, places, progress.advance, progress.compiled, processes)
        store.compute(chunk, processes)
    if not processes.writes:
        return {}
    results, seconds = store.results()
    arrays = arranged(work.grid, results)
    finish(folder, work.grid, arrays, seconds)
    return arrays


def finish(folder: Path, grid: Grid, arrays: Mapping[str, np.ndarray], seconds: float) -> None:
    """Write the results, then mark the grid as complete."""
    atomic.write_arrays(folder / "grid.npz", arrays, durable=True)
    atomic.write_bytes(folder / "table.csv", table(grid, arrays).encode(), durable=True)
    workfolder.finish(folder, seconds=round(seconds, 3))


def table(grid: Grid, arrays: Mapping[str, np.ndarray]) -> str:
    """The results as CSV, one line per combination and seed; unknown values are left empty."""
    measures = ("theta_error", "trajectory_error", "success_rate")
    columns = [np.ravel(arrays[name]).tolist() for name in measures]
    places = itertools.product(combinations(grid.axes), grid.seeds)
    rows = (
        [*values.values(), seed, *("" if value != value else value for value in found)]
        for (values, seed), *found in zip(places, *columns, strict=True)
    )
    return text_table.as_csv([*(axis.name for axis in grid.axes), "seed", *measures], rows)
