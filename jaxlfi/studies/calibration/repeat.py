"""Repeat: the posteriors that a run's method infers from many other observations, chunk by chunk."""

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxlfi.bayessim.batch import RunInputs, posterior_after, stack, start_one
from jaxlfi.bayessim.host import engine_for
from jaxlfi.bayessim.memory import PROGRAM_PER_STATE, budget, even_length, state_bytes
from jaxlfi.bayessim.rounds import run_rounds
from jaxlfi.diagnostics.discrepancy import POSTERIOR_SAMPLES
from jaxlfi.distributions.precision import single
from jaxlfi.estimators.posterior import Posterior
from jaxlfi.io import files as atomic
from jaxlfi.io.progress import RoundProgress
from jaxlfi.io.workfolder import StoreError
from jaxlfi.runs.run import Run
from jaxlfi.studies.calibration.plan import DRAWS, RUNS, CalibrationPlan
from jaxlfi.studies.chunk_store import ChunkStore

RUNS_PER_DEVICE = 16
"""Largest number of repeated runs of a chunk on each device; a crash loses at most one chunk."""
CONDITIONED = 100
"""Largest number of simulations of a chunk if a network is only conditioned on them."""
RESULTS = ("draws", "log_prob", "truth_log_prob", "mass_inside", "support_low", "support_high")
"""Quantities stored for each truth's posterior."""


def chunk_length(run: Run, plan: CalibrationPlan) -> int:
    """Number of truths whose posteriors are computed and saved together, limited by memory and by loss in a crash."""
    if run.amortised:
        return min(plan.truths, CONDITIONED)
    devices = jax.local_device_count()

    def start(observed: jax.Array, x: jax.Array):
        one = jax.tree.map(lambda leaf: leaf[0], run_inputs(run, plan, observed[None], x[None]))
        return start_one(run.task, None, run.settings, one)

    needed = PROGRAM_PER_STATE * state_bytes(jax.eval_shape(start, run.observed, run.x))
    most = int(budget() * devices / needed)
    return even_length(plan.truths, max(1, min(most, RUNS_PER_DEVICE * devices)), devices)


def run_inputs(run: Run, plan: CalibrationPlan, observed: jax.Array, x: jax.Array, first: int = 0) -> RunInputs:
    """Inputs of a batch that repeats the run for observations [n, ...] with summaries [n, S].

    `first` is the index of the first one among all truths; each index has its own key.
    """
    support = jax.tree.map(jnp.asarray, run.support)
    support, heuristic = (stack([tree] * len(x)) for tree in (support, run.heuristic))
    return RunInputs(_keys(plan, RUNS, first, len(x)), support, heuristic, observed, x)


def described(key: jax.Array, truth: jax.Array, posterior: Posterior, draws: int) -> dict[str, jax.Array]:
    """Draws from one posterior with their log-densities, and that of the truth, in inference space."""
    theta = posterior.sample(key, draws, space="inference")
    log_prob = posterior.log_prob(jnp.concatenate([truth[None], theta]), space="inference")
    return {
        "draws": theta,
        "log_prob": log_prob[1:],
        "truth_log_prob": log_prob[0],
        "mass_inside": posterior.mass_inside,
        "support_low": posterior.support.low,
        "support_high": posterior.support.high,
    }


Chunk = Callable[[Mapping[str, np.ndarray], int], tuple[Mapping[str, Any], float]]
"""Function from a chunk's truths and the index of the first to `RESULTS` and the time they took, in s."""


def amortised_chunks(run: Run, plan: CalibrationPlan) -> Chunk:
    """Posteriors from the network of a run of one round."""

    def chunk(truths: Mapping[str, np.ndarray], first: int):
        began = time.perf_counter()
        keys = _keys(plan, DRAWS, first, len(truths["x"]))
        x = run.counted(truths["x"])
        found = jax.device_get(_by_network(run, keys, truths["theta"], x, plan.draws))
        return found, time.perf_counter() - began

    return chunk


