"""Several observations of the same parameters: independent trials, summarised jointly."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.summaries import one_after_another
from jaxlfi.tasks.task import Task
from jaxlfi.tasks.worker import Trials

MAX_TRIALS = 1000
"""Largest number of trials of a task, each of which every simulation has to make."""


def repeated(task: Task, trials: int, pooling: str = "moments") -> Task:
    """The task of observing several independent trials with the same parameters.

    A simulation then consists of n of the given task's, each with its own noise; it fails if one of them fails.
    Trajectories are concatenated along the first axis. The summary pools theirs by moments, which do not depend on
    their order; or it has "all" of them, one after another, for a network that learns how to pool them
    (`embedding="trials"`, which the command line then sets by itself). The posterior is that of all trials together.

    Args:
        task: of one trial. Its own observation, if it has one, is not kept, nor is its design: all trials have the
            nominal design (`jaxlfi.tasks.experiments` allows several).
        trials: number of trials, n.
        pooling: how n summaries become one: a name in `POOLINGS`, or "all".

    Returns:
        The task of n trials; the given one for n = 1.

    Raises:
        ValueError: for fewer than one trial or too many, and an unknown pooling.

    Example:
        >>> from jaxlfi.envs.gaussian_linear import task
        >>> repeated(task(), 4).name
        'gaussian_linear x 4'
    """
    if isinstance(trials, bool) or not isinstance(trials, int) or not 1 <= trials <= MAX_TRIALS:
        raise ValueError(f"trials: expected a whole number from 1 to {MAX_TRIALS}, got {trials!r}")
    check_pooling(pooling)
    if trials == 1:
        return task
    if task.on_host:
        function = task.simulate.function
        many = Trials(function, trials) if task.one_by_one else functools.partial(_on_host, function, trials)
        simulate = dataclasses.replace(task.simulate, function=many)
    else:
        simulate = functools.partial(_in_jax, task.simulate, trials)
    return dataclasses.replace(
        summarised_jointly(task, trials, pooling),
        simulate=simulate,
        observation=None,
        design=None,
        settings={**task.settings, "embedding": "trials"} if pooling == ALL else task.settings,
    )


def summarised_jointly(task: Task, trials: int, pooling: str, kind: str = "trial") -> Task:
    """The task with the joint summary of several trajectories that lie one after another.

    `repeated` does this with independent trials of one simulator. Trials that differ in known quantities, such as their
    actions, need a simulator of their own (`jaxlfi.envs.whip.real2sim.whip_task`); they are in a fixed order, which
    "all" keeps.

    Args:
        task: its simulator returns all trajectories [n T, ...]; its summary and names are those of one.
        trials: number of trials, n.
        pooling: as in `repeated`.
        kind: word for one of them in the names of summaries and records.

    Raises:
        ValueError: for an unknown pooling.
    """
    check_pooling(pooling)
    return dataclasses.replace(
        task,
        summary=_pooled(task.summary, trials, pooling),
        times=None,
        record_label=f"{task.record_label or 'record'} of {trials} {kind}s, one after another",
        summary_names=_names(task.summary_names, trials, pooling, kind),
        name=f"{task.name} x {trials}",
    )


def check_pooling(pooling: str) -> None:
    """Refuse an unknown pooling.

    Raises:
        ValueError: naming the known ones.
    """
    if not isinstance(pooling, str) or pooling not in (ALL, *POOLINGS):
        raise ValueError(f"pooling: expected one of {sorted((ALL, *POOLINGS))}, got {pooling!r}")


def together(trials: Sequence[Any], length: int | None = None) -> np.ndarray:
    """Trajectories [T, ...] of several trials as the one of a repeated task, shape [n T, ...].

    Args:
        trials: those that are shorter than the longest are padded with NaN.
        length: length to which trials of different lengths are padded, T; that of the longest by default.

    Raises:
        ValueError: for no trials, records of different shapes, or a trial that is too long.
    """
    arrays = [np.array(trial) for trial in trials]
    shapes = sorted({array.shape for array in arrays})
    if len({shape[1:] for shape in shapes}) != 1 or () in shapes:
        raise ValueError(f"observation: expected trials of one shape [T, ...], got {[list(shape) for shape in shapes]}")
    if len(shapes) == 1:
        return np.concatenate(arrays)
    longest = max(map(len, arrays))
    length = longest if length is None else length
    if longest > length:
        raise ValueError(f"observation: expected trials of at most {length} records each, got one of {longest}")
    filled = np.full((len(arrays), length, *arrays[0].shape[1:]), np.nan)
    for place, array in zip(filled, arrays, strict=True):
        place[: len(array)] = array
    return filled.reshape(-1, *filled.shape[2:])


STATISTICS: dict[str, Callable[[Array], Array]] = {
    "mean": lambda each: each[0] + jnp.mean(each - each[0], axis=0),
    "sd": lambda each: jnp.std(each - each[0], axis=0, ddof=1),  # exact if the trials are nearly equal
}
"""Statistics of the trials' summaries [n, S], each a vector [S]."""

