"""A task at other designs: one experiment, or several of them inferred together."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.tasks.design import Designed, OfDesign
from jaxlfi.tasks.task import Task
from jaxlfi.tasks.trials import ALL, first_failure, summarised_jointly


def require_design(task: Task) -> None:
    """Refuse a task without a design.

    Raises:
        ValueError: saying how to declare one.
    """
    if task.design is None:
        raise ValueError(
            f'design: expected a task with a design, as Task(design={{"amplitude": (0.1, 1.0, "N m")}}) with '
            f"simulate(key, theta, design), or a table [design] in the file of a MuJoCo model, got {task.name} without"
        )


def at(task: Task, design: Any) -> Task:
    """The task of an experiment with another design than the nominal one.

    Args:
        task: with a design.
        design: values by name, others being nominal, or all in order.

    Raises:
        ValueError: for a task without a design, and designs outside of its bounds.

    Example:
        >>> from jaxlfi.distributions.support import Support
        >>> box = Support([0.1], [9.0])
        >>> decay = Task(lambda key, theta, design: jnp.exp(-theta * design), ["rate"], {"guess": box}, box,
        ...              design={"time": (0.0, 4.0, "s")})
        >>> f"{float(at(decay, {'time': 3.0}).simulate(jax.random.key(0), jnp.ones(1))[0]):.3f}"
        '0.050'
    """
    require_design(task)
    one = single(task)
    point = one.design.values(design)
    designed = dataclasses.replace(_function(one), point=point)
    nominal = dataclasses.replace(one.design, nominal=point)
    return dataclasses.replace(one, simulate=_with(one, designed), design=nominal, observation=None)


def experiments(task: Task, designs: Sequence[Any]) -> Task:
    """The task of several experiments with the same parameters, inferred together.

    A simulation consists of one of each experiment, with its own noise, and fails if one of them does. Trajectories are
    concatenated along the first axis (`jaxlfi.tasks.trials.together` does so for recordings), and summaries in the same
    order. So experiments can be added one at a time: choose, record, infer, choose.

    Args:
        task: with a design, of one experiment or of several.
        designs: one for each experiment, as for `at`.

    Raises:
        ValueError: for no designs, a task without a design, and designs outside of its bounds.

    Example:
        >>> from jaxlfi.distributions.support import Support
        >>> box = Support([0.1], [9.0])
        >>> decay = Task(lambda key, theta, design: jnp.exp(-theta * design), ["rate"], {"guess": box}, box,
        ...              design={"time": (0.0, 4.0, "s")})
        >>> both = experiments(decay, [[1.0], {"time": 2.0}])
        >>> [f"{float(value):.3f}" for value in both.simulate(jax.random.key(0), jnp.ones(1))]
        ['0.368', '0.135']
    """
    require_design(task)
    if isinstance(designs, str) or not len(designs):
        raise ValueError(f"designs: expected at least one, got {designs!r}")
    if len(designs) == 1:
        return at(task, designs[0])
    one = single(task)
    points = tuple(one.design.values(each) for each in designs)
    joint = Experiments(one, points)
    jointly = summarised_jointly(one, len(points), ALL, "experiment")
    return dataclasses.replace(jointly, simulate=_with(one, joint), observation=None)


def single(task: Task) -> Task:
    """The task of one experiment with a design: the one that a task of several was made from, else the task itself.

    If a task's own recordings are of another kind of experiment, it is the task that its design is `of`.
    """
    if task.design is not None and task.design.of is not None:
        return task.design.of
    function = _function(task)
    return function.one if isinstance(function, Experiments) else task


def simulator_at(task: Task, design: Any) -> Callable[[Any, Any], Any]:
    """The simulator of a task of one experiment at another design, which may be traced."""
    function = _function(task).function
    return lambda key, theta: function(key, theta, jnp.asarray(design, float))


@dataclasses.dataclass(frozen=True)
class Experiments(OfDesign):
    """A simulator of several experiments, one after another.

    Attributes:
        one: the task of one of them.
        points: their designs.
    """

    one: Task
    points: tuple[tuple[float, ...], ...]

    def __call__(self, source: Any, theta: Any) -> Any:
        """Simulate; outside JAX for a batch of parameters, or for one if simulations are made one by one."""
        function = _function(self.one)
        if not function.numpy:
            return self._in_jax(function, source, theta)
        results = [dataclasses.replace(function, point=point)(source, theta) for point in self.points]
        axis = 0 if self.one.one_by_one else 1
        pairs = [result if isinstance(result, tuple) else (result, None) for result in results]
        joined = np.concatenate([np.asarray(trajectory) for trajectory, _ in pairs], axis=axis)
        if all(outcome is None for _, outcome in pairs):
            return joined
        rows = () if axis == 0 else (len(joined),)
        outcomes = [np.zeros(rows, int) if one is None else _codes(np.asarray(one)) for _, one in pairs]
        return joined, first_failure(np, np.stack(outcomes, axis=-1))

    def _in_jax(self, function: Designed, key: jax.Array, theta: Any) -> Any:
        keys = jax.random.split(key, len(self.points))
        result = jax.vmap(function.function, (0, None, 0))(keys, theta, jnp.asarray(self.points, float))
        trajectory, outcome = result if isinstance(result, tuple) else (result, None)
        joined = trajectory.reshape(-1, *trajectory.shape[2:])
        return joined if outcome is None else (joined, first_failure(jnp, outcome))


def _codes(outcome: np.ndarray) -> np.ndarray:
    return np.where(outcome, 0, 1) if outcome.dtype == bool else outcome


def _function(task: Task) -> Any:
    return task.simulate.function if task.on_host else task.simulate


def _with(task: Task, function: OfDesign) -> Any:
    """The task's simulator with another function."""
    return dataclasses.replace(task.simulate, function=function) if task.on_host else function
