"""Chunks: a grid's lanes, as many at a time as the memory has room for, through one compiled program."""

import dataclasses
import functools
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxlfi.bayessim.algorithm import batch as lanes
from jaxlfi.bayessim.batch import LaneEngine
from jaxlfi.bayessim.record import theta_error, trajectory_error
from jaxlfi.runs.inference import refuse_hopeless
from jaxlfi.studies.grid.grid import Grid, grid_lanes, observations

MEASURES = (
    "theta_error",
    "theta_error_by_parameter",
    "trajectory_error",
    "success_rate",
    "support_low",
    "support_high",
)
"""What is kept of each lane."""
PROGRAM_PER_STATE = 10
"""Bytes a compiled round needs for each byte of its lanes' states: 7 for the `quick` preset on Lotka-Volterra."""
SHARE = 0.6
"""Of the memory at hand; other processes want some, and the estimate is one."""
LANES_A_CORE = 64
"""On a CPU more lanes in a chunk are not faster, and a chunk is what a crash can lose."""


@dataclasses.dataclass(frozen=True)
class Work:
    """A grid with its observations, divided into chunks.

    Attributes:
        grid: what to run.
        observed: the observed trajectory of each seed, shape [seeds, T, C] or [seeds, T].
        x: their summaries, shape [seeds, S].
        length: lanes in a chunk.
        engine: compiled for chunks of that length; None before that was needed.
    """

    grid: Grid
    observed: np.ndarray
    x: np.ndarray
    length: int
    engine: "ChunkEngine | None" = None

    @property
    def chunks(self) -> list[range]:
        """Places in the grid (C order, seeds fastest) that each chunk has."""
        return [
            range(first, min(first + self.length, self.grid.size)) for first in range(0, self.grid.size, self.length)
        ]


class ChunkEngine(LaneEngine):
    """An engine whose compiled program is used for one chunk after another."""

    def load(self, inputs: lanes.Inputs) -> None:
        """Take the inputs of another chunk of as many lanes."""
        self._inputs = self.place(inputs)

    def compile_round(self) -> int:
        """Compile, and tell how many bytes a round needs on each device."""
        self.compile(self.start())
        sizes = self._round.memory_analysis()
        if sizes is None:
            return 0
        return (
            sizes.argument_size_in_bytes
            + sizes.output_size_in_bytes
            + sizes.temp_size_in_bytes
            - sizes.alias_size_in_bytes
        )

    @property
    def devices(self) -> int:
        """How many devices the lanes are divided over."""
        return self._mesh.size


def chunk_inputs(work: Work, places: Sequence[int]) -> lanes.Inputs:
    """Inputs of a chunk's lanes, the last one repeated up to the chunk's length."""
    filled = [places[min(i, len(places) - 1)] for i in range(work.length)]
    every, seeds = grid_lanes(work.grid), [place % len(work.grid.seeds) for place in filled]
    inputs, _ = lanes.stack_inputs([every[place] for place in filled], work.observed[seeds], work.x[seeds])
    return inputs


def prepare(grid: Grid, observation: Any = None, lanes_per_chunk: int | None = None) -> Work:
    """Choose the chunks' length and compile; nothing is written.

    Args:
        grid: what to run.
        observation: see `observations`.
        lanes_per_chunk: by default as many as the memory at hand has room for, on a CPU at most `LANES_A_CORE` for
            each device.

    Raises:
        ValueError: for a length below 1, or one that the memory at hand has no room for.
    """
    if lanes_per_chunk is not None and lanes_per_chunk < 1:
        raise ValueError(f"lanes_per_chunk: expected at least 1, got {lanes_per_chunk}")
    observed, x = observations(grid, observation)
    budget = SHARE * free_memory(jax.local_devices())
    devices = jax.local_device_count()
    estimate = PROGRAM_PER_STATE * lane_bytes(Work(grid, observed, x, 1))
    most = budget * devices / estimate
    if jax.default_backend() == "cpu":
        most = min(most, LANES_A_CORE * devices)
    wanted = min(grid.size, lanes_per_chunk or max(int(most), 1))
    # A state takes a tenth of the estimate: what cannot hold even the states is not worth compiling.
    if wanted * estimate / PROGRAM_PER_STATE > budget * devices:
        raise _too_many(wanted, wanted * estimate / devices, budget, lanes_per_chunk)
    while True:
        work = Work(grid, observed, x, wanted if lanes_per_chunk else even_length(grid.size, wanted, devices))
        work, needed = compiled(work)
        if needed <= budget:
            return work
        if lanes_per_chunk or work.length == 1:
            raise _too_many(work.length, needed, budget, lanes_per_chunk)
        wanted = max(1, int(0.9 * work.length * budget / needed))


def _too_many(length: int, needed: float, budget: float, given: int | None) -> ValueError:
    advice = "lanes_per_chunk: expected fewer lanes" if given else "settings: expected runs"
    return ValueError(
        f"{advice} than fill the memory: {length} need {needed / 2**20:.4g} MiB a device, and "
        f"{SHARE:.0%} of what is free is {budget / 2**20:.4g} MiB"
    )