POOLINGS: dict[str, tuple[str, ...]] = {"mean": ("mean",), "moments": ("mean", "sd")}
"""Which statistics of the trials' summaries make the summary of them all, by name."""


ALL = "all"
"""The pooling that keeps every trial's summary."""


def _in_jax(simulate: Callable, trials: int, key: jax.Array, theta: Array) -> tuple[Array, Array]:
    """Several simulations at one theta, and the first failure among them."""

    def one(key):
        result = simulate(key, theta)
        return result if isinstance(result, tuple) else (result, jnp.asarray(0))

    trajectory, outcome = jax.vmap(one)(jax.random.split(key, trials))
    return trajectory.reshape(-1, *trajectory.shape[2:]), first_failure(jnp, outcome)


def _on_host(function: Callable, trials: int, rng: np.random.Generator, theta: np.ndarray):
    """The same for a simulator on the host: all trials of all thetas in one call."""
    simulated = HostSimulator(function).batch(rng, np.repeat(theta, trials, axis=0))
    trajectory, outcome = (np.asarray(array).reshape(len(theta), trials, *array.shape[1:]) for array in simulated)
    return trajectory.reshape(len(theta), -1, *trajectory.shape[3:]), first_failure(np, outcome)


def first_failure(numpy: Any, outcome: Any) -> Any:
    """The outcome of the first trial that failed, else of success; booleans are true for success."""
    if outcome.dtype == bool:
        return numpy.all(outcome, axis=-1)
    first = numpy.argmax(outcome != 0, axis=-1)
    return numpy.take_along_axis(outcome, first[..., None], axis=-1)[..., 0]


def _pooled(summary: Callable, trials: int, pooling: str) -> Callable:
    """The summary of several trials."""
    if pooling == ALL:
        return functools.partial(one_after_another, summary, trials)
    return functools.partial(summary_of_trials, summary, trials, pooling)


def _names(names: Sequence[str], trials: int, pooling: str, kind: str) -> list[str]:
    """Names of that summary's numbers, from those of one trial."""
    if pooling == ALL:
        return [f"{name} of {kind} {trial + 1}" for trial in range(trials) for name in names]
    return [f"{statistic} of {name}" for statistic in POOLINGS[pooling] for name in names]


def summary_of_trials(summary: Callable, trials: int, pooling: str, trajectory: Array) -> Array:
    """The pooled summary of concatenated trials."""
    return pooled(jax.vmap(summary)(trajectory.reshape(trials, -1, *trajectory.shape[1:])), pooling)


def pooled(each: Float[Array, "trial obs"], pooling: str) -> Float[Array, " pooled"]:
    """The pooled summary of several trials, which does not depend on their order."""
    return jnp.concatenate([STATISTICS[kind](each) for kind in POOLINGS[pooling]])
