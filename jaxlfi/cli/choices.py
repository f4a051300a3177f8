"""What the arguments of `infer`, `compare` and `grid` select: settings, heuristics, supports, observations, seeds."""

import argparse
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np

from jaxlfi.bayessim.presets import HYPERPARAMETERS, settings_for, with_estimator, with_fields
from jaxlfi.bayessim.settings import Settings
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.base import converted
from jaxlfi.fields import declared
from jaxlfi.heuristics import Heuristic, paired
from jaxlfi.heuristics.hyperparameters import build, refuse_foreign
from jaxlfi.registry import ESTIMATORS, HEURISTICS, TASKS
from jaxlfi.tasks.executors import one_by_one, scheduler, workers
from jaxlfi.tasks.observation import read_for
from jaxlfi.tasks.task import Task

MAX_SEEDS = 10_000
"""Largest number of runs of one command that differ only in their seed; all observe before the first begins."""
CONFIGURATION_DEFAULTS = ("ok", "misspecified", "broad")
"""Supports that are compared by default, if the task has them."""


def task_of(arguments: argparse.Namespace) -> Task:
    """The task, with simulations made one by one if the arguments say how."""
    return simulated_by(arguments, TASKS.load(arguments.task))


def simulated_again(arguments: argparse.Namespace, folder: Path, task: Task) -> Task:
    """The task of a folder with simulations made as the arguments say, if they were made one by one before.

    Raises:
        ValueError: if they were not, but the arguments say how to make them.
    """
    given = (arguments.workers, arguments.scheduler, arguments.simulation_timeout) != (None, None, None)
    if given and not task.one_by_one:
        raise ValueError(
            f"{folder}: expected none of --workers, --scheduler and --simulation-timeout for a run whose simulations "
            "were not made one by one"
        )
    return simulated_by(arguments, task)


def simulated_by(arguments: argparse.Namespace, task: Task) -> Task:
    """The task with simulations made as the arguments say; their executor ends with `arguments.closing`."""
    count, address, timeout = arguments.workers, arguments.scheduler, arguments.simulation_timeout
    if count is not None and address is not None:
        raise ValueError("workers, scheduler: expected one of them, got both")
    if count is None and address is None and timeout is None:
        return task
    one_by_one(task)  # refuses a task of JAX before anything is started
    executor = None
    if count is not None:
        executor = arguments.closing.enter_context(workers(count))
    elif address is not None:
        executor = arguments.closing.enter_context(scheduler(address))
    return one_by_one(task, executor, timeout)


def default_configurations(task: Task) -> list[str]:
    """Up to three supports kept fixed, and the misspecified one (or else the first) with every heuristic."""
    wanted = [name for name in CONFIGURATION_DEFAULTS if name in task.supports]
    supports = wanted or list(task.supports)[:3]
    adapted = "misspecified" if "misspecified" in supports else supports[0]
    return [*supports, *(f"{adapted}+{heuristic}" for heuristic in ("edge", "mode", "centre"))]


def build_settings(
    arguments: argparse.Namespace, task: Task, change: Callable[[Settings], Settings] = lambda preset: preset
) -> Settings:
    """The settings of a task after a change, overridden by those given as arguments."""
    preset = change(settings_for(task, arguments.method, arguments.preset))
    given = dict(arguments.settings)
    if "steps" in given and "epochs" not in given:
        given["epochs"] = 0
    if "epochs" in given and "steps" not in given:
        given["steps"] = 0
    if "simulation_budget" not in given and "simulations_per_round" in given:
        # The fraction of failures that a round tolerates stays the preset's.
        given["simulation_budget"] = -(
            -given["simulations_per_round"] * preset.simulation_budget // preset.simulations_per_round
        )
    if arguments.estimator is not None:
        preset = with_estimator(preset, converted(preset.estimator, ESTIMATORS.load(arguments.estimator), {}))
    return with_fields(preset, given).check()


def heuristics_of(arguments: argparse.Namespace, names: Iterable[str]) -> dict[str, type[Heuristic]]:
    """The classes of the heuristics with these names.

    Raises:
        ValueError: for an unknown name, and a given hyperparameter that none of them has.
    """
    kinds = {name: HEURISTICS.load(name) for name in names}
    refuse_foreign(arguments.hyperparameters, kinds)
    return kinds


def build_heuristic(
    arguments: argparse.Namespace, name: str, kinds: Mapping[str, type[Heuristic]], settings: Settings, task: Task
) -> Heuristic:
    """A heuristic with the given hyperparameters, or else the task's, or else the preset's.

    Components that it compares are matched first if networks are reinitialised every round.
    """
    kind = kinds[name]
    values = {
        **HYPERPARAMETERS[arguments.preset].get(name, {}),
        **task.hyperparameters.get(name, {}),
        **{one: value for one, value in arguments.hyperparameters.items() if one in declared(kind)},
    }
    return paired(build(kind, values, task.dim), settings.estimator.warm_start)


def configuration_parts(name: str) -> tuple[str, str]:
    """Support and heuristic of "support" or "support+heuristic"."""
    support, plus, heuristic = name.partition("+")
    if plus and ":" not in heuristic and heuristic not in HEURISTICS.names():
        known = ", ".join(HEURISTICS.names())
        raise ValueError(f"configurations: expected support+heuristic with one of {known}, got {name!r}")
    if ":" in heuristic:
        raise ValueError(f"configurations: expected a registered heuristic, which names a folder, got {name!r}")
    return support, heuristic or "none"


def support_of(arguments: argparse.Namespace, task: Task) -> tuple[str, Support]:
    """The name and the box of the initial support: one of the task's, or "own"."""
    low, high = arguments.support_low, arguments.support_high
    if low is None and high is None:
        name = arguments.support or next(iter(task.supports))
        return name, task.support(name)
    if low is None or high is None or arguments.support is not None:
        raise ValueError("support: expected --support NAME, or --support-low and --support-high together")
    return "own", task.support(Support(low, high))


def observation_of(arguments: argparse.Namespace, task: Task, say: Callable[[str], None]) -> np.ndarray | None:
    """The observed trajectory in the given files; None for the task's own."""
    return None if arguments.observation is None else read_for(task, *arguments.observation, say=say)


def seeds_of(arguments: argparse.Namespace) -> range:
    """A seed for each run."""
    if arguments.seeds > MAX_SEEDS:
        raise ValueError(f"seeds: expected at most {MAX_SEEDS}, got {arguments.seeds}")
    if arguments.seeds < 1 or not 0 <= arguments.first_seed < 2**31 - arguments.seeds:
        raise ValueError(
            f"seeds: expected at least 1, and first_seed at least 0, got {arguments.seeds} and {arguments.first_seed}"
        )
    return range(arguments.first_seed, arguments.first_seed + arguments.seeds)
