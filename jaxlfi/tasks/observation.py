"""The observed trajectory x^r: read from a file, checked against the simulator, or simulated at the truth."""

import csv
import dataclasses
import datetime
import functools
import re
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.distributions.arguments import is_concrete
from jaxlfi.distributions.precision import single
from jaxlfi.io import files
from jaxlfi.tasks import own_arrays, purity
from jaxlfi.tasks.errors import SimulatorError
from jaxlfi.tasks.gaps import gaps_of, with_gaps
from jaxlfi.tasks.journal import Journal
from jaxlfi.tasks.record_times import JITTER, is_number, is_time, missing_records
from jaxlfi.tasks.reference import summaries_in_double
from jaxlfi.tasks.simulation import failure_code, trajectory_and_outcome
from jaxlfi.tasks.task import Task
from jaxlfi.tasks.trials import repeated, together

TRIES = 16
"""Simulations at the truth that may fail before a task counts as unable to simulate its own truth."""
MISSING = ("", "NA", "N/A", "null")
"""Cells of a table, besides NaN, that say that a number is missing."""


@dataclasses.dataclass(frozen=True)
class Shapes:
    """Shapes of what a task's simulator returns.

    Attributes:
        trajectory: shape of one trajectory.
        summary: length S of its summary.
    """

    trajectory: tuple[int, ...]
    summary: int


@functools.lru_cache(maxsize=64)
def simulator_shapes(task: Task) -> Shapes:
    """Trace a JAX simulator and its summary without running them.

    Raises:
        SimulatorError: if it cannot be traced, or returns anything but a trajectory (and a scalar outcome).
    """
    key = jax.eval_shape(lambda: jax.random.key(0))
    theta = jax.ShapeDtypeStruct((task.dim,), jnp.zeros(()).dtype)
    # A simulator is foreign code; what it raises while traced is reported in one line.
    try:
        result = purity.shapes(task.simulate, key, theta)
    except SimulatorError:
        raise
    except Exception as error:
        raise SimulatorError(
            f"simulate: expected a function JAX can trace (wrap a NumPy simulator in jaxlfi.HostSimulator), "
            f"got {type(error).__name__}: {files.first_line(error)}"
        ) from error
    trajectory, *outcome = result if isinstance(result, tuple) and len(result) == 2 else (result,)
    if not isinstance(trajectory, jax.ShapeDtypeStruct) or trajectory.ndim == 0 or trajectory.size == 0:
        raise SimulatorError(
            f"simulate: expected one array [T] or [T, C], or (array, outcome), got {jax.tree.map(_shape, result)}"
        )
    _require_real(trajectory, "simulate")
    for code in outcome:
        if getattr(code, "shape", None) != () or not (code.dtype == bool or jnp.issubdtype(code.dtype, jnp.integer)):
            got = code.dtype if getattr(code, "shape", None) == () else jax.tree.map(_shape, code)
            raise SimulatorError(
                f"simulate: expected a scalar outcome, a boolean (true: valid) or a whole number (0: valid), got {got}"
            )
    return Shapes(trajectory.shape, _summary_size(task, trajectory.shape))


def _require_real(array: jax.ShapeDtypeStruct, name: str) -> None:
    """Refuse complex numbers, keys and the like; booleans and whole numbers are real numbers, too."""
    if not (array.dtype == bool or any(jnp.issubdtype(array.dtype, kind) for kind in (jnp.floating, jnp.integer))):
        parts = " (stack its real and imaginary parts)" if jnp.issubdtype(array.dtype, jnp.complexfloating) else ""
        raise SimulatorError(f"{name}: expected real numbers, got {array.dtype}{parts}")


def observed_shapes(task: Task, observation: np.ndarray) -> Shapes:
    """The shapes of a host simulator, which only its observation tells before it has run."""
    if observation.ndim == 0:
        raise ValueError("observation: expected a trajectory [T] or [T, C], got a single number")
    if observation.size == 0:
        raise ValueError(
            f"observation: expected a trajectory [T] or [T, C] of at least one number, "
            f"got shape {list(observation.shape)}"
        )
    return Shapes(observation.shape, _summary_size(task, observation.shape))


def _summary_size(task: Task, shape: tuple[int, ...]) -> int:
    try:
        summary = purity.summary_shape(task.summary, jax.ShapeDtypeStruct(shape, jnp.float32))
    except SimulatorError:
        raise
    except Exception as error:
        raise SimulatorError(
            f"summary: expected a function of one trajectory {list(shape)} that JAX can trace, "
            f"got {type(error).__name__}: {files.first_line(error)}"
        ) from error
    if getattr(summary, "ndim", None) != 1 or summary.size == 0:
        raise SimulatorError(f"summary: expected a vector [S] of one trajectory, got {jax.tree.map(_shape, summary)}")
    _require_real(summary, "summary")
    return summary.shape[0]


