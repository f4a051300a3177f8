"""Batches: many inference runs (configurations times seeds) stepped together as one compiled program.

The runs of a batch differ in leaves only (support, heuristic, seed, observation), so one compiled `vmap` of
`algorithm.step` serves them all, sharded over the local devices. Each run has its own keys: its result does not depend
on the other runs of the batch, except for the rounding of differently batched arithmetic, which training amplifies from
round to round. The same batch on the same number of devices repeats bit for bit.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int

from jaxlfi.bayessim import algorithm
from jaxlfi.bayessim.algorithm import State
from jaxlfi.bayessim.correction import CORRECTIONS
from jaxlfi.bayessim.keys import init_key, key_of, round_keys, run_keys
from jaxlfi.bayessim.programs import program
from jaxlfi.bayessim.record import record
from jaxlfi.bayessim.settings import Settings
from jaxlfi.diagnostics.discrepancy import POSTERIOR_SAMPLES, Discrepancy, discrepancy, not_simulated
from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.precision import single
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.base import Estimator, Network
from jaxlfi.estimators.posterior import Posterior, truncated
from jaxlfi.heuristics import Choice, Heuristic
from jaxlfi.io.executables import QUICK, QUICKEST, Options, call, compiled
from jaxlfi.io.lowered import Program
from jaxlfi.tasks import summaries
from jaxlfi.tasks.simulation import Simulations
from jaxlfi.tasks.task import Task

AXIS = "runs"


@dataclasses.dataclass(frozen=True)
class RunSpec:
    """Name and configuration of one run of a batch.

    Attributes:
        configuration: name of the run in tables, such as "misspecified+edge".
        support_name: the support's name, or "own".
        support: Theta_0, in inference space.
        heuristic: rule that adapts it.
        seed: seed of the run; `key_of(seed)` is its key.
    """

    configuration: str
    support_name: str
    support: Support
    heuristic: Heuristic
    seed: int


class RunInputs(struct.PyTreeNode):
    """The inputs of a run to the compiled program, stacked along a leading axis for a batch.

    Attributes:
        key: the run's key.
        support: Theta_0.
        heuristic: the rule, or a `Choice` among the rules of all runs.
        observed: the observed trajectory, shape [T, C] or [T]; a NumPy array until it is on its device.
        x: its summary x^r, shape [S]; likewise.
    """

    key: jax.Array
    support: Support
    heuristic: Heuristic
    observed: Float[Any, "*shape"]
    x: Float[Any, "*batch obs"]


def stack_heuristics(rules: Sequence[Heuristic]) -> tuple[Heuristic, Sequence[int | None]]:
    """The rules of several runs as one stacked pytree.

    Rules of the same structure differ in leaves only. If there is more than one structure, each run gets a `Choice` of
    one rule of each structure, and follows its own.

    Returns:
        The stacked rule, and for each run its place in the choice (None without a choice).
    """
    structures = [_structure(rule) for rule in rules]
    kinds = list(dict.fromkeys(structures))
    if len(kinds) == 1:
        return stack(rules), [None] * len(rules)
    places = [kinds.index(structure) for structure in structures]
    examples = [rules[structures.index(kind)] for kind in kinds]
    choices = [
        Choice(index=place, rules=tuple(rule if place == slot else other for slot, other in enumerate(examples)))
        for rule, place in zip(rules, places, strict=True)
    ]
    return stack(choices), places


def stack_inputs(
    specs: Sequence[RunSpec], observed: np.ndarray, x: np.ndarray
) -> tuple[RunInputs, Sequence[int | None]]:
    """Inputs of a batch, and each run's place in the choice of heuristics.

    Args:
        specs: the runs.
        observed: their observed trajectories, shape [L, T, C] or [L, T].
        x: the summaries, shape [L, S].
    """
    heuristic, places = stack_heuristics([spec.heuristic for spec in specs])
    keys = jnp.stack([key_of(spec.seed) for spec in specs])
    support = stack([spec.support for spec in specs])
    return RunInputs(keys, support, heuristic, np.asarray(observed), np.asarray(x)), places


def posterior_after(correction: str, belief: Belief, network: Network, x: Float[Array, " obs"]) -> Posterior:
    """The posterior of a run after a round, truncated to the adapted support.

    If the density is a mixture of Gaussians, it is the belief's own, after correction and heuristic.

    Args:
        correction: name of the run's correction.
        belief: reported belief on the adapted support.
        network: the trained network.
        x: the observed summary, shape [S].
    """
    if CORRECTIONS[correction].beyond is None:
        return network.estimator.posterior(network, x, belief.mixture, belief.support)
    return posterior_of(correction, belief, network.space, network.prior)


@functools.cache
def posterior_program(correction: str) -> Any:
    """The same, compiled, for one run: for the check that ends its rounds, and for later uses of its posterior."""
    return Program(single(functools.partial(posterior_after, correction)), posterior_after, correction)


def quick_options(estimator: Estimator) -> Options:
    """Compiler options for programs that compute with a density: those other than mixtures take long to run."""
    return QUICKEST if estimator.closed_form else QUICK


def posterior_of(correction: str, belief: Belief, space: Space, prior: Any = None) -> Posterior:
    """The posterior whose density is a belief's mixture of Gaussians, extended by the correction beyond the bounds."""
    beyond = CORRECTIONS[correction].beyond
    density = belief.mixture if beyond is None else beyond(belief.mixture, belief.support)
    return truncated(density, belief.mixture, belief.support, space, prior)


