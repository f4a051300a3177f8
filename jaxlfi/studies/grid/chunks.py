"""A grid's runs, as many at a time as memory allows, in one compiled program."""

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from jaxlfi.bayessim.batch import BatchEngine, RunInputs, stack_inputs, start_one
from jaxlfi.bayessim.host import engine_for
from jaxlfi.bayessim.memory import FRACTION, PROGRAM_PER_STATE, budget, even_length, state_bytes
from jaxlfi.bayessim.multi_process import SharedEngine
from jaxlfi.bayessim.record import theta_error, trajectory_error
from jaxlfi.bayessim.rounds import run_rounds
from jaxlfi.io.processes import ALONE, Processes
from jaxlfi.studies.grid.grid import Grid, grid_runs, observations

MEASURES = (
    "theta_error",
    "theta_error_by_parameter",
    "trajectory_error",
    "success_rate",
    "support_low",
    "support_high",
)
"""Quantities stored for each run."""
RUNS_PER_CORE = 64
"""Largest number of runs per device in a chunk on a CPU: more are not faster, and a crash loses at most one chunk."""


@dataclasses.dataclass(frozen=True)
class Work:
    """A grid with its observations, divided into chunks.

    Attributes:
        grid: the grid of runs.
        observed: observed trajectory of each seed, shape [seeds, T, C] or [seeds, T].
        x: summaries of the observations, shape [seeds, S].
        length: number of runs in a chunk.
    """

    grid: Grid
    observed: np.ndarray
    x: np.ndarray
    length: int


def chunk_inputs(work: Work, places: range) -> RunInputs:
    """Inputs of a chunk's runs (indices in the grid, in C order, seeds fastest), padded by repeating the last one."""
    filled = [places[min(i, len(places) - 1)] for i in range(work.length)]
    every, seeds = grid_runs(work.grid), [place % len(work.grid.seeds) for place in filled]
    inputs, _ = stack_inputs([every[place] for place in filled], work.observed[seeds], work.x[seeds])
    return inputs


def prepare(
    grid: Grid, observation: Any = None, runs_per_chunk: int | None = None, processes: Processes = ALONE
) -> Work:
    """Choose the chunks' length and compile; nothing is written.

    Args:
        grid: the grid of runs.
        observation: see `observations`.
        runs_per_chunk: number of runs in a chunk; by default as many as the available memory allows, on a CPU at most
            `RUNS_PER_CORE` for each device.
        processes: processes that share a chunk's runs.

    Raises:
        ValueError: for a length below 1, or one that the available memory does not allow.
    """
    if runs_per_chunk is not None and runs_per_chunk < 1:
        raise ValueError(f"runs_per_chunk: expected at least 1, got {runs_per_chunk}")
    observed, x = observations(grid, observation)
    free, devices = budget(), jax.local_device_count() * processes.count
    estimate = PROGRAM_PER_STATE * run_bytes(Work(grid, observed, x, 1))
    most = free * devices / estimate
    if jax.default_backend() == "cpu":
        most = min(most, RUNS_PER_CORE * devices)
    wanted = min(grid.size, runs_per_chunk or max(int(most), 1))
    # A state takes a tenth of the estimate: if not even the states fit into memory, nothing is compiled.
    if wanted * estimate / PROGRAM_PER_STATE > free * devices:
        raise _too_many(wanted, wanted * estimate / devices, free, runs_per_chunk)
    while True:
        work = Work(grid, observed, x, wanted if runs_per_chunk else even_length(grid.size, wanted, devices))
        needed = program_bytes(_engine(work, range(grid.size), processes))
        if needed <= free:
            return work
        if runs_per_chunk or work.length == 1:
            raise _too_many(work.length, needed, free, runs_per_chunk)
        wanted = max(1, int(0.9 * work.length * free / needed))


def _too_many(length: int, needed: float, free: float, given: int | None) -> ValueError:
    advice = "runs_per_chunk: expected fewer runs" if given else "settings: expected smaller runs"
    return ValueError(
        f"{advice} than fill the memory: {length} need {needed / 2**20:.4g} MiB a device, and "
        f"{FRACTION:.0%} of what is free is {free / 2**20:.4g} MiB"
    )


