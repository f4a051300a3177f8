"""A round in stages, each a compiled program of its own: propose, simulate, gather, train, conclude, compare.

Only two of them, simulate and compare, contain the user's simulator. The others depend on shapes and settings alone: a
second simulator with the same shapes finds them in the cache of compiled programs (`jaxlfi.io.compile_cache`), and
simulations may come from anywhere (`jaxlfi.bayessim.host`). All are compiled in parallel. Most of a round's time is
training and simulation: these are compiled for fast execution, and the others for fast compilation.
"""

import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxlfi.bayessim import algorithm
from jaxlfi.bayessim.algorithm import Gathered, Round, State
from jaxlfi.bayessim.batch import BatchEngine, RunInputs, check_keys, posterior_program, quick_options
from jaxlfi.bayessim.keys import round_keys, run_keys
from jaxlfi.bayessim.programs import program
from jaxlfi.bayessim.record import record
from jaxlfi.bayessim.settings import Settings
from jaxlfi.diagnostics.discrepancy import POSTERIOR_SAMPLES, Discrepancy, discrepancy, not_simulated
from jaxlfi.estimators.posterior import PORTION, sampler
from jaxlfi.estimators.training import FitInfo, Lesson, fit_keys, train
from jaxlfi.io.executables import QUICK, THOROUGH, Call, Options, call, compile_all
from jaxlfi.tasks.simulation import Simulations, simulate, within_budget
from jaxlfi.tasks.task import Task

FEW_PARAMETERS, FEW_NUMBERS = 8, 200_000
"""Numbers of parameters, and of values in a run's summaries, up to which compilation dominates a mixture's time."""


def propose_one(
    prior: Any, settings: Settings, run: RunInputs, state: State, index: Int[Array, ""] | int
) -> tuple[Float[Array, "attempts dim"], jax.Array]:
    """Proposals of a round, and the key for their simulations."""
    keys = round_keys(run_keys(run.key).run, index)
    before = algorithm.support_before(state, index)
    return algorithm.propose(keys.propose, prior, settings, state.belief, before), keys.simulate


def simulate_one(task: Task, settings: Settings, theta: Float[Array, "attempts dim"], key: jax.Array) -> Simulations:
    """The simulations of a round's proposals."""
    return within_budget(theta, *simulate(key, task, theta), settings.simulations_per_round)


def gather_one(
    prior: Any, settings: Settings, run: RunInputs, state: State, index: Int[Array, ""] | int, simulations: Simulations
) -> Gathered:
    """The dataset with a round's simulations, and the network ready to be trained on it."""
    key_fit, _ = _update_keys(settings, run, index)
    return algorithm.gather(key_fit, prior, settings, state, index, simulations)


def train_one(
    settings: Settings, run: RunInputs, state: State, index: Int[Array, ""] | int, lesson: Lesson
) -> tuple[dict, FitInfo]:
    """The trained weights of the network, and the losses."""
    _, key_train = fit_keys(_update_keys(settings, run, index)[0])
    return train(key_train, lesson, algorithm.expected_size(settings, state, index))


def conclude_one(
    prior: Any,
    reasons: int,
    settings: Settings,
    run: RunInputs,
    state: State,
    index: Int[Array, ""] | int,
    gathered: Gathered,
    learnt: tuple[dict, FitInfo],
) -> tuple[State, Round, tuple[jax.Array, jax.Array]]:
    """The end of a round, and the keys for the draws that check its posterior and for their simulations."""
    _, key = _update_keys(settings, run, index)
    state, info = algorithm.conclude(
        key, prior, reasons, settings, run.heuristic, run.x, state, index, gathered, learnt
    )
    return state, info, check_keys(run, state)


def _update_keys(settings: Settings, run: RunInputs, index: Int[Array, ""] | int) -> tuple[jax.Array, jax.Array | None]:
    """The keys for a round's training and conditioning."""
    return settings.estimator.keys(round_keys(run_keys(run.key).run, index).update)


def compare_one(
    task: Task, settings: Settings, run: RunInputs, theta: Float[Array, "samples dim"], key: jax.Array
) -> Discrepancy:
    """Distances of a posterior's draws from truth and observation."""
    if not settings.predictive:
        return not_simulated(task, theta, run.observed, run.x.shape[-1])
    return discrepancy(key, task, theta, run.observed)


