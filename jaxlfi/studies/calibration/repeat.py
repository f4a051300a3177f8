"""Repeat: what a run's method believes after each of many other simulations, chunk by chunk."""

import time
from collections.abc import Callable, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxlfi.bayessim.algorithm import batch as lanes
from jaxlfi.bayessim.batch import Inputs
from jaxlfi.bayessim.correction import CORRECTIONS
from jaxlfi.distributions.belief import Belief, uninformed
from jaxlfi.estimators.estimator import Network
from jaxlfi.estimators.posterior import posterior, truncated_draws, truncated_log_prob
from jaxlfi.io import files as atomic
from jaxlfi.io.progress import RoundProgress
from jaxlfi.runs.folder import StoreError
from jaxlfi.runs.inference import refuse_hopeless
from jaxlfi.studies.calibration.subject import DRAWS, RUNS, Plan, Subject
from jaxlfi.studies.grid import chunks

RUNS_A_DEVICE = 16
"""Repeated runs of a chunk on each device: a chunk is what a crash can lose."""
CONDITIONED = 100
"""Simulations of a chunk where a network is only conditioned on them."""


def chunk_length(subject: Subject, plan: Plan) -> int:
    """Truths whose posteriors are computed and saved together: as many as there is memory for, and not too many."""
    if subject.amortised:
        return min(plan.truths, CONDITIONED)
    devices = jax.local_device_count()

    def start(observed: jax.Array, x: jax.Array):
        one = jax.tree.map(lambda leaf: leaf[0], run_inputs(subject, plan, observed[None], x[None]))
        return lanes.start_one(subject.task, subject.run.settings, one)

    state = jax.eval_shape(start, subject.run.observed, subject.run.x)
    needed = chunks.PROGRAM_PER_STATE * sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state))
    most = int(chunks.SHARE * chunks.free_memory(jax.local_devices()) * devices / needed)
    return chunks.even_length(plan.truths, max(1, min(most, RUNS_A_DEVICE * devices)), devices)


def run_inputs(subject: Subject, plan: Plan, observed: jax.Array, x: jax.Array, first: int = 0) -> Inputs:
    """What lanes need to repeat the run for observations stacked along the first axis.

    Args:
        subject: the run.
        plan: for keys.
        observed: shape [n, ...].
        x: shape [n, S].
        first: place of the first among all truths; each place has a key of its own.
    """
    places = first + jnp.arange(len(x))
    keys = jax.vmap(lambda place: jax.random.fold_in(plan.key(RUNS), place))(places)
    support = jax.tree.map(jnp.asarray, subject.run.support)
    support, heuristic = (lanes.stack([tree] * len(x)) for tree in (support, subject.heuristic))
    return Inputs(keys, support, heuristic, jnp.asarray(observed), jnp.asarray(x))


def told_of(subject: Subject, draws: int) -> Callable[..., dict[str, jax.Array]]:
    """A function that draws from one posterior and tells densities; vmap it over truths.

    Args:
        subject: the run, for its settings.
        draws: L.

    Returns:
        A function of a key, a truth [D], its summary [S], the belief and the network.
    """
    estimator, scale = subject.run.settings.estimator, subject.run.scale

    def one(key: jax.Array, truth: jax.Array, x: jax.Array, belief: Belief, network: Network):
        theta, inside = truncated_draws(key, estimator, network, x, scale, belief, draws)
        both = jnp.concatenate([truth[None], theta])
        log_prob = truncated_log_prob(estimator, network, x, scale, belief, both, inside)
        return {
            "draws": theta,
            "log_prob": log_prob[1:],
            "truth_log_prob": log_prob[0],
            "inside": inside,
            "support_low": belief.support.low,
            "support_high": belief.support.high,
        }

    return one


def conditioned(subject: Subject, network: Network, key: jax.Array, x: jax.Array) -> Belief:
    """The belief that a run of one round would end with after another observation: its network, told of that one."""
    run = subject.run
    settings, heuristic = run.settings, jax.tree.map(jnp.asarray, subject.heuristic)
    prior = uninformed(run.support, settings.estimator.ensemble_size * settings.estimator.components)
    fitting = key if settings.estimator.is_flow else None  # an MDN is read off, a flow is drawn from
    q, _ = posterior(fitting, settings.estimator, network, x, run.scale, run.support)
    mixture, _ = CORRECTIONS[settings.correction].change(subject.task, q, prior)
    return heuristic(prior, mixture, run.scale)[0]