def checked(observation: Any, shapes: Shapes, missing: np.ndarray | None = None) -> Any:
    """An observation in the shape that the simulator produces.

    Args:
        observation: a trajectory.
        shapes: of the simulator.
        missing: true where the task has gaps; None if it has none.

    Raises:
        ValueError: for another shape, or numbers that are not finite outside the gaps.
    """
    there = ... if missing is None else ~missing
    if np.shape(observation) != shapes.trajectory:
        raise ValueError(
            f"observation: expected the shape the simulator produces, {list(shapes.trajectory)}, "
            f"got {list(np.shape(observation))}"
        )
    if not isinstance(observation, jax.core.Tracer) and not np.isfinite(np.asarray(observation, float))[there].all():
        raise ValueError("observation: expected finite numbers (NaN where one is missing), got some that are not")
    return observation


def simulate_observation(key: jax.Array, task: Task) -> np.ndarray:
    """One valid trajectory at the task's truth, from the first of a few tries that succeeds.

    Raises:
        ValueError: if the truth is unknown.
        SimulatorError: if no try succeeds.
    """
    if task.truth is None:
        raise ValueError("observation: expected one, as the task has neither an observation nor a known truth")
    journal = Journal()
    for attempt in range(TRIES):
        trajectory, failure = _at_truth(jax.random.fold_in(key, attempt), task, journal)
        if failure == 0:
            return np.asarray(trajectory)
    raise SimulatorError(
        f"simulate: expected a valid simulation at the truth, got {TRIES} failures in {TRIES} tries"
        f"{journal.failure_messages}"
    )


def trace_observation(key: jax.Array, task: Task) -> jax.Array:
    """As `simulate_observation`, inside a traced function: the first try, which may have failed."""
    if task.inference.truth is None:
        raise ValueError("observation: expected one, as the task has neither an observation nor a known truth")
    return trajectory_and_outcome(task, jax.random.fold_in(key, 0), task.inference.truth)[0]


def _at_truth(key: jax.Array, task: Task, journal: Journal):
    truth: Any = task.inference.truth
    if not task.on_host:
        return _simulate_jit(task, key, truth)
    trajectory, outcome = task.simulate(key, np.asarray(task.space.to_natural(truth)), journal)
    return trajectory, failure_code(task, np.isfinite(trajectory).all(), np.asarray(outcome), np)


_simulate_jit = jax.jit(single(trajectory_and_outcome), static_argnums=0)


def observe(key: jax.Array, task: Task, observation: Any, concrete: bool = True) -> tuple[Any, Any]:
    """The observed trajectory, checked, and its summary; for a simulator on the host in double precision.

    Args:
        key: simulates it, if none is given and the task has none.
        task: for the simulator's shapes, and for the default.
        observation: what was given, or None.
        concrete: false inside a traced function.

    Raises:
        ValueError: for an observation that does not fit the simulator, or whose summary is not finite.
    """
    if observation is None:
        observation = task.observation
    if is_concrete(observation) and observation is not None:
        observation = _numbers(observation)
    if observation is None:
        simulate = simulate_observation if concrete else trace_observation
        observation = simulate(key, task)
    observed: Any
    if task.on_host:
        observed = np.array(checked(observation, observed_shapes(task, np.asarray(observation)), gaps_of(task)), float)
        x = summaries_in_double(task, observed[None])[0]
    else:
        observed = jnp.array(checked(observation, simulator_shapes(task), gaps_of(task)), jnp.float32)
        x = jnp.asarray(task.summary(observed), jnp.float32)
    if not isinstance(x, jax.core.Tracer) and not np.isfinite(np.asarray(x)).all():
        raise ValueError(f"observation: expected a finite summary, got {np.asarray(x).tolist()}")
    task.named_summaries(x.shape[-1])  # refuses unknown summary names
    return observed, x


def _numbers(observation: Any) -> np.ndarray:
    """A copy of the observation as real numbers, NaN where they are missing."""
    shown = lambda: textwrap.shorten(repr(observation), 200)
    try:
        array = own_arrays.array(observation)
    except ValueError as error:
        raise ValueError(f"observation: expected an array, got rows of several shapes in {shown()}") from error
    if array.dtype.kind not in "biuf":
        raise ValueError(f"observation: expected an array of numbers, got {shown()}")
    return array