class StagedEngine(BatchEngine):
    """Steps a batch on one device in stages. Up to rounding, the results are those of `BatchEngine`."""

    def __init__(self, task: Task, settings: Settings, inputs: RunInputs, first: Simulations | None = None):
        """Prepare, without compiling; see `BatchEngine`."""
        super().__init__(task, settings, inputs, devices=jax.local_devices()[:1], first=first)
        prior, shared = task.inference.prior, (None, 0, 0, None)
        stage = lambda one, bound, *axes, **how: program(functools.partial(one, *bound), self.mesh, axes, **how)
        self._propose = stage(propose_one, (prior,), *shared)
        self._simulate = stage(simulate_one, (task,), None, 0, 0)
        self._gather = stage(gather_one, (prior,), *shared, 0)
        self._train = stage(train_one, (), *shared, 0)
        self._conclude = stage(conclude_one, (prior, len(task.reasons)), *shared, 0, 0, donate=(2,))
        self._posterior = posterior_program(settings.correction)
        self._compare = stage(compare_one, (task,), None, 0, 0, 0)

    def compile(self, state: State, index: int = 0) -> list[Any]:
        """Compile all stages ahead of their first use; returns them."""
        return compile_all(self.calls((self.settings, self.inputs, state, jnp.asarray(index)), self._given(index)))

    def calls(self, inputs: tuple, given: bool = False) -> Iterator[Call]:
        """The stages with their arguments; the shapes that a stage returns are known once it has been traced.

        Args:
            inputs: settings, inputs of the runs, their state, and the index of the round.
            given: whether the simulations of the round are given.
        """
        yield self._propose, inputs, self._options(inputs)
        proposed = self._propose.shapes(*inputs)
        yield from self.simulating(proposed)
        made = self.first_round() if given else self.simulations_like(*proposed)
        yield self._gather, (*inputs, made), self._options(inputs)
        gathered = self._gather.shapes(*inputs, made)
        yield self._train, (*inputs, gathered.lesson), THOROUGH
        learnt = self._train.shapes(*inputs, gathered.lesson)
        yield self._conclude, (*inputs, gathered, learnt), self._options(inputs)
        after, _, (draw, keys) = self._conclude.shapes(*inputs, gathered, learnt)
        of_one = lambda tree: jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), tree)
        ended = of_one((after.reported, after.network, self.inputs.x))
        yield self._posterior, ended, quick_options(self.settings.estimator)
        posterior = self._posterior.shapes(*ended)
        yield sampler(PORTION), (of_one(draw), posterior), posterior.quick
        theta = jax.ShapeDtypeStruct((self.runs, POSTERIOR_SAMPLES, self.task.dim), np.float32)
        yield from self.comparing([theta, keys])

    def round(self, state: State, index: int) -> tuple[State, dict[str, np.ndarray]]:
        """Step every run; see `BatchEngine.round`."""
        inputs, settled = (self.settings, self.inputs, state, jnp.asarray(index)), np.asarray(state.progress.settled)
        made = self.first_round() if self._given(index) else self.simulated(inputs, settled)
        options = self._options(inputs)
        gathered = call(self._gather, *inputs, made, options=options)
        learnt = call(self._train, *inputs, gathered.lesson)
        state, info, (draw, keys) = call(self._conclude, *inputs, gathered, learnt, options=options)
        seen = self.compared(self.drawn(draw, state), keys, settled)
        return state, jax.device_get(record(info, state.progress, seen))

    def drawn(self, keys: jax.Array, state: State) -> Float[Array, "run samples dim"]:
        """Draws from each run's posterior, by the programs that are also used for finished runs."""
        numbers, kind = jax.random.key_data(keys), jax.random.key_impl(keys)
        given = jax.device_get((numbers, state.reported, state.network, self.inputs.x))

        def one(run: int) -> np.ndarray:
            key, *own = jax.tree.map(lambda leaf: leaf[run], given)
            posterior = call(self._posterior, *own, options=quick_options(self.settings.estimator))
            draws = posterior.sample(jax.random.wrap_key_data(key, impl=kind), POSTERIOR_SAMPLES, space="inference")
            return np.asarray(draws)

        return jnp.asarray(np.stack([one(run) for run in range(self.runs)]))

    def proposed(self, inputs: tuple) -> tuple[jax.Array, jax.Array]:
        """Proposals of a round, shape [L, A, D], and the keys for their simulations."""
        return call(self._propose, *inputs, options=self._options(inputs))

    def simulated(self, inputs: tuple, settled: np.ndarray) -> Simulations:
        """The simulations of a round, proposed from these inputs; those of settled runs are arbitrary."""
        return call(self._simulate, self.settings, *self.proposed(inputs))

    def compared(self, theta: jax.Array, keys: jax.Array, settled: np.ndarray) -> Discrepancy:
        """Distances of draws from the posteriors, shape [L, N, D], from truth and observation."""
        return call(self._compare, self.settings, self.inputs, theta, keys, options=QUICK)

    def simulations_like(self, theta: jax.ShapeDtypeStruct, keys: jax.ShapeDtypeStruct) -> Simulations:
        """Shapes of a round's simulations."""
        return self._simulate.shapes(self.settings, theta, keys)

    def simulating(self, proposed: tuple) -> list[Call]:
        """The stage that simulates proposals of these shapes, with its arguments."""
        return [(self._simulate, (self.settings, *proposed), THOROUGH)]

    def comparing(self, drawn: list) -> list[Call]:
        """The stage that compares draws of these shapes with truth and observation, with its arguments."""
        return [(self._compare, (self.settings, self.inputs, *drawn), QUICK)]

    def _options(self, inputs: tuple) -> Options:
        """Compiler options for all stages except training and the simulator."""
        dataset = inputs[2].dataset
        _, rows, numbers = dataset.x.shape
        few = dataset.theta.shape[-1] <= FEW_PARAMETERS and rows * numbers <= FEW_NUMBERS
        return quick_options(self.settings.estimator) if few else QUICK

    def _given(self, index: int) -> bool:
        return index == 0 and self.first is not None