def amortised_chunks(subject: Subject, plan: Plan) -> Callable[[Mapping[str, np.ndarray], int], Mapping]:
    """A function of a chunk's truths and its first place, to the arrays that tell of their posteriors."""
    tell = told_of(subject, plan.draws)
    network = subject.run.network

    def one(network: Network, key: jax.Array, truth: jax.Array, x: jax.Array):
        key_condition, key_draw = jax.random.split(key)
        return tell(key_draw, truth, x, conditioned(subject, network, key_condition, x), network)

    program = jax.jit(jax.vmap(one, in_axes=(None, 0, 0, 0)))
    return lambda truths, first: program(network, _draw_keys(plan, truths, first), truths["theta"], truths["x"])


def repeated_chunks(
    subject: Subject, plan: Plan, progress: RoundProgress
) -> Callable[[Mapping[str, np.ndarray], int], Mapping]:
    """As `amortised_chunks`, by running the whole inference again for each truth."""
    program = jax.jit(jax.vmap(told_of(subject, plan.draws)))
    rounds = subject.run.settings.rounds
    engine = None

    def chunk(truths: Mapping[str, np.ndarray], first: int) -> Mapping:
        nonlocal engine
        inputs = run_inputs(subject, plan, truths["observed"], truths["x"], first)
        if engine is None:
            began = time.perf_counter()
            engine = chunks.ChunkEngine(subject.task, subject.run.settings, inputs)
            engine.compile(engine.start())
            progress.compiled(time.perf_counter() - began)
        engine.load(inputs)
        state = engine.start()
        for index in range(rounds):
            state, rows = engine.round(state, index)
            if index == first == 0:
                refuse_hopeless(rows["succeeded"], rows["failed"], subject.task)
            progress.advance()
        state = engine.fetch(state)
        keys = _draw_keys(plan, truths, first)
        return program(keys, truths["theta"], truths["x"], state.belief, state.network)

    return chunk


def _draw_keys(plan: Plan, truths: Mapping[str, np.ndarray], first: int) -> jax.Array:
    places = first + jnp.arange(len(truths["x"]))
    return jax.vmap(lambda place: jax.random.fold_in(plan.key(DRAWS), place))(places)


def posteriors(
    out: Path, subject: Subject, plan: Plan, truths: Mapping[str, np.ndarray], length: int, console: Console
) -> dict[str, np.ndarray]:
    """The posteriors of all truths, chunk by chunk; those that are there already are read.

    Args:
        out: the folder of the diagnostics.
        subject: the run.
        plan: what is asked of it.
        truths: of `draw_truths`.
        length: of a chunk. The last one is filled up by its last truth, so that one program serves them all.
        console: for progress.

    Raises:
        StoreError: for a damaged chunk, before anything is computed.
        SimulatorError: for a simulator that fails always.
    """
    places = [range(first, min(first + length, plan.truths)) for first in range(0, plan.truths, length)]
    paths = [out / "chunks" / f"{index:03d}.npz" for index in range(len(places))]
    found = {index: read_arrays(path) for index, path in enumerate(paths) if path.exists()}

    def compute_others(compute: Callable[[Mapping[str, np.ndarray], int], Mapping]) -> None:
        for index, own in enumerate(places):
            if index in found:
                continue
            rows = np.minimum(own.start + np.arange(length), own.stop - 1)
            chunk = {name: truths[name][rows] for name in ("theta", "observed", "x")}
            arrays = jax.device_get(compute(chunk, own.start))
            found[index] = {name: value[: len(own)] for name, value in arrays.items()}
            atomic.write_arrays(paths[index], found[index], durable=True)

    if subject.amortised:
        console.print(f"{subject.task.name}: conditioning the run's network on {plan.truths} simulations")
        compute_others(amortised_chunks(subject, plan))
    else:
        label = f"{subject.task.name}: the run again for {plan.truths} simulations, in {len(places)} chunks of {length}"
        rounds = subject.run.settings.rounds
        with RoundProgress(console, rounds * len(places), rounds * len(found), label) as progress:
            compute_others(repeated_chunks(subject, plan, progress))
    return {name: np.concatenate([found[index][name] for index in range(len(places))]) for name in found[0]}


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Arrays that an earlier command left.

    Raises:
        StoreError: where they are damaged; they are left as they are.
    """
    try:
        return atomic.read_arrays(path)
    except ValueError as error:
        raise StoreError(f"{error}: delete it, and the same command computes it again") from error
