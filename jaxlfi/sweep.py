"""Sweep: how sensitive a heuristic is to its hyperparameters, as a grid of runs in compiled chunks.

Every combination of values and every seed is one lane of `jaxlfi.lanes`; the same seed means the same
observation in all combinations. Lanes are stepped in chunks of one length (the last is filled up by repeating
its last lane), so that one compiled program serves them all. A grid's folder:

    config.json            axes, settings, versions, and whether it is finished
    observation.npz        what each seed observed
    chunks/000.npz ...     what came out, chunk by chunk; one that is there is not computed again
    grid.npz               arrays with leading axes [axis..., seed]
    table.csv              one line a combination and seed

Where several processes were joined by `jax.distributed` they share the chunks out among them, each on its own
devices, and meet at the end; the folder must be one that all of them see.
"""

import csv
import dataclasses
import functools
import hashlib
import io
import itertools
import json
import math
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from rich.console import Console

from jaxlfi import atomic, describe, lanes, run_store, tasks
from jaxlfi.bayessim import Settings
from jaxlfi.heuristics import Heuristic, Matched
from jaxlfi.history import theta_error, trajectory_error
from jaxlfi.inference import check_heuristic, observe, refuse_hopeless
from jaxlfi.keys import run_keys
from jaxlfi.lanes import Lane, LaneEngine
from jaxlfi.presets import QUICK
from jaxlfi.progress import RoundProgress
from jaxlfi.run_store import StoreError
from jaxlfi.support import Support
from jaxlfi.task import Task