def start_one(task: Task, first: int | None, settings: Settings, run: RunInputs) -> State:
    """The state before the first round."""
    settings = _reading(task, settings, run)
    return algorithm.init(init_key(run_keys(run.key).run), task, run.support, settings, run.x, first)


def _reading(task: Task, settings: Settings, run: RunInputs) -> Settings:
    """The settings with an estimator adapted to the layout of the task's summary."""
    layout = summaries.layout(task.summary, run.observed.shape, run.x.shape[-1])
    return settings.replace(estimator=settings.estimator.for_layout(layout))


def check_keys(run: RunInputs, state: State) -> tuple[jax.Array, jax.Array]:
    """The keys for draws from the posterior after a run's last round, and for their simulations."""
    return run_keys(run.key).of_predictive(state.progress.rounds - 1)


def check_one(task: Task, settings: Settings, run: RunInputs, state: State) -> Discrepancy:
    """Distances of the posterior after a run's last round from truth and observation, for a simulator in JAX."""
    key_draw, key_simulate = check_keys(run, state)
    posterior = posterior_after(settings.correction, state.reported, state.network, run.x)
    theta = posterior.sample(key_draw, POSTERIOR_SAMPLES, space="inference")
    if not settings.predictive:
        return not_simulated(task, theta, run.observed, run.x.shape[-1])
    return discrepancy(key_simulate, task, theta, run.observed)


def round_one(
    task: Task, settings: Settings, run: RunInputs, state: State, index: Int[Array, ""] | int
) -> tuple[State, dict[str, Array]]:
    """One round of one run, and its record."""
    keys = round_keys(run_keys(run.key).run, index)
    state, info = algorithm.step(keys, task, settings, run.heuristic, run.x, state, index)
    return state, record(info, state.progress, check_one(task, settings, run, state))


def given_round_one(
    task: Task, settings: Settings, run: RunInputs, state: State, index: Int[Array, ""] | int, simulations: Simulations
) -> tuple[State, dict[str, Array]]:
    """One round of one run on given simulations, and its record."""
    keys = round_keys(run_keys(run.key).run, index)
    state, info = algorithm.update(keys.update, task, settings, run.heuristic, run.x, state, index, simulations)
    return state, record(info, state.progress, check_one(task, settings, run, state))


def run_one(task: Task, settings: Settings, run: RunInputs) -> tuple[State, dict[str, Array]]:
    """A whole run as one scan, and the records of its rounds, stacked: for traced functions (`jax.vmap` of `infer`)."""
    look = lambda index, state, info: record(info, state.progress, check_one(task, settings, run, state))
    settings = _reading(task, settings, run)
    return algorithm.run(run_keys(run.key).run, task, settings, run.heuristic, run.x, run.support, look)


