"""Black boxes: inference around a simulator in plain Python or NumPy, outside of the compiled program.

What comes before the simulations of a round (drawing parameters) and after (fitting, adapting) is compiled;
the simulator is called between, in waves: first for as many parameter vectors as simulations_per_round are wanted, then
for as many as failed, until the simulations_per_round are reached or the attempts are spent. Nothing is simulated that
is not needed.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.bayessim.algorithm import Round, Settings, State
from jaxlfi.bayessim.algorithm import algorithm as bayessim
from jaxlfi.bayessim.batch import Inputs, diagnose_key, round_key, start_one
from jaxlfi.bayessim.record import record
from jaxlfi.diagnostics import POSTERIOR_SAMPLES, Discrepancy, trajectory_distance
from jaxlfi.distributions.belief import RESTRICTIONS
from jaxlfi.tasks.observation import SimulatorError, numpy_generator
from jaxlfi.tasks.simulation import Simulations, summarised, with_outcome, within_budget
from jaxlfi.tasks.task import Task


class BlackBoxEngine:
    """Steps lanes by one round each, one after another on the host (`jaxlfi.bayessim.batch.Engine`)."""

    def __init__(self, task: Task, settings: Settings, inputs: Inputs):
        """Prepare, without compiling.

        Args:
            task: a task whose simulator takes a `numpy.random.Generator` and many parameter vectors.
            settings: the same for all lanes.
            inputs: stacked.
        """
        self.lanes = inputs.x.shape[0]
        self._task, self._settings, self._inputs = task, settings, inputs
        self._start = jax.jit(jax.vmap(functools.partial(start_one, task, settings)))
        self._propose = jax.jit(jax.vmap(self._propose_one, in_axes=(0, 0, None)))
        self._update = jax.jit(jax.vmap(self._update_one, in_axes=(0, 0, None, 0)))
        self._draw = jax.jit(jax.vmap(functools.partial(_draw, settings.restriction)))

    def start(self) -> State:
        """The state before the first round."""
        return self._start(self._inputs)

    def compile(self, state: State) -> None:
        """Compile the parts of a round ahead of their first use."""
        index = jnp.asarray(0)
        self._propose = self._propose.lower(self._inputs, state, index).compile()
        theta, _ = jax.eval_shape(self._propose_one_stacked, self._inputs, state, index)
        attempts = _empty_attempts(theta.shape, self._inputs.x.shape[-1])
        self._update = self._update.lower(self._inputs, state, index, attempts).compile()

    def step(self, state: State, index: int) -> tuple[State, Round]:
        """Step every lane."""
        theta, keys = self._propose(self._inputs, state, jnp.asarray(index))
        lanes = [
            simulate_within_budget(
                self._task, key, lane_theta, self._settings.simulations_per_round, self._inputs.observed.shape[1:]
            )
            for key, lane_theta in zip(keys, theta, strict=True)
        ]
        attempts = jax.tree.map(lambda *leaves: jnp.stack(leaves), *lanes)
        return self._update(self._inputs, state, jnp.asarray(index), attempts)

    def round(self, state: State, index: int) -> tuple[State, dict[str, np.ndarray]]:
        """Step every lane, and compare its posterior with the truth."""
        state, info = self.step(state, index)
        keys = jax.vmap(lambda lane: diagnose_key(lane, index))(self._inputs)
        seen = discrepancies(keys, self._task, info.belief, self._inputs.observed, self._settings.restriction)
        return state, jax.device_get(record(info, seen))

    def fetch(self, state: State) -> State:
        """The state of the lanes on the host."""
        return jax.device_get(state)

    def place(self, tree):
        """Lanes as the compiled parts take them."""
        return jax.tree.map(jnp.asarray, tree)

    def _propose_one(self, lane: Inputs, state: State, index):
        key_propose, key_simulate, _ = jax.random.split(round_key(lane, index), 3)
        return bayessim.propose(key_propose, self._task, self._settings, state.belief), key_simulate

    def _propose_one_stacked(self, inputs: Inputs, state: State, index):
        return jax.vmap(self._propose_one, in_axes=(0, 0, None))(inputs, state, index)

    def _update_one(self, lane: Inputs, state: State, index, attempts: Simulations):
        _, _, key_update = jax.random.split(round_key(lane, index), 3)
        return bayessim.update(key_update, self._task, self._settings, lane.heuristic, lane.x, state, index, attempts)


def simulate_within_budget(
    task: Task, key: jax.Array, theta: jax.Array, simulations_per_round: int, shape: Sequence[int]
) -> Simulations:
    """Simulate parameters in their order until enough have succeeded or all are spent.

    Args:
        task: a black box.
        key: seeds the simulator's generator.
        theta: proposals in coordinates, shape [A, D].
        simulations_per_round: how many successes are wanted.
        shape: of a trajectory.
    """
    natural = np.asarray(task.to_natural(theta))
    budget = len(natural)
    trajectories = np.zeros((budget, *shape), np.float32)
    outcomes = np.full(budget, 1)  # what was not attempted is no success
    rng = numpy_generator(key)
    done, successes = 0, 0
    while done < budget and successes < simulations_per_round:
        wave = slice(done, min(budget, done + simulations_per_round - successes))
        trajectories[wave], outcomes[wave] = call(task, rng, natural[wave], shape)
        x, failure = _summaries(task, jnp.asarray(trajectories), jnp.asarray(outcomes))
        done = wave.stop
        successes = int(np.sum(np.asarray(failure)[:done] == 0))
    return within_budget(theta, x, failure, simulations_per_round)


def call(
    task: Task, rng: np.random.Generator, theta: np.ndarray, shape: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Call a black box and check what it gives: trajectories [N, T, C] and failure codes [N], 0 for success.

    Raises:
        SimulatorError: if it raises, or gives other shapes.
    """
    try:
        result = task.simulate(rng, theta)
    except Exception as error:
        raise SimulatorError(f"simulate: {type(error).__name__}: {error}") from error
    trajectory, outcome = result if isinstance(result, tuple) and len(result) == 2 else (result, None)
    trajectory = np.asarray(trajectory)
    if trajectory.shape != (len(theta), *shape) or trajectory.dtype.kind not in "biuf":
        raise SimulatorError(
            f"simulate: expected numbers of shape {[len(theta), *shape]} for {len(theta)} parameter vectors, "
            f"got {trajectory.dtype} of shape {list(trajectory.shape)}"
        )
    outcome = np.zeros(len(theta), int) if outcome is None else np.asarray(outcome)
    if outcome.shape != (len(theta),) or outcome.dtype.kind not in "biu":
        raise SimulatorError(
            f"simulate: expected an outcome for each of {len(theta)} simulations, "
            f"got {outcome.dtype} of shape {list(outcome.shape)}"
        )
    return trajectory, np.where(outcome, 0, 1) if outcome.dtype == bool else outcome