def as_given(task: Task, observation: Any) -> Any:
    """An observation, or each of a list, as an array of the channels in their order; everything else unchanged.

    Whether there is an axis for a single channel depends on the task's simulator; a host simulator's result follows
    the observation.

    Raises:
        ValueError: for frames whose columns have names other than the channels'.
    """
    if hasattr(observation, "columns") and hasattr(observation, "to_numpy"):
        observation = _of_frame(observation, Columns.of(task))
    trials = isinstance(observation, list | tuple)
    if trials and any(hasattr(one, "shape") for one in observation):
        return [as_given(task, one) if len(np.shape(one)) > 1 else one for one in observation]
    if observation is None or task.on_host:
        return observation
    if trials and all(_is_single(one) for one in observation):  # records of one channel
        observation = _numbers(observation)
    length, *channel = simulator_shapes(task).trajectory
    if hasattr(observation, "shape") and tuple(observation.shape) == ((length,) if channel == [1] else (length, 1)):
        array = _numbers(observation) if is_concrete(observation) else observation
        return array.reshape(length, *channel) if channel in ([], [1]) else observation
    return observation


def _is_single(record: Any) -> bool:
    """Whether a record is one number, or a list of one."""
    while isinstance(record, list | tuple) and len(record) == 1:
        record = record[0]
    return not isinstance(record, list | tuple) and np.shape(record) in ((), (1,))


def _of_frame(frame: Any, columns: "Columns") -> np.ndarray:
    """The channels of a pandas or polars data frame; named columns are matched by name."""
    named = all(isinstance(name, str) for name in frame.columns)
    headings = list(frame.columns) if named else []
    if columns.names and set(columns.names) <= set(headings) and len(set(headings)) == len(headings):
        table = own_arrays.array(frame[list(columns.names)])  # others may be dates
        first = np.asarray(frame[headings[0]])
        timed = headings[0] not in columns.names and is_time(headings[0]) and first.dtype.kind in "iuf"
        return _with_missing_records(table, first if timed else None, columns, lambda line: None)
    try:
        table = _channels(headings, own_arrays.array(frame), columns, lambda line: None)
    except ValueError as error:
        raise ValueError(f"observation: {error}") from error
    if headings and len(columns.names) > 1:
        raise ValueError(
            f"observation: expected columns {', '.join(columns.names)}, got {', '.join(headings)}: rename them, or "
            "pass frame.to_numpy() to have them taken in their order"
        )
    return table


def trials_of(task: Task, observation: Any, pooling: str = "moments") -> tuple[Task, Any]:
    """The task and observation of an inference: for a list of trajectories, those of all of them together.

    A simulator in JAX tells whether a list holds trajectories or the records of one. For a host simulator, whose shapes
    are not known yet, a list of lists is one trajectory, and a list of arrays [T, C] are trials. Trials of different
    lengths are padded with NaN, which counts as missing.

    Raises:
        ValueError: for a list of vectors that may be either.
    """
    observation = as_given(task, observation)
    if not isinstance(observation, list | tuple) or not observation:
        return task, observation
    if is_concrete(observation):
        for one in observation:
            _numbers(one)
    shapes = {np.shape(one) for one in observation}
    first, length = np.shape(observation[0]), None
    if task.on_host:
        trials = hasattr(observation[0], "shape") and (len(first) != 1 or _vectors_are_trials(task, observation))
    else:
        length, *rest = simulator_shapes(task).trajectory
        trials = all(shape[1:] == tuple(rest) and shape[0] <= length for shape in shapes if shape) and () not in shapes
        trials &= len(shapes) > 1 or first == (length, *rest)
    if not trials or first == ():
        return task, observation
    return repeated(task, len(observation), pooling), together(observation, length)


def _vectors_are_trials(task: Task, vectors: Sequence[Any]) -> bool:
    """Whether vectors are trials [T] rather than the records [C] of one trial, by the task's times and channels."""
    count, length = len(vectors), len(vectors[0])
    steps, channels = 0 if task.times is None else len(task.times), len(task.channels)
    as_records = steps in (0, count) and channels in (0, length)
    as_trials = steps in (0, length) and channels in (0, 1)
    if as_records == as_trials:
        raise ValueError(
            f"observation: expected one array for a host simulator, got a list of {count} of shape [{length}]: pass "
            f"np.stack(...) for {count} records of one trajectory, or np.concatenate(...) with the task "
            f"jaxlfi.repeated(task, {count}) for {count} trials"
        )
    return as_trials