GRID = "jaxlfi-grid"
"""The format of a grid's folder."""
RANGES = {
    "zone_fraction": (0.0, 1.0),
    "zone_width": (0.0, math.inf),
    "tail": (0.0, 1.0),
    "mass_threshold": (0.0, 1.0),
    "expansion": (0.0, math.inf),
    "shift_threshold": (0.0, math.inf),
    "proximity": (0.0, 1.0),
}
"""What each hyperparameter can be, bounds included: fractions and masses lie in [0, 1], lengths are not negative."""
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
class Axis:
    """One hyperparameter and the values it takes, in the order of the grid."""

    name: str
    values: tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class Grid:
    """What to run: the product of `axes` and `seeds`.

    Attributes:
        task: a task whose simulator is in JAX.
        support: Theta_0, in coordinates.
        rule: the heuristic, with the hyperparameters that are on no axis.
        axes: hyperparameters and their values.
        seeds: of the runs; each has one observation in all combinations.
        settings: the same for all runs.
        reference: by which the task was found (`jaxlfi.tasks.load`).
        preset: the settings were made from.
        support_name: the support's name, or "own".

    Raises:
        ValueError: for axes that are empty, repeated or not of the heuristic, and values it does not accept.

    Example:
        >>> from envs.gaussian_linear import task  # doctest: +SKIP
        >>> axes = (Axis("mass_threshold", (0.001, 0.005)),)  # doctest: +SKIP
        >>> measure(Grid(task(), task().support("ok"), Edge(), axes, seeds=(0, 1)))  # doctest: +SKIP
    """

    task: Task
    support: Support
    rule: Heuristic
    axes: tuple[Axis, ...]
    seeds: tuple[int, ...]
    settings: Settings = QUICK
    reference: str = ""
    preset: str | None = None
    support_name: str = "own"

    def __post_init__(self):
        check_axes(self.rule, self.axes)
        check_heuristic(self.rule, self.task)
        self.settings.check()
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds: expected at least one, all different, got {self.seeds}")
        if self.task.black_box:
            raise ValueError(
                f"task: expected one whose simulator is in JAX, as a grid is one compiled program, got {self.task.name}"
            )

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values on each axis, and of seeds."""
        return (*(len(axis.values) for axis in self.axes), len(self.seeds))

    @property
    def size(self) -> int:
        """Number of lanes."""
        return math.prod(self.shape)


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


def parse_axes(texts: Iterable[str]) -> tuple[Axis, ...]:
    """Axes as the command line writes them, NAME=V,V,...

    Example:
        >>> parse_axes(["expansion=0.1,0.2"])
        (Axis(name='expansion', values=(0.1, 0.2)),)
    """
    return tuple(_parse_axis(text) for text in texts)


def _parse_axis(text: str) -> Axis:
    name, _, values = text.partition("=")
    try:
        return Axis(name, tuple(float(value) for value in values.split(",")))
    except ValueError:
        raise ValueError(f"vary: expected NAME=V,V,... with numbers, got {text!r}") from None


def hyperparameters(rule: Heuristic) -> dict[str, Any]:
    """A heuristic's hyperparameters and their default values, which are the paper's."""
    kind = type(rule.rule if isinstance(rule, Matched) else rule)
    return {field.name: field.default for field in dataclasses.fields(kind)}


def check_axes(rule: Heuristic, axes: Sequence[Axis]) -> None:
    """Refuse axes that are none, empty, repeated or foreign, and values that are repeated or out of range.

    Raises:
        ValueError: naming the axis.
    """
    names = [axis.name for axis in axes]
    if not names or len(set(names)) < len(names):
        raise ValueError(f"vary: expected at least one hyperparameter, each once, got {', '.join(names) or 'none'}")
    known = hyperparameters(rule)
    for axis in axes:
        if axis.name not in known:
            raise ValueError(
                f"vary: expected a hyperparameter that the heuristic has ({', '.join(known) or 'it has none'}), "
                f"got {axis.name!r}"
            )
        shown = ",".join(f"{value:g}" for value in axis.values)
        if len(set(np.float32(axis.values).tolist())) < max(len(axis.values), 1):  # lanes hold single precision
            raise ValueError(f"{axis.name}: expected at least one value, each once, got {shown or 'none'}")
        low, high = RANGES.get(axis.name, (-math.inf, math.inf))
        if not all(math.isfinite(value) and low <= value <= high for value in axis.values):
            raise ValueError(f"{axis.name}: expected finite numbers in [{low:g}, {high:g}], got {shown}")


def combinations(axes: Sequence[Axis]) -> list[dict[str, float]]:
    """Every combination of values by name, the last axis fastest.

    Example:
        >>> combinations([Axis("tail", (0.0, 1.0)), Axis("expansion", (0.2,))])
        [{'tail': 0.0, 'expansion': 0.2}, {'tail': 1.0, 'expansion': 0.2}]
    """
    names = [axis.name for axis in axes]
    return [dict(zip(names, values, strict=True)) for values in itertools.product(*(axis.values for axis in axes))]


def heuristics(rule: Heuristic, axes: Sequence[Axis]) -> list[Heuristic]:
    """A heuristic for each combination; `jaxlfi.stack` makes them one pytree to vmap over.

    Example:
        >>> from jaxlfi.heuristics import Edge
        >>> [edge.tail for edge in heuristics(Edge(), [Axis("tail", (0.0, 1.0))])]
        [0.0, 1.0]
    """
    return [_with_values(rule, values) for values in combinations(axes)]


def _with_values(rule: Heuristic, values: Mapping[str, float]) -> Heuristic:
    if isinstance(rule, Matched):
        return Matched(dataclasses.replace(rule.rule, **values))
    return dataclasses.replace(rule, **values)


def grid_lanes(grid: Grid) -> list[Lane]:
    """All lanes in C order of [axis..., seed]."""
    named = zip(combinations(grid.axes), heuristics(grid.rule, grid.axes), strict=True)
    return [
        Lane(
            " ".join(f"{name}={value:g}" for name, value in values.items()),
            grid.support_name,
            grid.support,
            rule,
            seed,
        )
        for values, rule in named
        for seed in grid.seeds
    ]


def observations(grid: Grid, observation: Any = None) -> tuple[np.ndarray, np.ndarray]:
    """Each seed's observed trajectory and its summary, stacked.

    Args:
        grid: for the task and the seeds.
        observation: one for all seeds; by default the task's, or one simulated at the truth for each.
    """
    keys = [run_keys(jax.random.key(seed)).observe for seed in grid.seeds]
    pairs = [observe(key, grid.task, observation) for key in keys]
    return tuple(np.stack([np.asarray(pair[i]) for pair in pairs]) for i in range(2))


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


def description(work: Work) -> dict[str, Any]:
    """All that the results depend on, as JSON values."""
    grid = work.grid
    run = run_store.run_config(
        task=grid.task,
        reference=grid.reference or grid.task.name,
        support_name=grid.support_name,
        support=grid.support,
        heuristic=grid.rule,
        preset=grid.preset,
        settings=grid.settings,
        seed=None,
    )
    left_out = ("configuration", "seed", "versions", "platform", "command_line", "started")
    defaults = hyperparameters(grid.rule)
    return {name: value for name, value in run.items() if name not in left_out} | {
        "format": GRID,
        "axes": [
            {
                "name": axis.name,
                "values": list(axis.values),
                "default": describe.plain_value(defaults[axis.name]),
            }
            for axis in grid.axes
        ],
        "seeds": list(grid.seeds),
        "lanes_per_chunk": work.length,
        "observation": _digest(
            *(np.ascontiguousarray(a) for a in (work.observed, work.x, np.asarray(grid.task.truth, np.float32)))
        ),
    }


def fingerprint(work: Work) -> str:
    """A hash of the description: chunks that bear another belong to another grid."""
    return _digest(json.dumps(description(work), sort_keys=True).encode())


def _digest(*parts) -> str:
    whole = hashlib.sha256()
    for part in parts:
        whole.update(part)
    return whole.hexdigest()[:32]


def begin(folder: Path, grid: Grid, observation: Any = None, lanes_per_chunk: int | None = None) -> Work:
    """Check all there is to check, compile, then bring the folder into being; nothing is written before.

    Args:
        folder: new or empty.
        grid: what to run.
        observation: see `observations`.
        lanes_per_chunk: see `prepare`.

    Raises:
        ValueError: for anything that does not fit.
    """
    if jax.process_index() == 0:
        run_store.refuse_occupied(folder)
        work = prepare(grid, observation, lanes_per_chunk)
        create(folder, work)
    _meet("begun")
    return work if jax.process_index() == 0 else reopen(folder)


def create(folder: Path, work: Work) -> None:
    """Bring the folder of a prepared work into being."""

    def fill(beside: Path) -> None:
        (beside / "chunks").mkdir()
        atomic.write_arrays(beside / "observation.npz", {"trajectory": work.observed, "x": work.x}, durable=True)

    run_store.create(
        folder,
        description(work)
        | run_store.environment()
        | {
            "status": "running",
            "devices": jax.local_device_count(),
            "runs": work.grid.size,
            "fingerprint": fingerprint(work),
        },
        fill,
    )


def is_grid(folder: Path) -> bool:
    """Whether a folder says that it is a grid's; whether it is sound is checked later."""
    try:
        config = json.loads((folder / "config.json").read_text())
    except (OSError, ValueError):
        return False
    return isinstance(config, dict) and config.get("format") == GRID


