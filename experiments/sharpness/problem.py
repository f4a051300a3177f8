"""A problem: a simulator as a user brings it, its boxes, truths and observations, and its likelihood."""

import dataclasses
import functools
import zlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.distributions.support import Support
from jaxlfi.tasks.observation import simulate_observation
from jaxlfi.tasks.task import Task

NEAR = 0.1
"""Truths are drawn within this fraction of the right box's width from the problem's truth, in each parameter."""
BEYOND = 0.15
"""Fraction of the right box's width by which a wrong bound excludes the truth."""
MARGIN = 0.5
"""Phi reaches beyond the right box by this fraction of its width, unless a problem says otherwise."""
LEAST_WIDTH = 0.3
"""Smallest width of a wrong box, relative to the right one; on a side where Phi leaves less room there is none."""

LogLikelihood = Callable[[jax.Array, jax.Array, jax.Array], jax.Array]


@dataclasses.dataclass(frozen=True)
class Linear:
    """x = matrix theta + noise of one standard deviation: the model whose posterior is known in closed form.

    Attributes:
        matrix: shape [S, D], per unit of each parameter.
        noise: standard deviation, in units of x.
    """

    matrix: np.ndarray
    noise: float


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """A simulator, its truth and boxes, and the exact likelihood.

    Attributes:
        name: in tables.
        simulate: one simulation in JAX, `simulate(key, theta [D]) -> x [S]`, theta in natural units.
        names: of the D parameters.
        units: of the parameters.
        truth: in natural units, shape [D].
        low: of the right box, in natural units, shape [D].
        high: of the right box.
        log: names of the parameters inferred as logarithms.
        log_likelihood: `(key, theta [D], x [S]) -> log p(x | theta)` up to a constant, in natural units; of the
            models that are not linear.
        estimated: whether `log_likelihood` is the logarithm of an unbiased estimate, by a particle filter that draws
            from the key; the key is not used elsewhere.
        linear: of the linear models, in place of a likelihood.
        host_log_likelihood: of simulators that are not in JAX, in place of a likelihood: `(theta [N, D], x) -> [N]`, of
            many parameters in natural units.
        declared: the task, where it is declared elsewhere: its support "box" is the right one.
        prior: over natural units; None for the uniform one over a box in inference space.
        phi_low: lower limits of Phi in natural units, by name, where they are not those of `MARGIN`.
        phi_high: upper limits, likewise.
        informed: names of the parameters that the data inform individually: only their bounds are made wrong. None for
            all.
        open: names of the parameters for which the data leave much of the box: in these, near truths are drawn from the
            whole right box, as a posterior is calibrated under its prior, and under truths near one only if the prior
            does not matter.
        shaped: whether the posterior's shape is judged, too (C2ST), as moments say little of it.
        kept: whether references take so long that they are kept beside the results.
    """

    name: str
    simulate: Callable[[jax.Array, jax.Array], jax.Array]
    names: tuple[str, ...]
    units: tuple[str, ...]
    truth: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    log: tuple[str, ...] = ()
    log_likelihood: LogLikelihood | None = None
    estimated: bool = False
    linear: Linear | None = None
    host_log_likelihood: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    declared: Task | None = None
    prior: Any = None
    phi_low: dict[str, float] = dataclasses.field(default_factory=dict)
    phi_high: dict[str, float] = dataclasses.field(default_factory=dict)
    informed: tuple[str, ...] | None = None
    open: tuple[str, ...] = ()
    shaped: bool = False
    kept: bool = False

    def __post_init__(self):
        given = self.log_likelihood, self.linear, self.host_log_likelihood
        if sum(one is not None for one in given) != 1:
            raise ValueError(f"{self.name}: expected one log-likelihood or a linear model")

    @functools.cached_property
    def task(self) -> Task:
        """The task as a user declares it, with nothing but the simulator, names, units, boxes and the prior."""
        if self.declared is not None:
            return self.declared
        logs = np.isin(self.names, self.log)
        inner = lambda values: np.where(logs, np.log(np.where(logs, values, 1.0)), values)
        outer = lambda values: np.where(logs, np.exp(np.where(logs, values, 0.0)), values)
        low, high = inner(np.asarray(self.low)), inner(np.asarray(self.high))
        reach = MARGIN * (high - low)
        phi_low = [self.phi_low.get(name, bound) for name, bound in zip(self.names, outer(low - reach), strict=True)]
        phi_high = [self.phi_high.get(name, bound) for name, bound in zip(self.names, outer(high + reach), strict=True)]
        return Task(
            self.simulate,
            names=self.names,
            units=self.units,
            log=self.log,
            supports={"box": Support(list(self.low), list(self.high))},
            feasible=Support([float(bound) for bound in phi_low], [float(bound) for bound in phi_high]),
            truth=list(self.truth),
            prior=self.prior,
            name=self.name,
        )

    @property
    def dim(self) -> int:
        """Number of parameters D."""
        return len(self.names)

    @property
    def phi(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of Phi in inference space, shape [D] each."""
        feasible = self.task.inference.feasible
        return np.asarray(feasible.low, float), np.asarray(feasible.high, float)

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the right box in inference space, shape [D] each."""
        box = self.task.support("box")
        return np.asarray(box.low, float), np.asarray(box.high, float)

    def wrong_box(self, truth: np.ndarray, seed: int, bounds: str) -> tuple[np.ndarray, np.ndarray]:
        """The right box moved past a truth, as far as Phi allows, in inference space.

        Args:
            truth: in inference space, shape [D].
            seed: which chooses the parameter and the side.
            bounds: "one": past the truth in one parameter; "all": in all that are informed.
        """
        rng = np.random.default_rng([zlib.crc32(self.name.encode()), seed])
        (low, high), (phi_low, phi_high) = self.box, self.phi
        width = high - low
        informed = [d for d, name in enumerate(self.names) if self.informed is None or name in self.informed]
        low, high = low.copy(), high.copy()
        for d in [rng.choice(informed)] if bounds == "one" else informed:
            beyond = BEYOND * width[d]
            above = truth[d] + beyond, min(truth[d] + beyond + width[d], phi_high[d])
            below = max(truth[d] - beyond - width[d], phi_low[d]), truth[d] - beyond
            room = [pair for pair in (above, below) if pair[1] - pair[0] >= LEAST_WIDTH * width[d]]
            if not room:
                raise ValueError(f"{self.name}: {self.names[d]}: expected room in Phi for a wrong box, got none")
            low[d], high[d] = room[rng.integers(len(room))]
        return low, high


@dataclasses.dataclass(frozen=True)
class Case:
    """A truth and its observation.

    Attributes:
        problem: of the truth.
        kind: "own" for the problem's truth, "near" for one drawn near it.
        seed: of the truth and the observation.
        truth: in inference space, shape [D].
        x: shape [S], or a trajectory [T, C] where the task summarises it.
    """

    problem: Problem
    kind: str
    seed: int
    truth: np.ndarray
    x: np.ndarray

    @property
    def label(self) -> str:
        """Its label in results."""
        return f"{self.kind}-{self.seed}"


def case_of(problem: Problem, kind: str, seed: int) -> Case:
    """The case of a seed.

    Raises:
        ValueError: for an observation that is not finite.
    """
    task = problem.task
    truth = np.asarray(task.inference.truth, float)
    if kind == "near":
        low, high = problem.box
        reach = NEAR * (high - low)
        rng = np.random.default_rng([zlib.crc32(problem.name.encode()), 1, seed])
        everywhere = np.isin(problem.names, problem.open)
        low, high = (np.where(everywhere, bound, truth + side) for bound, side in ((low, -reach), (high, reach)))
        truth = rng.uniform(*(np.clip(bound, *problem.box) for bound in (low, high)))
    key = jax.random.key(zlib.crc32(f"{problem.name} {kind} {seed}".encode()))
    theta = task.space.to_natural(jnp.asarray(truth, jnp.float32))
    if problem.declared is None:
        x = np.asarray(_simulator(problem)(key, theta))
    else:
        x = np.asarray(simulate_observation(key, dataclasses.replace(task, truth=np.asarray(theta))))
    if not np.isfinite(x).all():
        raise ValueError(f"{problem.name}: {kind} {seed}: expected a finite observation")
    return Case(problem, kind, seed, truth, x)


@functools.lru_cache(maxsize=64)
def _simulator(problem: Problem):
    return jax.jit(problem.simulate)
