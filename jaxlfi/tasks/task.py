"""Task: a simulator with its parameters named, bounded and, where known, observed."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.distributions.support import Support, check_within
from jaxlfi.tasks.registry import summaries

Simulate = Callable[..., Any]


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """A likelihood-free inference problem.

    Everything about parameters is declared in natural units. Inference works in *coordinates*: the natural logarithm
    for the parameters named in `log`, the parameter itself otherwise. After construction `supports`, `feasible` and
    `truth` are in coordinates, and so is every theta inside the library; `to_natural` leads back.

    Attributes:
        simulate: one simulation, `simulate(key, theta[D]) -> trajectory` or `-> (trajectory, outcome)`, in JAX and
            pure. `outcome` is a boolean (true: valid) or an integer (0: valid, i: failed for the reason
            `failures[i - 1]`; any other integer counts as the first of them).
            For a black box, `simulate(rng, theta[N, D])` with a `numpy.random.Generator` and N parameter vectors,
            returning the same with a leading axis N.
        names: one name for each of the D parameters.
        supports: boxes Theta_0 by name; the first is the default. One that is wider than Phi, like the paper's
            "broadest", is allowed here and widens Phi for its own run.
        feasible: Phi, the limits that no adapted support leaves.
        units: one unit for each parameter ("" for none).
        summary: what the network sees of a trajectory: the name of a summary (`jaxlfi.tasks.summaries.SUMMARIES`) or a
            function of one trajectory to a vector [S].
        truth: the parameters of the observation, where they are known, shape [D].
        observation: a fixed observed trajectory, where the task has one (real data).
        log: names of the parameters inferred as logarithms.
        prior: a distrax distribution over coordinates to draw the first round from, instead of the uniform one over
            the support; its draws are kept in the support like all others.
        failures: names of the reasons for which a simulation can fail.
        black_box: true for a Python or NumPy simulator that JAX cannot trace.
        summary_names: names of the summary's numbers, for plots; by default x_1 to x_S.
        channels: names of the columns of a trajectory, for plots.
        times: times of the rows of a trajectory, shape [T], for plots.
        record_label: what the rows of a trajectory are counted by, for plots; by default "time" where there are
            `times`, else "record".
        settings: numbers of a run, by the names of `jaxlfi.bayessim.algorithm.Settings` and `jaxlfi.estimators.estimator.Estimator`, that
            the command line takes for this task in place of the preset's.
        hyperparameters: of heuristics, by the heuristic's name, that it takes in place of their defaults.
        name: what the task is called in files and figures.

    Raises:
        ValueError: for numbers of names, units and bounds that do not agree, reversed bounds, unknown names in `log`,
            or bounds or a truth of a log parameter that are not positive.

    Example:
        >>> spring = Task(lambda key, theta: theta[:1] / theta[1:], names=("force", "stiffness"), units=("N", "N/m"),
        ...               supports={"guess": Support([1.0, 0.5], [2.0, 50.0])},
        ...               feasible=Support([0.1, 0.1], [10.0, 100.0]), log=("stiffness",))
        >>> spring.coordinates
        ('force', 'ln stiffness')
    """

    simulate: Simulate
    names: Sequence[str]
    supports: Mapping[str, Support]
    feasible: Support
    units: Sequence[str] | None = None
    summary: str | Callable[[jax.Array], jax.Array] = "identity"
    truth: Any = None
    observation: Any = None
    log: Sequence[str] = ()
    prior: Any = None
    failures: Sequence[str] = ("failed",)
    black_box: bool = False
    summary_names: Sequence[str] = ()
    channels: Sequence[str] = ()
    times: Any = None
    record_label: str | None = None
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    hyperparameters: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    name: str = "task"

    def __post_init__(self):
        store = lambda field, value: object.__setattr__(self, field, value)
        names = tuple(self.names)
        store("names", names)
        store("units", tuple(self.units) if self.units is not None else ("",) * len(names))
        store("failures", tuple(self.failures))
        store("log", tuple(self.log))
        store("summary_names", tuple(self.summary_names))
        if len(self.units) != len(names):
            raise ValueError(f"units: expected one for each of the {len(names)} parameters, got {len(self.units)}")
        if len(set(names)) != len(names):
            raise ValueError(f"names: expected distinct names, got {names}")
        if unknown := set(self.log) - set(names):
            raise ValueError(f"log: expected names among {names}, got {sorted(unknown)}")
        if not self.supports:
            raise ValueError("supports: expected at least one named support, got none")
        store("feasible", self._box_to_coordinates(self.feasible, "feasible"))
        store(
            "supports",
            {label: self._box_to_coordinates(box, f"supports[{label!r}]") for label, box in self.supports.items()},
        )
        if self.truth is not None:
            truth = _vector(self.truth, len(names), "truth")
            if bool(np.any(np.asarray(truth)[self._is_log] <= 0)):
                raise ValueError(f"truth: expected positive values of the log parameters {self.log}, got {truth}")
            store("truth", self.to_coordinates(truth))
        if isinstance(self.summary, str):
            store("summary", summaries.named(self.summary))

    @property
    def dim(self) -> int:
        """Number of parameters D."""
        return len(self.names)

    @property
    def coordinates(self) -> tuple[str, ...]:
        """What theta is called inside the library: "ln name" for the parameters inferred as logarithms."""
        return tuple(f"ln {name}" if name in self.log else name for name in self.names)

    @property
    def reasons(self) -> tuple[str, ...]:
        """All reasons of failure, in the order of their codes from 1: the task's own, then "non_finite"."""
        return (*self.failures, "non_finite")

    def named_summaries(self, count: int) -> tuple[str, ...]:
        """Names of the summary's `count` numbers.

        Raises:
            ValueError: if the task names another number of them.
        """
        if self.summary_names and len(self.summary_names) != count:
            raise ValueError(
                f"summary_names: expected one for each of the summary's {count} numbers, got {len(self.summary_names)}"
            )
        return self.summary_names or tuple(f"x_{i + 1}" for i in range(count))

    @property
    def _is_log(self) -> np.ndarray:
        return np.array([name in self.log for name in self.names])

    def to_natural(self, theta: jax.Array) -> jax.Array:
        """From inference coordinates to natural units, shape [..., D]."""
        if not self.log:
            return theta
        return jnp.where(self._is_log, jnp.exp(jnp.where(self._is_log, theta, 0.0)), theta)

    def to_coordinates(self, theta: jax.Array) -> jax.Array:
        """From natural units to inference coordinates, shape [..., D]."""
        if not self.log:
            return theta
        return jnp.where(self._is_log, jnp.log(jnp.where(self._is_log, theta, 1.0)), theta)

    def support(self, choice: str | Support | None = None) -> Support:
        """A support by name, the default one for None, or the reader's own box (in coordinates), checked."""
        if isinstance(choice, Support):
            return check_within(choice, self.feasible)
        if choice is None:
            return next(iter(self.supports.values()))
        if choice not in self.supports:
            raise ValueError(f"support: expected one of {sorted(self.supports)}, got {choice!r}")
        return self.supports[choice]

    def _box_to_coordinates(self, box: Support, label: str) -> Support:
        if box.dim != self.dim:
            raise ValueError(f"{label}: expected bounds for {self.dim} parameters, got {box.dim}")
        check_within(box, box, label)
        if not self.log:
            return box
        if bool(np.any(np.asarray(box.low)[self._is_log] <= 0)):
            raise ValueError(f"{label}: expected positive bounds for the log parameters {self.log}, got {box.low}")
        return Support(self.to_coordinates(box.low), self.to_coordinates(box.high))


def _vector(value: Any, length: int, name: str) -> jax.Array:
    vector = jnp.asarray(value, jnp.float32)
    if vector.shape != (length,):
        raise ValueError(f"{name}: expected {length} numbers, got shape {vector.shape}")
    return vector
