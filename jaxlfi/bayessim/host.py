"""Rounds around a host simulator: inference is compiled, and simulations run between its parts.

The parts of a round before its simulations (drawing parameters) and after them (fitting, adapting) are compiled; the
simulator is called in between (`jaxlfi.tasks.simulation.simulate_in_waves`).
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.bayessim.algorithm import State
from jaxlfi.bayessim.batch import BatchEngine, RunInputs
from jaxlfi.bayessim.multi_process import SharedEngine
from jaxlfi.bayessim.settings import Settings
from jaxlfi.bayessim.staged import StagedEngine
from jaxlfi.diagnostics.discrepancy import Discrepancy, compared, not_simulated
from jaxlfi.io.executables import Call
from jaxlfi.io.processes import ALONE, Processes
from jaxlfi.tasks.host import require_success
from jaxlfi.tasks.journal import Journal
from jaxlfi.tasks.reference import counted_from, reference_of
from jaxlfi.tasks.simulation import Simulations, simulate_batch, simulate_in_waves
from jaxlfi.tasks.summaries import layout
from jaxlfi.tasks.task import Task


def engine_for(
    task: Task,
    settings: Settings,
    inputs: RunInputs,
    first: Simulations | None = None,
    journal: Journal | None = None,
    processes: Processes = ALONE,
) -> BatchEngine | SharedEngine:
    """The engine that steps a batch: one compiled program, possibly in several processes, or stages.

    A single run is stepped in stages, and so are rounds around a host simulator.

    Raises:
        ValueError: for a host simulator in several processes.
    """
    if processes.count > 1:
        if task.on_host:
            raise ValueError("processes: expected a simulator in JAX; for others use --workers or --scheduler")
        return SharedEngine(task, settings, inputs, processes, first)
    if task.on_host:
        return HostEngine(task, settings, inputs, first, journal)
    if len(inputs.x) == 1:
        return StagedEngine(task, settings, inputs, first)
    return BatchEngine(task, settings, inputs, first=first)


class HostEngine(StagedEngine):
    """Steps the runs of a batch by one round each, simulating them one after another on the host."""

    references: np.ndarray

    def __init__(
        self,
        task: Task,
        settings: Settings,
        inputs: RunInputs,
        first: Simulations | None = None,
        journal: Journal | None = None,
    ):
        """Prepare, without compiling; see `BatchEngine` and `engine_for`."""
        self.journal = journal or Journal()
        self._begun: Simulations | None = None
        super().__init__(task, settings, inputs, first)

    def load(self, inputs: RunInputs) -> None:
        """Take the inputs of a batch, with summaries relative to the observed ones (`jaxlfi.tasks.reference`)."""
        self.observed = np.asarray(inputs.observed)
        self.references = _references(self.task, self.settings, self.observed, np.asarray(inputs.x, float))
        super().load(inputs.replace(x=counted_from(self.references, inputs.x)))
        self._last_seen: list[Discrepancy | None] = [None] * self.runs

    def start(self) -> State:
        """The state before the first round; statistics of a series are those of differences plus their reference."""
        state = super().start()
        regression = state.network.regression
        if regression is None:
            return state
        by_channel = self.references.reshape(self.runs, -1, regression.channels)
        origin = (by_channel - by_channel.mean(axis=1, keepdims=True)).reshape(self.references.shape)
        regression = regression.replace(origin=self.place(origin.astype(np.float32)))
        return state.replace(network=state.network.replace(regression=regression))

    def first_round(self) -> Simulations:
        """The given simulations, for every run."""
        given = jax.tree.map(lambda leaf: np.stack([leaf] * self.runs), self.first)
        x = np.where(given.kept[..., None], counted_from(self.references[:, None], given.x), 0.0)
        return self.place(given.replace(x=x))

    @property
    def failure_messages(self) -> str:
        """The first message of each reason for which simulations failed."""
        return self.journal.failure_messages

    def begin(self, state: State) -> None:
        """Simulate the first round before the rest is compiled: a simulator that does not work stops the run at once.

        Raises:
            SimulatorError: if no simulation succeeds.
        """
        if self.first is None:
            inputs = (self.settings, self.inputs, state, jnp.asarray(0))
            self._begun = made = self.simulated(inputs, np.zeros(self.runs, bool))
            reasons = self.task.reasons
            succeeded, failed = jax.device_get((made.kept.sum(axis=-1), made.failed(len(reasons))))
            require_success(succeeded, failed, reasons, self.failure_messages)

    def simulated(self, inputs: tuple, settled: np.ndarray) -> Simulations:
        """The simulations of a round, none for settled runs; those of the first round may have been made by `begin`."""
        if self._begun is not None:
            begun, self._begun = self._begun, None
            return begun
        theta, keys = self.proposed(inputs)
        shape, wanted = self.inputs.observed.shape[1:], self.settings.simulations_per_round
        made = []
        for run, (key, own, over) in enumerate(zip(keys, theta, settled, strict=True)):
            self.journal.run = run
            simulate = functools.partial(simulate_in_waves, key, self.task, own, wanted, shape, self.journal)
            made.append(self._nothing(own) if over else simulate(self.references[run]))
        self.journal.run = None
        return _stacked(made)

    def simulations_like(self, theta: jax.ShapeDtypeStruct, keys: jax.ShapeDtypeStruct) -> Simulations:
        """Shapes of a round's simulations."""
        return jax.eval_shape(jax.vmap(self._nothing), theta)

    def simulating(self, proposed: tuple) -> list[Call]:
        """None: no compiled program holds the simulator."""
        return []

    def comparing(self, drawn: list) -> list[Call]:
        """None, likewise."""
        return []

    def _nothing(self, theta: jax.Array) -> Simulations:
        """The empty round of a settled run: no simulations of the parameters [A, D]."""
        flags = jnp.zeros(len(theta), bool)
        x = jnp.zeros((len(theta), self.inputs.x.shape[-1]))
        return Simulations(theta, x, jnp.zeros(len(theta), jnp.int32), flags, flags, jnp.ones(len(theta)))

    def compared(self, theta: jax.Array, keys: jax.Array, settled: np.ndarray) -> Discrepancy:
        """Distances of the runs' posteriors from truth and observation; for settled runs, the last ones."""
        for run, (own, key) in enumerate(zip(theta, keys, strict=True)):
            last = self._last_seen[run]
            if settled[run] and last is not None:
                self._last_seen[run] = last.replace(simulated=jnp.zeros_like(last.simulated))
            else:
                self._last_seen[run] = self._discrepancy(key, own, self.observed[run])
        return _stacked(self._last_seen)

    def _discrepancy(self, key: jax.Array, theta: jax.Array, observed: np.ndarray) -> Discrepancy:
        if not self.settings.predictive:
            return not_simulated(self.task, theta, observed, self.inputs.x.shape[-1])
        simulated = simulate_batch(key, self.task, theta, observed.shape, journal=self.journal)
        return compared(self.task, theta, *simulated, observed)


def _references(task: Task, settings: Settings, observed: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The reference subtracted from the summaries of each run, shape [L, S]; zero if they are not normalised."""
    estimator = settings.estimator
    if estimator.normaliser == "none":
        return np.zeros_like(x)
    alike = estimator.for_layout(layout(task.summary, observed.shape[1:], x.shape[1])).shared_record
    return np.stack([reference_of(own, alike) for own in x])


def _stacked(trees: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)