def run_bytes(work: Work) -> int:
    """Bytes of one run's inputs and state."""
    inputs = jax.tree.map(lambda leaf: leaf[0], chunk_inputs(work, range(1)))
    state = jax.eval_shape(functools.partial(start_one, work.grid.task, None), work.grid.settings, inputs)
    return state_bytes((state, inputs.observed, inputs.x))


def program_bytes(engine: BatchEngine | SharedEngine) -> int:
    """Compile, and return how many bytes a round needs on each device; 0 if the compiler does not say."""
    return max(map(_bytes, engine.compile(engine.start())))


def _bytes(program: Any) -> int:
    """Bytes that a program needs while it runs; 0 if the compiler does not say."""
    if (sizes := program.memory_analysis()) is None:
        return 0
    return (
        sizes.argument_size_in_bytes + sizes.output_size_in_bytes + sizes.temp_size_in_bytes - sizes.alias_size_in_bytes
    )


def _engine(work: Work, places: range, processes: Processes) -> BatchEngine | SharedEngine:
    return engine_for(work.grid.task, work.grid.settings, chunk_inputs(work, places), processes=processes)


def run_chunk(
    work: Work,
    places: range,
    on_round: Callable[[], Any] = lambda: None,
    on_compiled: Callable[[float], Any] = lambda seconds: None,
    processes: Processes = ALONE,
) -> tuple[dict[str, np.ndarray], float]:
    """Run one chunk.

    Args:
        work: the grid's work.
        places: indices of the chunk's runs in the grid.
        on_round: called at the end of each round.
        on_compiled: called with the time that compiling took, in s, if it took more than one second.
        processes: processes that share the runs.

    Returns:
        `MEASURES` of its runs, including the padding, and the time they took, in s; no measures in a process that
        writes nothing.

    Raises:
        SimulatorError: if no simulation of the first round succeeded.
    """
    engine, records = _engine(work, places, processes), []

    def keep(index, state, row, seconds):
        if not processes.writes:
            return
        records.append({name: row[name] for name in ("attempted", "succeeded")})
        records[0]["last"] = row
        on_round()

    compiled: list[float] = []
    began = time.perf_counter()
    run_rounds(engine, engine.start(), range(work.grid.settings.rounds), keep, compiled.append)
    seconds = time.perf_counter() - began - sum(compiled)
    if sum(compiled) > 1.0:  # later chunks reuse the program
        on_compiled(sum(compiled))
    if not processes.writes:
        return {}, seconds
    attempted, succeeded = (sum(record[name] for record in records) for name in ("attempted", "succeeded"))
    return last_round(records[0]["last"]) | {"success_rate": succeeded / attempted}, seconds


def last_round(row: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The final errors and supports of all runs in a round's record."""
    errors = row["sample_theta_error"]
    return {
        "theta_error": np.array([theta_error({"sample_theta_error": own}) for own in errors]),
        "theta_error_by_parameter": np.mean(errors, axis=1),
        "trajectory_error": np.array(
            [trajectory_error({"sample_trajectory_error": own}) for own in row["sample_trajectory_error"]]
        ),
        "support_low": row["support_low"],
        "support_high": row["support_high"],
    }


def arranged(grid: Grid, results: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The results of all runs as arrays with leading axes [axis..., seed], and the axes' values.

    Returns:
        `MEASURES`; `axes` with the names of the leading axes but the last, `values/NAME` for each, `seeds`; and the
        `names` of the parameters, along the last axis of errors by parameter and of supports.
    """
    return {
        "axes": np.asarray([axis.name for axis in grid.axes]),
        **{f"values/{axis.name}": np.asarray(axis.values) for axis in grid.axes},
        "seeds": np.asarray(grid.seeds),
        "names": np.asarray(grid.task.space.labels),
        **{name: results[name].reshape(*grid.shape, *results[name].shape[1:]) for name in MEASURES},
    }


def measure(grid: Grid, observation: Any = None, runs_per_chunk: int | None = None) -> dict[str, np.ndarray]:
    """Run a grid in memory, without a folder; see `arranged` for the results."""
    work = prepare(grid, observation, runs_per_chunk)
    chunks = [range(first, min(first + work.length, grid.size)) for first in range(0, grid.size, work.length)]
    parts = [{name: array[: len(places)] for name, array in run_chunk(work, places)[0].items()} for places in chunks]
    return arranged(grid, {name: np.concatenate([part[name] for part in parts]) for name in MEASURES})