def read_config(folder: Path) -> dict[str, Any]:
    """The config.json of a grid.

    Raises:
        StoreError: if it is missing, damaged or of another version.
    """
    if not is_grid(folder):
        raise StoreError(f"expected the folder of a grid, got {str(folder)!r} whose config.json is not one's")
    config = json.loads((folder / "config.json").read_text())
    if config.get("version") != run_store.VERSION:
        raise StoreError(
            f"{folder / 'config.json'}: expected version {run_store.VERSION} of the format, got {config.get('version')}"
        )
    return config


def reopen(folder: Path) -> Work:
    """The work of a folder, at whatever point it was left; not compiled.

    Raises:
        StoreError: for a folder that is damaged or whose configuration or task has changed since it was begun.
    """
    config = read_config(folder)
    try:
        grid = Grid(
            task=tasks.load(config["task"]),
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
        work = Work(grid, start["trajectory"], start["x"], config["lanes_per_chunk"])
        told = json.loads(json.dumps(description(work)))
        same = fingerprint(work) == config["fingerprint"] and all(config.get(name) == told[name] for name in told)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise StoreError(f"{folder}: expected a complete description of a grid, got: {error}") from error
    if not same:
        raise StoreError(
            f"{folder}: expected config.json, observation.npz and the task as they were when the grid was begun, "
            "got changed ones: begin another grid in another folder"
        )
    return work


def chunk_path(folder: Path, index: int) -> Path:
    """Where a chunk's results are kept."""
    return folder / "chunks" / f"{index:03d}.npz"


def write_chunk(folder: Path, work: Work, index: int, arrays: Mapping[str, np.ndarray], seconds: float) -> None:
    """Keep what came out of a chunk, and whose it is."""
    label = {"fingerprint": np.asarray(fingerprint(work)), "seconds": np.asarray(seconds)}
    atomic.write_arrays(chunk_path(folder, index), {**arrays, **label}, durable=True)


def read_chunk(folder: Path, work: Work, index: int) -> dict[str, np.ndarray]:
    """What came out of a chunk.

    Raises:
        StoreError: for a file that is missing, damaged, incomplete or of another grid; it is left as it is.
    """
    path, lanes_there = chunk_path(folder, index), len(work.chunks[index])
    try:
        arrays = atomic.read_arrays(path)
    except ValueError as error:
        raise StoreError(f"{error}: delete it, and resuming computes it again") from error
    if str(arrays.get("fingerprint")) != fingerprint(work):
        raise StoreError(f"{path}: expected a chunk of this grid, got one of another")
    if not all(name in arrays and len(arrays[name]) == lanes_there for name in MEASURES):
        raise StoreError(f"{path}: expected {', '.join(MEASURES)} of {lanes_there} lanes, got others")
    return arrays


def advance(folder: Path, work: Work, console: Console) -> dict[str, np.ndarray]:
    """Compute the chunks that are not there yet, then write the results.

    Args:
        folder: made by `begin`, at whatever point it was left.
        work: the folder's.
        console: for progress.

    Returns:
        The arrays of grid.npz.

    Raises:
        StoreError: for a damaged chunk, before anything is computed.
        SimulatorError: for a simulator that fails always.
    """
    own = range(jax.process_index(), len(work.chunks), jax.process_count())
    done = [index for index in own if chunk_path(folder, index).exists()]
    for index in done:
        read_chunk(folder, work, index)
    rounds = work.grid.settings.rounds
    label = f"{work.grid.task.name}: {work.grid.size} runs in {len(work.chunks)} chunks of {work.length}"
    with RoundProgress(console, rounds * len(own), rounds * len(done), label) as progress:
        for index in own:
            if index in done:
                continue
            if work.engine is None:
                began = time.perf_counter()
                work, _ = compiled(work)
                progress.compiled(time.perf_counter() - began)
            began = time.perf_counter()
            arrays = run_chunk(work, index, progress.advance)
            write_chunk(folder, work, index, arrays, time.perf_counter() - began)
    _meet("chunks done")
    chunks = [read_chunk(folder, work, index) for index in range(len(work.chunks))]
    arrays = assemble(work.grid, chunks)
    if jax.process_index() == 0:
        finish(folder, work.grid, arrays, float(sum(chunk["seconds"] for chunk in chunks)))
    _meet("finished")
    return arrays


def finish(folder: Path, grid: Grid, arrays: Mapping[str, np.ndarray], seconds: float) -> None:
    """Write the results, and then that the grid is complete."""
    atomic.write_arrays(folder / "grid.npz", arrays)
    atomic.write_bytes(folder / "table.csv", table(grid, arrays).encode())
    config = read_config(folder)
    atomic.write_json(folder / "config.json", config | {"status": "finished", "seconds": round(seconds, 3)})


def table(grid: Grid, arrays: Mapping[str, np.ndarray]) -> str:
    """The results as CSV, one line a combination and seed; what is unknown stays empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    measures = ("theta_error", "trajectory_error", "success_rate")
    writer.writerow([*(axis.name for axis in grid.axes), "seed", *measures])
    columns = [np.ravel(arrays[name]).tolist() for name in measures]
    places = itertools.product(combinations(grid.axes), grid.seeds)
    for (values, seed), *results in zip(places, *columns, strict=True):
        writer.writerow([*values.values(), seed, *("" if value != value else value for value in results)])
    return text.getvalue()


def _meet(name: str) -> None:
    """Wait for the other processes, where there are some."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(f"jaxlfi sweep: {name}")
