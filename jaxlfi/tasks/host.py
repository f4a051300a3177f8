"""Host simulators: plain Python or NumPy, called outside compiled programs."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import Any

import cloudpickle
import jax
import numpy as np

from jaxlfi.distributions.arguments import is_concrete
from jaxlfi.tasks import own_arrays
from jaxlfi.tasks.dispatch import alive, here, simulate_each, stacked, through
from jaxlfi.tasks.errors import SimulatorError
from jaxlfi.tasks.journal import Journal
from jaxlfi.tasks.worker import REASONS, Answer, Request, as_observed, simulated


@dataclasses.dataclass(frozen=True)
class HostSimulator:
    """A simulator that JAX cannot trace, as `Task.simulate`.

    It can replace a JAX simulator everywhere except inside `jit` and `vmap`: the run then steps its rounds on the host,
    and calls the simulator between the compiled parts of a round.

    Attributes:
        function: `function(rng, theta[N, D]) -> trajectories [N, ...]` or `-> (trajectories, outcomes [N])`, with a
            `numpy.random.Generator` and N parameter vectors in natural units; outcomes as in `jaxlfi.Task`. The
            parameters are a copy, which it may change, and its result is copied, so it may reuse the memory in the next
            call. A simulation with masked entries counts as not finite.
        each: whether the function makes a single simulation, `function(rng, theta[D]) -> trajectory` or `->
            (trajectory, outcome)`. Each simulation then has its own generator. One that raises, returns another shape,
            takes too long or kills its process counts as failed for that reason (`REASONS`), and the run goes on.
        timeout: time limit of a simulation in seconds, with `each`; None: no limit.
        executor: runs the simulations, with `each`; None: one after another. It does not affect results.

    Raises:
        ValueError: for a timeout or an executor of a simulator of batches, and a timeout that is not positive.

    Example:
        >>> simulator = HostSimulator(lambda rng, theta: theta + rng.normal(size=theta.shape))
        >>> trajectory, outcome = simulator(jax.random.key(0), np.zeros(3))
        >>> trajectory.shape, int(outcome)
        ((3,), 0)
    """

    function: Callable[..., Any]
    each: bool = False
    timeout: float | None = None
    executor: Executor | None = dataclasses.field(default=None, compare=False, repr=False)

    def __post_init__(self):
        if not isinstance(self.each, bool):
            raise ValueError(f"each: expected True or False, got {self.each!r}")
        if not self.each and (self.timeout is not None or self.executor is not None):
            raise ValueError("each: expected True where there is a timeout or an executor, got False")
        known = isinstance(self.timeout, int | float) and not isinstance(self.timeout, bool)
        if self.timeout is not None and not (known and 0 < self.timeout < math.inf):
            raise ValueError(f"timeout: expected a number of seconds above 0, got {self.timeout!r}")

    @property
    def reasons(self) -> tuple[str, ...]:
        """Failure reasons besides the task's own."""
        return REASONS if self.each else ()

    def __call__(self, key: jax.Array, theta: Any, journal: Journal | None = None) -> tuple[np.ndarray, np.ndarray]:
        """One simulation: its trajectory, and 0 or the code of the reason why it failed.

        Args:
            key: seeds the simulator's generator.
            theta: in natural units, shape [D].
            journal: records failures, with `each`.

        Raises:
            SimulatorError: if the simulator raises or gives other shapes, or inside a traced function.
        """
        if not is_concrete((key, theta)):
            raise SimulatorError("simulate: expected concrete arguments for a host simulator, which cannot be traced")
        if self.each:
            (answer,) = self.some(key, np.asarray(theta)[None], journal=journal)
            return answer.trajectory, np.asarray(answer.outcome)
        trajectories, outcomes = self.batch(key, np.asarray(theta)[None])
        return trajectories[0], outcomes[0]

    def some(
        self,
        key: Any,
        theta: np.ndarray,
        shape: Sequence[int] | None = None,
        rows: Sequence[int] | None = None,
        wanted: int | None = None,
        journal: Journal | None = None,
    ) -> list[Answer]:
        """Simulate parameter vectors one by one, with `each`, until enough have succeeded (`simulate_each`).

        Args:
            key: with its row, seeds the generator of a simulation.
            theta: in natural units, shape [A, D].
            shape: of a trajectory; None if it is not known yet.
            rows: which of them, in their order; all by default.
            wanted: number of successes; by default all are simulated.
            journal: has earlier simulations, and records new ones.

        Returns:
            The answers for the first of the rows, as many as were made.

        Raises:
            ExecutorError: if the executor is lost.
            SimulatorError: if its workers cannot load the simulator.
        """
        rows = range(len(theta)) if rows is None else rows
        words, numbers = np.asarray(jax.random.key_data(key)).tolist(), np.asarray(theta, np.float32).tolist()
        shape = None if shape is None else list(shape)
        requests = [Request(words, int(row), numbers[row], shape) for row in rows]
        journal = journal or Journal()
        if self.executor is not None:
            return self._through(self.executor, requests, wanted, journal)
        if self.timeout is None:
            return simulate_each(here(lambda request: simulated(self.function, request)), requests, wanted, journal, 1)
        with ThreadPoolExecutor(1) as executor:  # only a separate process can be ended when it hangs
            return self._through(executor, requests, wanted, journal)

    def _through(
        self, executor: Executor, requests: list[Request], wanted: int | None, journal: Journal
    ) -> list[Answer]:
        submit = through(executor, self._payload, self.timeout)
        return simulate_each(submit, requests, wanted, journal, alive=functools.partial(alive, executor))

    @functools.cached_property
    def _payload(self) -> bytes:
        """The function as it is sent to other processes."""
        try:
            return cloudpickle.dumps(self.function)
        except Exception as error:
            raise SimulatorError(
                "simulate: expected a function that can be sent to another process, "
                f"got {type(error).__name__}: {error}"
            ) from error

    def batch(
        self, key: jax.Array | np.random.Generator, theta: np.ndarray, shape: Sequence[int] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Simulate parameter vectors, and check the result.

        Args:
            key: seeds the simulator's generator; or a generator to continue with.
            theta: in natural units, shape [N, D].
            shape: of a trajectory; None if it is not known yet. Axes of length one are added or dropped.

        Returns:
            Trajectories [N, *shape] and outcomes [N], 0 for success.

        Raises:
            SimulatorError: if the simulator raises, or gives other shapes.
        """
        if self.each:
            if shape is None:
                raise SimulatorError("simulate: expected a known shape of trajectories, got none")
            return stacked(self.some(key, theta, shape), shape)
        rng = key if isinstance(key, np.random.Generator) else numpy_generator(key)
        rows = len(theta)
        try:
            result = self.function(rng, np.array(theta))
            paired = isinstance(result, tuple) and len(result) == 2
            given, outcome = result if paired else (result, np.zeros(rows, int))
            trajectory = own_arrays.array(given)
        except Exception as error:
            raise SimulatorError(f"simulate: {type(error).__name__}: {error}") from error
        wanted = f"of shape {[rows, *shape]}" if shape is not None else f"of shape [{rows}, ...]"
        fits = trajectory.ndim >= 2 and len(trajectory) == rows
        if fits and shape is not None:
            long = lambda lengths: [length for length in lengths if length != 1]
            fits = long(trajectory.shape[1:]) == long(shape)
        if not fits or trajectory.dtype.kind not in "biuf":
            raise SimulatorError(
                f"simulate: expected numbers {wanted} for {rows} parameter vectors, "
                f"got {trajectory.dtype} of shape {list(trajectory.shape)}{as_observed(shape)}"
            )
        if shape is not None:
            trajectory = trajectory.reshape(rows, *shape)
        try:
            outcome = own_arrays.outcomes(outcome)
        except ValueError as error:
            raise SimulatorError(
                f"simulate: expected an outcome for each of {rows} simulations, got {own_arrays.described(outcome)}: "
                "outcomes are booleans (true: valid) or whole numbers (0: valid)"
            ) from error
        if outcome.shape != (rows,):
            raise SimulatorError(
                f"simulate: expected an outcome for each of {rows} simulations, got {own_arrays.described(outcome)}"
            )
        outcome = np.where(outcome, 0, 1) if outcome.dtype == bool else outcome
        _require_own(given, theta, trajectory, outcome)
        return trajectory, outcome


def _require_own(given: Any, theta: np.ndarray, trajectory: np.ndarray, outcome: np.ndarray) -> None:
    """Refuse a list with one work array for simulations of several parameter vectors, or for all of their records.

    One array may stand for all simulations that failed.

    Raises:
        SimulatorError: saying to append a copy.
    """
    rows: dict[Any, int] = {}
    for row, place in enumerate(own_arrays.places(given)):
        if outcome[row] != 0 or not np.isfinite(trajectory[row]).all():
            continue
        try:
            own_arrays.require_own_rows(given[row])
        except ValueError as error:
            raise SimulatorError(f"simulate: {error}") from error
        first = rows.setdefault(place, row) if place is not None else row
        if not np.array_equal(theta[first], theta[row]):
            raise SimulatorError(
                f"simulate: expected a separate array for each simulation, got the same one for rows {first} and "
                f"{row}, with the last one's numbers: append a copy"
            )


def numpy_generator(key: jax.Array) -> np.random.Generator:
    """A NumPy generator seeded by a JAX key."""
    return np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())


def require_success(succeeded: np.ndarray, failed: np.ndarray, reasons: Sequence[str], known: str = "") -> None:
    """Stop if no simulation of the first round succeeded in any run.

    Args:
        succeeded: number of successes of each run.
        failed: number of failures of each run and reason.
        reasons: their names.
        known: what is known of failures.

    Raises:
        SimulatorError: with the counts by reason.
    """
    if np.sum(succeeded) > 0:
        return
    counts = np.sum(np.atleast_2d(failed), axis=0)
    listed = ", ".join(f"{reason}: {count}" for reason, count in zip(reasons, counts, strict=True))
    raise SimulatorError(f"simulate: expected some valid simulations in the first round, got none ({listed}){known}")