def repeated_chunks(run: Run, plan: CalibrationPlan, progress: RoundProgress) -> Chunk:
    """Posteriors from repeating the whole inference for each truth."""

    def chunk(truths: Mapping[str, np.ndarray], first: int):
        began = time.perf_counter()
        engine = engine_for(run.task, run.settings, run_inputs(run, plan, truths["observed"], truths["x"], first))
        compiled = lambda seconds: progress.compiled(seconds) if first == 0 else None
        made = 0

        def each(*_: Any) -> None:
            nonlocal made
            made += 1
            progress.advance()

        state = run_rounds(engine, engine.start(), range(run.settings.rounds), each, compiled)
        if made < run.settings.rounds:  # all had settled early
            progress.advance(run.settings.rounds - made)
        keys, x = _keys(plan, DRAWS, first, len(truths["x"])), np.asarray(engine.inputs.x)[: len(truths["x"])]
        correction, states = run.settings.correction, engine.fetch(state)
        found = jax.device_get(_by_states(correction, keys, truths["theta"], x, states, plan.draws))
        return found, time.perf_counter() - began

    return chunk


# Compiled once for all references and chunks.


@functools.partial(jax.jit, static_argnums=4)
@single
@functools.partial(jax.vmap, in_axes=(None, 0, 0, 0, None))
def _by_network(run: Run, key: jax.Array, truth: jax.Array, x: jax.Array, draws: int):
    key_condition, key_draw = jax.random.split(key)
    return described(key_draw, truth, run.conditioned(x, key_condition), draws)


@functools.partial(jax.jit, static_argnums=(0, 5))
@single
@functools.partial(jax.vmap, in_axes=(None, 0, 0, 0, 0, None))
def _by_states(correction: str, key: jax.Array, truth: jax.Array, x: jax.Array, state: Any, draws: int):
    return described(key, truth, posterior_after(correction, state.reported, state.network, x), draws)


def _keys(plan: CalibrationPlan, purpose: int, first: int, count: int) -> jax.Array:
    return jax.vmap(lambda place: jax.random.fold_in(plan.key(purpose), place))(first + jnp.arange(count))


def cost(run: Run, plans: Sequence[CalibrationPlan]) -> str:
    """The expected cost of the posteriors of all truths, in one line."""
    count = sum(plan.truths for plan in plans)
    if run.amortised:
        return f"cost: {count} simulations, and the run's network conditioned on each"
    settings = run.settings
    each = settings.simulation_budget + POSTERIOR_SAMPLES * settings.predictive
    simulations = count * (1 + settings.rounds * each)
    seconds = float(np.sum(run.history.get("seconds", np.nan)))
    took = f" One run took {seconds:.3g} s; side by side each takes less." if np.isfinite(seconds) else ""
    return f"cost: the run again for each of {count} truths, up to {simulations} simulations in all.{took}"


def posteriors(
    out: Path,
    run: Run,
    plan: CalibrationPlan,
    truths: Mapping[str, np.ndarray],
    length: int,
    fingerprint: str,
    console: Console,
) -> dict[str, np.ndarray]:
    """The posteriors of all truths, in chunks of the given length; existing chunks are read.

    The last chunk is padded with its last truth, so that all use one compiled program. The fingerprint is a hash of
    everything that the results depend on.

    Raises:
        StoreError: for a damaged chunk, before anything is computed.
        SimulatorError: for a simulator that always fails.
    """
    store = ChunkStore(out / "chunks", plan.truths, length, fingerprint, RESULTS)

    def filled(compute: Chunk):
        def one(items: range):
            rows = np.minimum(items.start + np.arange(length), items.stop - 1)
            return compute({name: truths[name][rows] for name in ("theta", "observed", "x")}, items.start)

        return one

    if run.amortised:
        label = f"{run.task.name}, {plan.where}: conditioning the run's network on {plan.truths} simulations"
        console.print(label, markup=False, soft_wrap=True)
        store.compute(filled(amortised_chunks(run, plan)))
    else:
        chunks = len(store.chunks)
        label = f"{plan.where}: the run again for {plan.truths} simulations, in {chunks} chunks of {length}"
        rounds = run.settings.rounds
        with RoundProgress(console, rounds * chunks, rounds * len(store.done()), label) as progress:
            store.compute(filled(repeated_chunks(run, plan, progress)))
    return store.results()[0]


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Arrays that an earlier command wrote.

    Raises:
        StoreError: if they are damaged; the file is left as it is.
    """
    try:
        return atomic.read_arrays(path)
    except ValueError as error:
        raise StoreError(f"{error}: delete it, and the same command computes it again") from error