@functools.partial(jax.jit, static_argnums=0)
def _summaries(task: Task, trajectories: jax.Array, outcomes: jax.Array) -> tuple[jax.Array, jax.Array]:
    one = lambda trajectory, outcome: summarised(task, *with_outcome(task, trajectory, outcome))
    return jax.vmap(one)(trajectories, outcomes)


def discrepancies(keys: jax.Array, task: Task, beliefs, observed: jax.Array, restriction: str) -> Discrepancy:
    """As `jaxlfi.diagnostics.discrepancy`, for several beliefs of a black box, stacked along a leading axis.

    Args:
        keys: one for each belief.
        task: a black box.
        beliefs: stacked.
        observed: the observed trajectories, stacked.
        restriction: how draws are kept in the support.
    """
    theta, keys_simulate = jax.vmap(functools.partial(_draw, restriction))(keys, beliefs)
    shape = observed.shape[1:]
    simulated = [
        call(task, numpy_generator(key), np.asarray(task.to_natural(draws)), shape)
        for key, draws in zip(keys_simulate, theta, strict=True)
    ]
    trajectory = jnp.stack([jnp.asarray(trajectory, jnp.float32) for trajectory, _ in simulated])
    outcome = jnp.stack([jnp.asarray(outcome) for _, outcome in simulated])
    distance = jax.vmap(lambda draws, seen: jax.vmap(lambda t: trajectory_distance(t, seen))(draws))
    finite = jnp.all(jnp.isfinite(trajectory.reshape(*trajectory.shape[:2], -1)), axis=-1)
    error = jnp.where((outcome == 0) & finite, distance(trajectory, observed), jnp.nan)
    truth = jnp.full(task.dim, jnp.nan) if task.truth is None else task.truth
    x, failure = jax.vmap(functools.partial(_summaries, task))(trajectory, outcome)
    x = jnp.where((failure == 0)[..., None], x, jnp.nan)
    return Discrepancy(theta, jnp.abs(theta - truth), error, trajectory, x)


def _draw(restriction: str, key: jax.Array, belief) -> tuple[jax.Array, jax.Array]:
    key_draw, key_simulate = jax.random.split(key)
    return RESTRICTIONS[restriction](key_draw, belief, POSTERIOR_SAMPLES), key_simulate


def _empty_attempts(theta_shape: tuple[int, ...], obs: int) -> Simulations:
    flags = jnp.zeros(theta_shape[:-1], bool)
    return Simulations(
        theta=jnp.zeros(theta_shape),
        x=jnp.zeros((*theta_shape[:-1], obs)),
        failure=jnp.zeros(theta_shape[:-1], jnp.int32),
        counted=flags,
        kept=flags,
    )