def with_gaps_of(task: Task, observation: Any, keep_places: bool = False) -> Task:
    """The task with the gaps of an observation, where NaN means missing; the given one if there are none.

    Args:
        task: of a whole recording, or with gaps already.
        observation: a trajectory; None for the task's own.
        keep_places: see `jaxlfi.tasks.gaps.with_gaps`.
    """
    observation = task.observation if observation is None else observation
    if observation is None or not is_concrete(observation) or gaps_of(task) is not None:
        return task
    numbers = _numbers(observation)
    return with_gaps(task, np.isnan(numbers), keep_places) if numbers.dtype.kind == "f" else task


Say = Callable[[str], Any]
"""Called with a line on how the columns of a file were read."""


@dataclasses.dataclass(frozen=True)
class Columns:
    """What is known of the channels before a file is read.

    Attributes:
        names: of the channels, in their order; empty if they have none.
        count: number of channels; None if only a simulation shows it.
        records: function that is called if a table may lack records, for their expected number; None if unknown.
    """

    names: tuple[str, ...] = ()
    count: int | None = None
    records: Callable[[], int | None] = dataclasses.field(default=lambda: None, compare=False)

    @staticmethod
    def of(task: Task, trials: int = 1) -> "Columns":
        """The columns of a task, in a table of one of its trials."""
        if task.on_host:
            records = functools.partial(_records_on_host, task, trials)
            return Columns(tuple(task.channels), len(task.channels) or None, records)
        shape = simulator_shapes(task).trajectory
        count = shape[-1] if len(shape) > 1 else 1
        names = tuple(task.channels) if len(task.channels) == count else ()
        return Columns(names, count, lambda: shape[0] // trials)


def _records_on_host(task: Task, trials: int) -> int | None:
    """Records of a trial, from the task's times or a simulation in the middle of its first support."""
    if task.times is not None:
        return len(task.times) // trials
    support = task.support(next(iter(task.supports)))
    middle = np.asarray(task.space.to_natural(support.centre))
    try:
        trajectory, _ = task.simulate(jax.random.key(0), middle, Journal())
    except SimulatorError:  # the run will report it
        return None
    return len(trajectory) // trials or None


def read(path: str | Path, columns: Columns = Columns(), say: Say = lambda line: None) -> np.ndarray:
    """Read a trajectory from a file.

    Args:
        path: a .csv with one row per record and one column per channel (a row of headings is allowed, and a first
            column of times or indices is left out if its heading is one of
            `jaxlfi.tasks.record_times.TIME_COLUMNS`, its values increase, and fewer columns are expected), or an .npz
            with an array "trajectory" or only one array.
        columns: what is known of the channels; headings that name all of them determine their columns.
        say: called with a line that names the columns left out, and one on missing records.

    Returns:
        The trajectory, shape [T, C], with NaN in records that are missing according to a first column of times
        (`missing_records`); that of an .npz is unchanged.

    Raises:
        ValueError: for files that cannot be read.
    """
    path = Path(path)
    if path.suffix.lower() not in (".csv", ".npz"):
        raise ValueError(f"observation: expected a .csv or .npz file, got {str(path)!r}")
    try:
        if path.suffix.lower() == ".npz":
            return _read_npz(path)
        return _channels(*_read_csv(path), columns, lambda line: say(f"observation: {path}: {line}"))
    except Exception as error:  # zipfile, numpy and the operating system each raise their own
        text = files.first_line(error)
        raise ValueError(f"observation: expected a readable file, got {str(path)!r}: {text}") from error


def read_for(task: Task, *paths: str | Path, say: Say = lambda line: None) -> np.ndarray:
    """A trajectory from a file, in the shape of the task's simulator if that is known before it has run.

    Several files are the trials of a repeated task (`jaxlfi.repeated`), one after another. `say` is as of `read`.
    """
    every = [read(path, Columns.of(task, len(paths)), say) for path in paths]
    trajectory = together(every, None if task.on_host else simulator_shapes(task).trajectory[0] // len(every))
    if task.on_host:
        return trajectory
    shape = simulator_shapes(task).trajectory
    long = lambda lengths: [length for length in lengths if length != 1]
    return trajectory.reshape(shape) if long(trajectory.shape) == long(shape) else trajectory


def _read_csv(path: Path) -> tuple[list[str], np.ndarray]:
    """The headings, if there are any, and the numbers."""
    with path.open(newline="", encoding="utf-8-sig") as file:  # drops a byte-order mark from the first cell
        lines = [line for line in file if not line.startswith("#")]
        rows = [[cell.strip() for cell in row] for row in csv.reader(lines) if any(cell.strip() for cell in row)]
    if not rows:
        raise ValueError("expected at least one row of numbers, got none")
    numbers_in_first = [is_number(cell) for cell in rows[0]]
    has_heading = not any(numbers_in_first)
    if not has_heading and not all(numbers_in_first):
        raise ValueError(f"expected a row of headings or a row of numbers first, got {','.join(rows[0])!r}")
    width = len(rows[0])
    timed = has_heading and is_time(rows[0][0])
    if timed:
        rows[1:] = [[_without_date(first), *others] for first, *others in rows[1:]]
    for number, row in enumerate(rows[has_heading:], start=1 + has_heading):
        if len(row) != width or not all(cell in MISSING or is_number(cell) for cell in row):
            dates = ", where a date is written as 2024-03-31 or 2024-W13" if timed and not is_number(row[0]) else ""
            raise ValueError(f"expected {width} numbers in row {number}{dates}, got {','.join(row)!r}")
    if has_heading and len(rows) == 1:
        raise ValueError("expected at least one row of numbers, got headings only")
    return rows[0] if has_heading else [], np.array(
        [[float("nan" if cell in MISSING else cell) for cell in row] for row in rows[has_heading:]]
    )


def _without_date(cell: str) -> str:
    """A date such as 1978-01-22, also with a time of day, or 1978-W03, in seconds since 1970; other cells unchanged."""
    try:
        if week := re.fullmatch(r"(\d{4})-?W(\d{2})", cell):
            cell = datetime.date.fromisocalendar(int(week[1]), int(week[2]), 1).isoformat()
        if not re.match(r"\d{4}-\d{2}", cell):
            return cell
        return str(np.datetime64(cell.removesuffix("Z").strip(), "us").astype(float) / 1e6)
    except ValueError:
        return cell


def _channels(headings: list[str], table: np.ndarray, columns: Columns, say: Say) -> np.ndarray:
    """The columns of a table that are channels, in their order."""
    if columns.names and set(columns.names) <= set(headings) and len(set(headings)) == len(headings):
        places = [headings.index(name) for name in columns.names]
        timed = 0 not in places and is_time(headings[0])
        if timed:
            say(f"the first column, {headings[0]!r}, is taken as the time and skipped")
        if left_out := [repr(name) for name in headings[timed:] if name not in columns.names]:
            say(f"{', '.join(left_out)} left out: no channel has that name")
        if places != sorted(places):
            say(f"columns matched by name, in the order {', '.join(columns.names)}")
        return _with_missing_records(table[:, places], table[:, 0] if timed else None, columns, say)
    lacking = [name for name in columns.names if name not in headings]
    if 0 < len(lacking) < len(columns.names):
        raise ValueError(f"expected columns {', '.join(columns.names)}, got none for {', '.join(lacking)}")
    if table.shape[1] > 1 and headings and is_time(headings[0]) and np.all(np.diff(table[:, 0]) > 0):
        if table.shape[1] != columns.count:
            say(f"the first column, {headings[0]!r}, is taken as the time and skipped")
            return _with_missing_records(table[:, 1:], table[:, 0], columns, say)
        say(f"the first column, {headings[0]!r}, is taken as a channel, because {columns.count} columns are expected")
    return table


def _with_missing_records(table: np.ndarray, times: np.ndarray | None, columns: Columns, say: Say) -> np.ndarray:
    """A table [R, C] with all records [T, C], NaN in those that its times lack; otherwise unchanged."""
    steps = np.diff(times) if times is not None else np.zeros(0)
    uneven = len(steps) > 1 and steps.min() > 0 and steps.max() > (2 - JITTER) * np.median(steps)
    records = columns.records() if uneven else None
    missing = None if times is None or records is None else missing_records(times, records)
    if missing is None:
        return table
    say(f"{missing.sum()} of {len(missing)} records are missing, as the times show; they count as missing values")
    whole = np.full((len(missing), table.shape[1]), np.nan)
    whole[~missing] = table
    return whole


def _read_npz(path: Path) -> np.ndarray:
    arrays = files.read_arrays(path)
    if "trajectory" not in arrays and len(arrays) != 1:
        raise ValueError(f"expected an array called 'trajectory', got {list(arrays)}")
    array = arrays.get("trajectory", next(iter(arrays.values())))
    if array.dtype.kind not in "biuf":
        raise ValueError(f"expected real numbers, got an array of type {array.dtype}")
    return np.asarray(array, float)


def _shape(array) -> str:
    return str(getattr(array, "shape", type(array).__name__))