class BatchEngine:
    """A batch as one compiled program: a `vmap` over runs, sharded over the local devices.

    Engines of equal tasks share their compiled programs: a second run of the same shapes compiles nothing.

    Attributes:
        references: reference subtracted from the summaries of each run, shape [L, S]; None for zero.
    """

    references: np.ndarray | None = None

    def __init__(
        self,
        task: Task,
        settings: Settings,
        inputs: RunInputs,
        devices: Sequence[Any] | None = None,
        first: Simulations | None = None,
    ):
        """Prepare, without compiling.

        Args:
            task: the task.
            settings: settings of all runs.
            inputs: stacked inputs of the runs.
            devices: devices to use; by default all local ones, at most one per run.
            first: simulations that replace those of the first round, the same for all runs.
        """
        self.task, self.settings, self.runs = task, settings, inputs.x.shape[0]
        devices = tuple(devices or jax.local_devices())[: self.runs]
        self.mesh = Mesh(np.asarray(devices), (AXIS,))
        self._padded = len(devices) * math.ceil(self.runs / len(devices))
        self.first = first
        self.load(inputs)

    @property
    def failure_messages(self) -> str:
        """Known failure reasons, as the end of an error message; compiled simulations have none."""
        return ""

    def start(self) -> State:
        """The state before the first round."""
        first = None if self.first is None else len(self.first.theta)
        start = program(functools.partial(start_one, self.task, first), self.mesh, (None, 0))
        return call(start, self.settings, self.inputs, options=QUICKEST)

    def begin(self, state: State) -> None:
        """Do the work that precedes the compilation of the first round: none if a round is one program."""

    def compile(self, state: State, index: int = 0) -> list[Any]:
        """Compile a round ahead of its first use, so that compilation is timed separately; returns its programs."""
        one, more = self._one(index)
        return [self._compiled(one, state, index, *more)]

    def round(self, state: State, index: int) -> tuple[State, dict[str, np.ndarray]]:
        """Step every run; `state` is consumed.

        Returns:
            The next state, and the round's record (`jaxlfi.bayessim.record.record`) with a leading axis over runs.
        """
        one, more = self._one(index)
        executable = self._compiled(one, state, index, *more)
        state, rows = executable(self.settings, self.inputs, state, jnp.asarray(index), *more)
        rows = jax.device_get(rows)
        return state, {name: value[: self.runs] for name, value in rows.items()}

    def first_round(self) -> Simulations:
        """The given simulations, for every run."""
        return self.place(jax.tree.map(lambda leaf: jnp.stack([leaf] * self.runs), self.first))

    def load(self, inputs: RunInputs) -> None:
        """Take the inputs of another batch of as many runs."""
        self.inputs = self.place(inputs)

    def fetch(self, state: State) -> State:
        """The state of the runs on the host, without padding."""
        return jax.tree.map(lambda leaf: leaf[: self.runs], jax.device_get(state))

    def place(self, tree: Any) -> Any:
        """Distribute a stacked batch over the devices, repeating the last run to fill them."""
        sharding = NamedSharding(self.mesh, PartitionSpec(AXIS))
        rows = np.minimum(np.arange(self._padded), self.runs - 1)
        padded = lambda leaf: jnp.asarray(leaf)[rows] if self._padded > self.runs else leaf
        return jax.tree.map(lambda leaf: jax.device_put(padded(leaf), sharding), tree)

    def _one(self, index: int) -> tuple[Callable, tuple]:
        """The function of a round for one run, and its further arguments."""
        if index == 0 and self.first is not None:
            return given_round_one, (self.first_round(),)
        return round_one, ()

    def _compiled(self, one: Callable, state: State, index: int, *more: Any) -> Any:
        # The round's index is not batched: loops over minibatches then have one trip count for all runs.
        in_axes = (None, 0, 0, None, *(0 for _ in more))
        many = program(functools.partial(one, self.task), self.mesh, in_axes, donate=(2,))
        return compiled(many, (self.settings, self.inputs, state, jnp.asarray(index), *more))


def _structure(rule: Heuristic) -> tuple:
    leaves, treedef = jax.tree.flatten(rule)
    return treedef, tuple(np.shape(leaf) for leaf in leaves)


def stack(trees: Sequence[Any]) -> Any:
    """Stack pytrees of the same structure along a leading axis, over which `vmap` maps.

    Example:
        >>> from jaxlfi.heuristics import Edge
        >>> stack([Edge(mass_threshold=tau) for tau in (0.005, 0.5)]).mass_threshold.shape
        (2,)
    """

    def leaf_stack(*leaves):
        array = np.stack([np.asarray(leaf) for leaf in leaves])
        return jnp.asarray(array)

    return jax.tree.map(leaf_stack, *trees)
