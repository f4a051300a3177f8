"""The grid: hyperparameters, their values, and the runs of every combination of them."""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from jaxlfi.bayessim.batch import RunSpec
from jaxlfi.bayessim.keys import key_of, run_keys
from jaxlfi.bayessim.presets import QUICK
from jaxlfi.bayessim.settings import Settings
from jaxlfi.distributions.support import Support
from jaxlfi.heuristics import Heuristic
from jaxlfi.heuristics.hyperparameters import all_declared, check, replaced
from jaxlfi.tasks.observation import observe
from jaxlfi.tasks.task import Task


@dataclasses.dataclass(frozen=True)
class Axis:
    """One hyperparameter and the values it takes, in the order of the grid."""

    name: str
    values: tuple[float, ...]


@dataclasses.dataclass(frozen=True)
class Grid:
    """Runs of the product of `axes` and `seeds`.

    Attributes:
        task: the task.
        support: Theta_0, in inference space.
        rule: the heuristic, with the hyperparameters that are on no axis.
        axes: hyperparameters and their values.
        seeds: seeds of the runs; each has one observation in all combinations.
        settings: settings of all runs.
        reference: reference by which the task was found (`jaxlfi.registry.TASKS`).
        preset: name of the preset from which the settings were made.
        support_name: the support's name, or "own".

    Raises:
        ValueError: for axes that are empty, repeated or not the heuristic's, and for values that it does not accept.

    Example:
        >>> from jaxlfi.envs.gaussian_linear import task  # doctest: +SKIP
        >>> axes = (Axis("mass_threshold", (0.001, 0.005)),)  # doctest: +SKIP
        >>> measure(Grid(task(), task().support("ok"), Edge(), axes, seeds=(0, 1)))  # doctest: +SKIP
    """

    task: Task
    support: Support
    rule: Heuristic
    axes: tuple[Axis, ...]
    seeds: tuple[int, ...]
    settings: Settings = QUICK
    reference: str | None = None
    preset: str | None = None
    support_name: str = "own"

    def __post_init__(self):
        check_axes(self.rule, self.axes)
        check(self.rule, self.task.dim)
        self.settings.check()
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds: expected at least one, all different, got {self.seeds}")

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values on each axis, and of seeds."""
        return (*(len(axis.values) for axis in self.axes), len(self.seeds))

    @property
    def size(self) -> int:
        """Number of runs."""
        return math.prod(self.shape)


def parse_axes(texts: Iterable[str]) -> tuple[Axis, ...]:
    """Axes as the command line writes them, NAME=V,V,...

    Example:
        >>> parse_axes(["expansion=0.1,0.2"])
        (Axis(name='expansion', values=(0.1, 0.2)),)
    """
    axes = []
    for text in texts:
        name, _, values = text.partition("=")
        try:
            axes.append(Axis(name, tuple(float(value) for value in values.split(","))))
        except ValueError:
            raise ValueError(f"vary: expected NAME=V,V,... with numbers, got {text!r}") from None
    return tuple(axes)


def hyperparameters(rule: Heuristic) -> dict[str, Any]:
    """A heuristic's hyperparameters and their default values, which are the paper's."""
    return {name: field.default for name, field in all_declared(rule).items() if not field.static}


def check_axes(rule: Heuristic, axes: Sequence[Axis]) -> None:
    """Refuse missing, empty, repeated and unknown axes, and values that are repeated or out of range.

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
        if len(set(np.float32(axis.values).tolist())) < max(len(axis.values), 1):  # runs use single precision
            raise ValueError(f"{axis.name}: expected at least one value, each once, got {shown or 'none'}")
        info = all_declared(rule)[axis.name].info
        if not np.isfinite(axis.values).all() or not info.contains(axis.values):
            raise ValueError(f"{axis.name}: expected finite numbers in {info.interval}, got {shown}")


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
    return [replaced(rule, values) for values in combinations(axes)]


def grid_runs(grid: Grid) -> list[RunSpec]:
    """All runs in C order of [axis..., seed]."""
    named = zip(combinations(grid.axes), heuristics(grid.rule, grid.axes), strict=True)
    return [
        RunSpec(
            " ".join(f"{name}={value:g}" for name, value in values.items()), grid.support_name, grid.support, rule, seed
        )
        for values, rule in named
        for seed in grid.seeds
    ]


def observations(grid: Grid, observation: Any = None) -> tuple[np.ndarray, np.ndarray]:
    """Each seed's observed trajectory and summary, stacked: the given one, the task's, or one simulated per seed."""
    keys = [run_keys(key_of(seed)).observe for seed in grid.seeds]
    pairs = [observe(key, grid.task, observation) for key in keys]
    return tuple(np.stack([np.asarray(pair[i]) for pair in pairs]) for i in range(2))
