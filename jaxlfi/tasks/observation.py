"""The observed trajectory x^r: read from a file, checked against the simulator, or simulated at the truth."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.tasks.simulation import trajectory_and_outcome, with_outcome
from jaxlfi.tasks.task import Task

TRIES = 16
"""Simulations at the truth that may fail before a task counts as unable to simulate its own truth."""
TIME_COLUMNS = ("time", "t", "year", "step")
"""Headings of a first column that is not a channel."""


class SimulatorError(ValueError):
    """A simulator that breaks its contract, or fails always."""


@dataclasses.dataclass(frozen=True)
class Shapes:
    """What a task's simulator gives.

    Attributes:
        trajectory: shape of one trajectory.
        summary: length S of its summary.
    """

    trajectory: tuple[int, ...]
    summary: int


def simulator_shapes(task: Task) -> Shapes:
    """Trace a JAX simulator and its summary without running them.

    Raises:
        SimulatorError: if it cannot be traced, or gives something else than a trajectory (and a scalar
            outcome).
    """
    key = jax.eval_shape(lambda: jax.random.key(0))
    theta = jax.ShapeDtypeStruct((task.dim,), jnp.float32)
    # A simulator is foreign code; whatever it raises while traced is told in one line.
    try:
        result = jax.eval_shape(task.simulate, key, theta)
    except Exception as error:
        raise SimulatorError(
            f"simulate: expected a function JAX can trace (declare a NumPy simulator with black_box=True), "
            f"got {type(error).__name__}: {_first_line(error)}"
        ) from error
    trajectory, outcome = result if isinstance(result, tuple) and len(result) == 2 else (result, None)
    if not isinstance(trajectory, jax.ShapeDtypeStruct) or trajectory.ndim == 0:
        raise SimulatorError(
            f"simulate: expected one array [T] or [T, C], or (array, outcome), got {jax.tree.map(_shape, result)}"
        )
    if outcome is not None and getattr(outcome, "shape", None) != ():
        raise SimulatorError(f"simulate: expected a scalar outcome, got {jax.tree.map(_shape, outcome)}")
    return Shapes(trajectory.shape, _summary_size(task, trajectory.shape))


def observed_shapes(task: Task, observation: np.ndarray) -> Shapes:
    """The shapes of a black box, which only its observation tells before it has run."""
    if observation.ndim == 0:
        raise ValueError("observation: expected a trajectory [T] or [T, C], got a single number")
    return Shapes(observation.shape, _summary_size(task, observation.shape))


def _summary_size(task: Task, shape: tuple[int, ...]) -> int:
    try:
        summary = jax.eval_shape(task.summary, jax.ShapeDtypeStruct(shape, jnp.float32))
    except Exception as error:
        raise SimulatorError(
            f"summary: expected a function of one trajectory {list(shape)} that JAX can trace, "
            f"got {type(error).__name__}: {_first_line(error)}"
        ) from error
    if getattr(summary, "ndim", None) != 1:
        raise SimulatorError(f"summary: expected a vector [S] of one trajectory, got {jax.tree.map(_shape, summary)}")
    return summary.shape[0]


def checked(observation, shapes: Shapes) -> jax.Array:
    """An observation in the shape that the simulator produces.

    Raises:
        ValueError: for another shape, or numbers that are not finite.
    """
    if np.shape(observation) != shapes.trajectory:
        raise ValueError(
            f"observation: expected the shape the simulator produces, {list(shapes.trajectory)}, "
            f"got {list(np.shape(observation))}"
        )
    if not isinstance(observation, jax.core.Tracer) and not np.isfinite(np.asarray(observation, float)).all():
        raise ValueError("observation: expected finite numbers, got some that are not")
    return jnp.asarray(observation, jnp.float32)


def simulate_observation(key: jax.Array, task: Task) -> np.ndarray:
    """One valid trajectory at the task's truth, from the first of a few tries that succeeds.

    Raises:
        ValueError: where the truth is unknown.
        SimulatorError: where no try succeeds.
    """
    if task.truth is None:
        raise ValueError("observation: expected one, as the task has neither an observation nor a known truth")
    for attempt in range(TRIES):
        trajectory, failure = _at_truth(jax.random.fold_in(key, attempt), task)
        if failure == 0:
            return np.asarray(trajectory)
    raise SimulatorError(f"simulate: expected a valid simulation at the truth, got {TRIES} failures in {TRIES} tries")


def trace_observation(key: jax.Array, task: Task) -> jax.Array:
    """As `simulate_observation`, inside a traced function: the first try, whatever comes of it."""
    if task.truth is None:
        raise ValueError("observation: expected one, as the task has neither an observation nor a known truth")
    return trajectory_and_outcome(task, jax.random.fold_in(key, 0), task.truth)[0]


def _at_truth(key: jax.Array, task: Task):
    if not task.black_box:
        return _simulate_jit(task, key, task.truth)
    result = task.simulate(numpy_generator(key), np.asarray(task.to_natural(task.truth))[None])
    trajectory, outcome = result if isinstance(result, tuple) else (result, np.zeros(1, int))
    return with_outcome(task, jnp.asarray(trajectory)[0], jnp.asarray(outcome)[0])


_simulate_jit = jax.jit(trajectory_and_outcome, static_argnums=0)


def numpy_generator(key: jax.Array) -> np.random.Generator:
    """A NumPy generator seeded by a JAX key."""
    return np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())


def read(path: str | Path) -> np.ndarray:
    """Read a trajectory from a file.

    Args:
        path: a .csv with one row a record and one column a channel (a row of headings is allowed, and a first
            column headed time, t, year or step is left out), or an .npz with an array "trajectory" or one
            array only.

    Returns:
        The trajectory, shape [T, C]; of an .npz as it is.

    Raises:
        ValueError: for files that cannot be read.
    """
    path = Path(path)
    readers = {".csv": _read_csv, ".npz": _read_npz}
    if path.suffix not in readers:
        raise ValueError(f"observation: expected a .csv or .npz file, got {str(path)!r}")
    try:
        return readers[path.suffix](path)
    except Exception as error:  # zipfile, numpy and the operating system each have their own
        raise ValueError(f"observation: cannot read {str(path)!r}: {_first_line(error)}") from error


def fitted(trajectory: np.ndarray, shapes: Shapes) -> np.ndarray:
    """Drop or add an axis of length one where that is all that keeps a file from the simulator's shape."""
    squeezed = tuple(n for n in trajectory.shape if n != 1)
    wanted = tuple(n for n in shapes.trajectory if n != 1)
    return trajectory.reshape(shapes.trajectory) if squeezed == wanted else trajectory


def _read_csv(path: Path) -> np.ndarray:
    rows = [line.strip() for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    if not rows:
        raise ValueError("expected at least one row of numbers, got none")
    heading = [cell.strip().strip('"').lower() for cell in rows[0].split(",")]
    has_heading = not all(_is_number(cell) for cell in heading)
    table = np.array([[float(cell) for cell in row.split(",")] for row in rows[has_heading:]], np.float32)
    return table[:, 1:] if has_heading and heading[0] in TIME_COLUMNS and table.shape[1] > 1 else table


def _read_npz(path: Path) -> np.ndarray:
    with np.load(path, allow_pickle=False) as arrays:
        if "trajectory" in arrays:
            return np.asarray(arrays["trajectory"], np.float32)
        if len(arrays.files) == 1:
            return np.asarray(arrays[arrays.files[0]], np.float32)
        raise ValueError(f"expected an array called 'trajectory', got {arrays.files}")


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _shape(array) -> str:
    return str(getattr(array, "shape", type(array).__name__))


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]