def even_length(size: int, most: int, devices: int) -> int:
    """The length of the fewest equal chunks of at most `most` lanes, a multiple of the devices where it can be.

    Example:
        >>> even_length(size=27, most=20, devices=2)
        14
    """
    step = devices if most >= devices else 1
    chunks = math.ceil(size / (most // step * step))
    return min(size, step * math.ceil(size / chunks / step))


def lane_bytes(work: Work) -> int:
    """Bytes of one lane's inputs and state."""
    inputs = jax.tree.map(lambda leaf: leaf[0], chunk_inputs(work, [0]))
    state = jax.eval_shape(functools.partial(lanes.start_one, work.grid.task, work.grid.settings), inputs)
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves((state, inputs.observed, inputs.x)))


def free_memory(devices: Sequence[Any]) -> float:
    """Bytes free on each device; the devices of a CPU share the machine's memory."""
    stats = [device.memory_stats() for device in devices]
    if all(stats):
        return min(own["bytes_limit"] - own["bytes_in_use"] for own in stats)
    return _host_memory() / len(devices)


def _host_memory() -> float:
    """What the system calls available, within the limit of the control group."""
    free = [0.5 * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")]  # where the system tells no more
    meminfo, group = Path("/proc/meminfo"), Path("/sys/fs/cgroup")
    if meminfo.exists():
        free = [
            1024.0 * int(line.split()[1])
            for line in meminfo.read_text().splitlines()
            if line.startswith("MemAvailable")
        ]
    try:
        limit, used = ((group / name).read_text().strip() for name in ("memory.max", "memory.current"))
        free.append(float(int(limit) - int(used)))
    except (OSError, ValueError):  # no control group, or one without a limit ("max")
        pass
    return min(free)


def compiled(work: Work) -> tuple[Work, int]:
    """The work with an engine, and the bytes a round needs on each device."""
    engine = ChunkEngine(work.grid.task, work.grid.settings, chunk_inputs(work, work.chunks[0]))
    needed = engine.compile_round()
    return dataclasses.replace(work, engine=engine), needed


def run_chunk(work: Work, index: int, each_round: Callable[[], None] = lambda: None) -> dict[str, np.ndarray]:
    """Run one chunk of a compiled work.

    Args:
        work: with its engine.
        index: the chunk.
        each_round: called as each round ends.

    Returns:
        `MEASURES` of its lanes, without those that fill it up.

    Raises:
        SimulatorError: if no simulation of the first chunk's first round succeeded.
    """
    places = work.chunks[index]
    engine, settings = work.engine, work.grid.settings
    engine.load(chunk_inputs(work, places))
    attempted = succeeded = 0
    for number, _, rows in lanes.rounds(engine, engine.start(), 0, settings.rounds):
        attempted, succeeded = attempted + rows["attempted"], succeeded + rows["succeeded"]
        if number == index == 0:
            refuse_hopeless(rows["succeeded"], rows["failed"], work.grid.task)
        each_round()
    arrays = last_round(rows) | {"success_rate": succeeded / attempted}
    return {name: arrays[name][: len(places)] for name in MEASURES}


def last_round(rows: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The final errors and supports of all lanes in a round's record."""
    errors = rows["sample_theta_error"]
    return {
        "theta_error": np.array([theta_error({"sample_theta_error": own}) for own in errors]),
        "theta_error_by_parameter": np.mean(errors, axis=1),
        "trajectory_error": np.array(
            [trajectory_error({"sample_trajectory_error": own}) for own in rows["sample_trajectory_error"]]
        ),
        "support_low": rows["support_low"],
        "support_high": rows["support_high"],
    }


def assemble(grid: Grid, chunks: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """All chunks as arrays with leading axes [axis..., seed], and the axes' values.

    Returns:
        `MEASURES`; `axes` with the names of the leading axes but the last, `values/NAME` for each, `seeds`; and
        `names` of the parameters, which the last axis of errors by parameter and of supports is over.
    """
    joined = {name: np.concatenate([chunk[name] for chunk in chunks]) for name in MEASURES}
    return {
        "axes": np.asarray([axis.name for axis in grid.axes]),
        **{f"values/{axis.name}": np.asarray(axis.values) for axis in grid.axes},
        "seeds": np.asarray(grid.seeds),
        "names": np.asarray(grid.task.coordinates),
        **{name: array.reshape(*grid.shape, *array.shape[1:]) for name, array in joined.items()},
    }


def measure(grid: Grid, observation: Any = None, lanes_per_chunk: int | None = None) -> dict[str, np.ndarray]:
    """Run a grid in memory, without a folder; see `assemble` for what is returned."""
    work = prepare(grid, observation, lanes_per_chunk)
    return assemble(grid, [run_chunk(work, index) for index in range(len(work.chunks))])
