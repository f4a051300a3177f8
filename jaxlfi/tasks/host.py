"""Host simulators: plain Python or NumPy, called outside of compiled programs."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from jaxlfi.distributions.arguments import is_concrete


class SimulatorError(ValueError):
    """A simulator that breaks its contract, or fails always."""


@dataclasses.dataclass(frozen=True)
class HostSimulator:
    """A simulator that JAX cannot trace, as `Task.simulate`.

    It takes the place of a JAX simulator everywhere but inside `jit` and `vmap`: a run then steps its rounds on the
    host, and calls the simulator between the compiled parts of a round.

    Attributes:
        function: `function(rng, theta[N, D]) -> trajectories [N, ...]` or `-> (trajectories, outcomes [N])`, with a
            `numpy.random.Generator` and N parameter vectors in natural units; outcomes as in `jaxlfi.Task`.

    Example:
        >>> simulator = HostSimulator(lambda rng, theta: theta + rng.normal(size=theta.shape))
        >>> trajectory, outcome = simulator(jax.random.key(0), np.zeros(3))
        >>> trajectory.shape, int(outcome)
        ((3,), 0)
    """

    function: Callable[..., Any]

    def __call__(self, key: jax.Array, theta: Any) -> tuple[np.ndarray, np.ndarray]:
        """One simulation: its trajectory, and 0 or the code of the reason it failed for.

        Raises:
            SimulatorError: if the simulator raises or gives other shapes, or inside a traced function.
        """
        if not is_concrete((key, theta)):
            raise SimulatorError("simulate: expected concrete arguments for a host simulator, which cannot be traced")
        trajectories, outcomes = self.batch(key, np.asarray(theta)[None])
        return trajectories[0], outcomes[0]

    def batch(
        self, key: jax.Array | np.random.Generator, theta: np.ndarray, shape: Sequence[int] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Simulate parameter vectors, and check what comes of it.

        Args:
            key: seeds the simulator's generator; or a generator to go on with.
            theta: in natural units, shape [N, D].
            shape: of a trajectory; None where it is not known yet. Axes of length one are added or dropped.

        Returns:
            Trajectories [N, *shape] and outcomes [N], 0 for success.

        Raises:
            SimulatorError: if the simulator raises, or gives other shapes.
        """
        rng = key if isinstance(key, np.random.Generator) else numpy_generator(key)
        try:
            result = self.function(rng, theta)
            trajectory, outcome = result if isinstance(result, tuple) and len(result) == 2 else (result, None)
            trajectory = np.asarray(trajectory)
        except Exception as error:
            raise SimulatorError(f"simulate: {type(error).__name__}: {error}") from error
        rows = len(theta)
        wanted = f"of shape {[rows, *shape]}" if shape is not None else f"of shape [{rows}, ...]"
        fits = trajectory.ndim >= 2 and len(trajectory) == rows
        if fits and shape is not None:
            long = lambda lengths: [length for length in lengths if length != 1]
            fits = long(trajectory.shape[1:]) == long(shape)
        if not fits or trajectory.dtype.kind not in "biuf":
            raise SimulatorError(
                f"simulate: expected numbers {wanted} for {rows} parameter vectors, "
                f"got {trajectory.dtype} of shape {list(trajectory.shape)}"
            )
        if shape is not None:
            trajectory = trajectory.reshape(rows, *shape)
        outcome = np.zeros(rows, int) if outcome is None else np.asarray(outcome)
        if outcome.shape != (rows,) or outcome.dtype.kind not in "biu":
            raise SimulatorError(
                f"simulate: expected an outcome for each of {rows} simulations, "
                f"got {outcome.dtype} of shape {list(outcome.shape)}"
            )
        return trajectory, np.where(outcome, 0, 1) if outcome.dtype == bool else outcome


def numpy_generator(key: jax.Array) -> np.random.Generator:
    """A NumPy generator seeded by a JAX key."""
    return np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
