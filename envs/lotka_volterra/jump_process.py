"""Exact simulation of the Lotka-Volterra Markov jump process, many simulations at a time.

The process and its nine summaries are those of Papamakarios and Murray (2016), "Fast epsilon-free
inference of simulation models with Bayesian conditional density estimation"; the algorithm is
Gillespie's direct method (1977).

    simulate = make_simulator()
    trajectory, failure = simulate(jax.random.key(0), jnp.log(jnp.array([0.01, 0.5, 1.0, 0.01])))
    x = lotka_volterra_nine(trajectory)

Why it is fast, in short (measured by `python -m experiments.benchmarks.lotka_volterra`):

* `simulate` is written for one simulation; under `jax.vmap`, nested or not, its batching rule puts all
  simulations into one queue. A fixed number of slots processes the queue in phases of a fixed number of
  events; at the end of a phase, slots whose simulation has finished take the next one from the queue.
  No simulation waits for the slowest.
* The jump chain does not depend on time. The only sequential loop is one small fused kernel per
  event, which draws the reaction and updates the state, packed into one 32-bit word. Waiting times
  are drawn afterwards for the whole phase, and the states at the grid times are found by bisection
  of the phase's event times.
* Random numbers are a hash of (seed of the simulation, event number), see `counter_rng`.

The result of a simulation depends on its own key and rates only, bit for bit, and not on its batch.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Key

from jaxlfi.distributions.precision import single
from jaxlfi.envs.lotka_volterra import counter_rng
from jaxlfi.tasks import summaries

SUCCESS = 0
TOO_MANY_EVENTS = 1

# Populations share a word of 32 bits, 16 each; a reaction adds its change to the packed word.
_POPULATION_LIMIT = 2**16 - 1
_PREDATOR = 2**16
_PREY = 1
# e^60 keeps total rates finite in float32, and is far beyond what 10,000 events allow.
_MAX_LOG_RATE = 60.0

Simulate = Callable[[Key[Array, ""], Float[Array, "4"]], tuple[Float[Array, "records 2"], Int[Array, ""]]]
"""One simulation: key and log-rates to trajectory and failure code."""


@dataclasses.dataclass(frozen=True)
class JumpProcess:
    """Settings of the process and its recording; the defaults are Papamakarios and Murray's.

    Attributes:
        predators: X at time 0.
        prey: Y at time 0.
        duration: simulated time, in the unit of 1 / rate.
        interval: time between records; records are taken at 0, interval, 2 interval, ... up to
            `duration`.
        max_events: largest number of events; a simulation that needs more fails, as does one with NaN rates.
        record: "after" records the state after the first event at or past each grid time, as the
            original does; "before" records the state at the grid time itself. The record at time 0
            is the initial state in both.
    """

    predators: int = 50
    prey: int = 100
    duration: float = 30.0
    interval: float = 0.2
    max_events: int = 10_000
    record: Literal["after", "before"] = "after"

    def __post_init__(self) -> None:
        if self.predators < 0 or self.prey < 0:
            raise ValueError(f"predators, prey: expected >= 0, got {self.predators}, {self.prey}")
        if not 0 < self.interval <= self.duration:
            raise ValueError(f"interval: expected in (0, {self.duration}], got {self.interval}")
        if self.max_events < 1:
            raise ValueError(f"max_events: expected >= 1, got {self.max_events}")
        reach = max(self.predators, self.prey) + self.max_events
        if reach > _POPULATION_LIMIT:
            raise ValueError(
                f"max_events: a population can reach its initial number + max_events, expected at "
                f"most {_POPULATION_LIMIT}, got {reach}"
            )
        if self.record not in ("after", "before"):
            raise ValueError(f"record: expected 'after' or 'before', got {self.record!r}")

    @property
    def intervals(self) -> int:
        """Number of recording intervals; there is one record more than that."""
        return int(self.duration / self.interval + 1e-6)


@dataclasses.dataclass(frozen=True)
class Schedule:
    """How the queue is processed: this affects speed, not results.

    Attributes:
        slots: simulations in progress at a time, per device. Smaller batches use the same number: loops
            of a fixed width round alike for every batch, and a phase of few slots takes hardly less time.
        phase: events between two checks of which slots have finished. Event times are summed within a
            phase, so that another length may round the last bit of a time differently.
        records: grid records extracted at a time at the end of a phase.
    """

    slots: int = 192
    phase: int = 128
    records: int = 512


class Simulations(NamedTuple):
    """The results of a queue of N simulations, and the work they took.

    Attributes:
        trajectory: predators and prey at the grid times, [N, records, 2] float32.
        failure: `SUCCESS` or `TOO_MANY_EVENTS`, [N] int32.
        steps: slot-steps that each simulation needed, [N] int32: its events and, if it froze, the
            endless wait after them.
        phases: phases executed, [] int32; each is `Schedule.slots * Schedule.phase` slot-steps.
    """

    trajectory: Float[Array, "batch records 2"]
    failure: Int[Array, " batch"]
    steps: Int[Array, " batch"]
    phases: Int[Array, ""]


class _Slots(NamedTuple):
    """The simulations in progress, one element per slot.

    Time is kept as the grid cell the slot is in and the time since that cell's start in units of
    the interval. The fraction stays below one between phases, so its rounding error (6e-8 of an
    interval) does not grow with time, unlike that of a float32 clock running to 30; grid times are
    exact whole numbers.
    """

    simulation: jax.Array  # index into the queue; the queue's length if the slot is idle
    seed: counter_rng.Seed
    rates: jax.Array  # [4, W], per interval
    state: jax.Array  # packed populations
    cell: jax.Array  # records after the initial one that are already taken
    fraction: jax.Array  # in [0, 1)
    events: jax.Array  # uint32


class _Queue(NamedTuple):
    """State of the outer loop."""

    slots: _Slots
    next_simulation: jax.Array
    records: jax.Array  # [N, records] packed
    failure: jax.Array
    steps: jax.Array
    phases: jax.Array


def _cumulative_rates(state: jax.Array, rates: jax.Array) -> tuple[jax.Array, ...]:
    """Cumulative rates of the four reactions in their order; the last is the total rate."""
    predators = (state >> 16).astype(jnp.int32).astype(jnp.float32)
    prey = (state & _POPULATION_LIMIT).astype(jnp.int32).astype(jnp.float32)
    pairs = predators * prey
    first = rates[0] * pairs
    second = first + rates[1] * predators
    third = second + rates[2] * prey
    return first, second, third, third + rates[3] * pairs


def _react(state: jax.Array, rates: jax.Array, word: jax.Array) -> jax.Array:
    """Draws one reaction and returns the state after it.

    A reaction of rate zero adds nothing to the cumulative rates, and level < total: it can never be
    drawn, so that no population goes below zero. A total rate of zero leaves the state as it is.
    """
    first, second, third, total = _cumulative_rates(state, rates)
    level = counter_rng.uniform(word) * total
    change = jnp.where(level < total, -_PREY, 0)
    change = jnp.where(level < third, _PREY, change)
    change = jnp.where(level < second, -_PREDATOR, change)
    change = jnp.where(level < first, _PREDATOR, change)
    return state + change.astype(jnp.uint32)


def _phase_events(slots: _Slots, phase: int, intervals: int) -> tuple[jax.Array, jax.Array]:
    """Runs `phase` events of every slot.

    Returns the states [phase + 1, W], from the one before the first event on, and the event times
    [phase, W] in intervals since the start of the slot's cell. Waiting times are cut at the whole
    duration, which stands for infinity where the total rate is zero.
    """
    numbers = jnp.arange(phase, dtype=jnp.uint32)

    def react(state, number):
        word = counter_rng.random_word(slots.seed, 2 * (slots.events + number) + 1)
        state = _react(state, slots.rates, word)
        return state, state

    # Not unrolled: XLA's fusion on CPU then recomputes a step for each of its consumers, and the
    # whole takes fifteen times as long.
    _, after = lax.scan(react, slots.state, numbers)
    states = jnp.concatenate([slots.state[None], after])

    words = counter_rng.random_word(slots.seed, 2 * (slots.events + numbers[:, None]))
    total = _cumulative_rates(states[:-1], slots.rates[:, None])[3]
    waits = jnp.minimum(counter_rng.exponential(words) / total, np.float32(intervals + 1))

    def advance(time, wait):
        time = time + wait
        return time, time

    _, times = lax.scan(advance, slots.fraction, waits)
    return states, times


def _count_earlier(times: jax.Array, slot: jax.Array, target: jax.Array) -> jax.Array:
    """Number of events of `slot` before `target`, by bisection of the sorted times [phase, W]."""
    phase = times.shape[0]
    # A loop: if it is unrolled, each step becomes a kernel that recomputes the steps before it.
    steps = jnp.asarray([2**power for power in reversed(range(phase.bit_length()))])

    def bisect(count, step):
        trial = count + step
        earlier = (trial <= phase) & (times[jnp.minimum(trial, phase) - 1, slot] < target)
        return jnp.where(earlier, trial, count), None

    return lax.scan(bisect, jnp.zeros_like(slot), steps)[0]


def _process_queue(
    process: JumpProcess, schedule: Schedule, seeds: counter_rng.Seed, log_rates: jax.Array
) -> Simulations:
    """Runs N queued simulations, seeds [N] and log_rates [N, 4]."""
    simulations = log_rates.shape[0]
    width, phase, intervals = schedule.slots, schedule.phase, process.intervals
    initial = np.uint32(process.predators * _PREDATOR + process.prey * _PREY)
    unusable = jnp.any(jnp.isnan(log_rates), axis=1)
    rates = jnp.exp(jnp.minimum(log_rates, _MAX_LOG_RATE)) * np.float32(process.interval)
    rates = jnp.where(unusable[:, None], 0.0, rates).T

    def refill(slots: _Slots, finished: jax.Array, next_simulation: jax.Array) -> _Slots:
        place = next_simulation + jnp.cumsum(finished) - 1
        simulation = jnp.where(finished, jnp.minimum(place, simulations), slots.simulation)
        source = jnp.minimum(simulation, simulations - 1)
        return _Slots(
            simulation=simulation,
            seed=jax.tree.map(lambda queue, slot: jnp.where(finished, queue[source], slot), seeds, slots.seed),
            rates=jnp.where(finished, rates[:, source], slots.rates),
            state=jnp.where(finished, initial, slots.state),
            cell=jnp.where(finished, 0, slots.cell),
            fraction=jnp.where(finished, 0.0, slots.fraction),
            events=jnp.where(finished, 0, slots.events),
        )

    def step(queue: _Queue) -> _Queue:
        slots = queue.slots
        busy = slots.simulation < simulations
        states, times = _phase_events(slots, phase, intervals)
        # The last event of the phase that max_events allows.
        last = jnp.minimum(process.max_events - 1 - slots.events.astype(jnp.int32), phase - 1)
        time = times[last, jnp.arange(width)]
        left = intervals - slots.cell
        state = states[last + 1, jnp.arange(width)]
        frozen = _cumulative_rates(state, slots.rates)[3] == 0
        arrived = (time >= left) | frozen
        exhausted = slots.events + phase >= process.max_events
        finished = busy & (arrived | exhausted)
        cells = jnp.floor(time)
        # A simulation that freezes or fails fills the rest of its trajectory with its last state.
        new_records = jnp.where(finished, left, cells.astype(jnp.int32))
        new_records = jnp.where(busy, new_records, 0)
        ends = jnp.cumsum(new_records)
        starts = ends - new_records

        def extract(carry):
            """Takes the next `schedule.records` of all slots' new records, laid end to end."""
            begin, records, steps = carry
            number = begin + jnp.arange(schedule.records)
            slot = jnp.searchsorted(ends, number, side="right", method="scan")
            slot = jnp.minimum(slot, width - 1)
            target = number - starts[slot] + 1
            before = _count_earlier(times, slot, target.astype(jnp.float32))
            after = jnp.minimum(before + 1, last[slot] + 1)
            event = after if process.record == "after" else jnp.minimum(before, after)
            row = jnp.where(number < ends[-1], slots.simulation[slot], simulations)
            column = slots.cell[slot] + target
            records = records.at[row, column].set(states[event, slot], mode="drop")
            final = jnp.where(column == intervals, row, simulations)
            total_steps = slots.events[slot].astype(jnp.int32) + after
            steps = steps.at[final].set(total_steps, mode="drop")
            return begin + schedule.records, records, steps

        _, records, steps = lax.while_loop(
            lambda carry: carry[0] < ends[-1],
            extract,
            (jnp.zeros_like(ends[0]), queue.records, queue.steps),
        )
        row = jnp.where(finished, slots.simulation, simulations)
        failure = jnp.where(arrived, SUCCESS, TOO_MANY_EVENTS)
        moved = slots._replace(
            state=states[-1],
            cell=slots.cell + cells.astype(jnp.int32),
            fraction=time - cells,
            events=slots.events + phase,
        )
        return _Queue(
            slots=refill(moved, finished, queue.next_simulation),
            next_simulation=queue.next_simulation + jnp.sum(finished),
            records=records,
            failure=queue.failure.at[row].set(failure, mode="drop"),
            steps=steps,
            phases=queue.phases + 1,
        )

    # Zeros made from the input vary over devices as it does: the loop can run in jax.shard_map.
    zero = jnp.zeros_like(seeds.low, dtype=jnp.int32)
    slot_zero = jnp.zeros(width, jnp.int32) + zero[0]
    none = _Slots(
        simulation=slot_zero,
        seed=jax.tree.map(lambda words: jnp.zeros(width, jnp.uint32) + 0 * words[0], seeds),
        rates=jnp.zeros((4, width)) + 0 * rates[0, 0],
        state=slot_zero.astype(jnp.uint32),
        cell=slot_zero,
        fraction=slot_zero.astype(jnp.float32),
        events=slot_zero.astype(jnp.uint32),
    )
    queue = _Queue(
        slots=refill(none, slot_zero == 0, zero[0]),
        next_simulation=zero[0] + width,
        records=jnp.full((simulations, intervals + 1), initial) + zero.astype(jnp.uint32)[:, None],
        failure=zero,
        steps=zero,
        phases=zero[0],
    )
    queue = lax.while_loop(lambda q: jnp.any(q.slots.simulation < simulations), step, queue)
    predators = (queue.records >> 16).astype(jnp.float32)
    prey = (queue.records & _POPULATION_LIMIT).astype(jnp.float32)
    return Simulations(
        trajectory=jnp.stack([predators, prey], axis=-1),
        failure=jnp.where(unusable, TOO_MANY_EVENTS, queue.failure),
        steps=queue.steps,
        phases=queue.phases,
    )


def make_batch_simulator(
    process: JumpProcess = JumpProcess(), schedule: Schedule = Schedule()
) -> Callable[[Key[Array, " batch"], Float[Array, "batch 4"]], Simulations]:
    """Returns the simulator of a batch, which also reports the work done.

    The function returned takes typed keys [N] and natural logarithms of the rates [N, 4], N >= 1.
    """

    def simulate_batch(keys: Key[Array, " batch"], log_rates: Float[Array, "batch 4"]) -> Simulations:
        return _process_queue(process, schedule, jax.vmap(counter_rng.seed_from_key)(keys), log_rates)

    return simulate_batch


def make_simulator(process: JumpProcess = JumpProcess(), schedule: Schedule = Schedule()) -> Simulate:
    """Returns the simulator of one trajectory, to be batched by `jax.vmap`.

    Algorithm: direct method of Gillespie (1977); reactions in the order of their rates are predator
    birth (rate r1 X Y), predator death (r2 X), prey birth (r3 Y) and prey death (r4 X Y). When the
    total rate is zero the state stays frozen, which is not a failure. A NaN among the rates is reported as a failure;
    log-rates above 60 count as 60.

    Args:
        process: settings of the process and its recording.
        schedule: how a batch is processed.

    Returns:
        A pure function of a typed key, which it consumes, and of log_rates [4], the natural
        logarithms of the rates (1 / time). It returns the trajectory [records, 2], float32 numbers
        of predators and prey, and an int32 failure code, `SUCCESS` or `TOO_MANY_EVENTS`. After a
        failure the trajectory is finite and otherwise unspecified.
    """
    # Calls outside a jit of the caller's would recompile the loops each time.
    process_queue = jax.jit(single(functools.partial(_process_queue, process, schedule)))

    @jax.custom_batching.custom_vmap
    def simulate_queue(seeds, log_rates):
        result = process_queue(seeds, log_rates)
        return result.trajectory, result.failure

    @simulate_queue.def_vmap
    def _flatten(axis_size, in_batched, seeds, log_rates):
        """Joins the batch axis with the queue's own, so that nested vmaps make one queue."""

        def join(batched, leaf):
            if not batched:
                leaf = jnp.broadcast_to(leaf, (axis_size, *leaf.shape))
            return leaf.reshape(-1, *leaf.shape[2:])

        joined = jax.tree.map(join, in_batched, [seeds, log_rates])
        outputs = simulate_queue(*joined)
        outputs = jax.tree.map(lambda out: out.reshape(axis_size, -1, *out.shape[1:]), outputs)
        return outputs, (True, True)

    def simulate(key: Key[Array, ""], log_rates: Float[Array, "4"]) -> tuple[Float[Array, "records 2"], Int[Array, ""]]:
        seed = jax.tree.map(lambda word: word[None], counter_rng.seed_from_key(key))
        log_rates = jnp.asarray(log_rates, jnp.float32)
        if log_rates.shape != (4,):
            raise ValueError(f"log_rates: expected shape (4,), got {log_rates.shape}")
        trajectory, failure = simulate_queue(seed, log_rates[None])
        return trajectory[0], failure[0]

    return simulate


SUMMARY_NAMES = (
    "mean X",
    "mean Y",
    "log var X",
    "log var Y",
    "X lag 1",
    "X lag 2",
    "Y lag 1",
    "Y lag 2",
    "X with Y",
)
"""Names of the nine summaries: means, variances, autocorrelations at a lag, and the correlation of X with Y."""


def lotka_volterra_nine(trajectory: Float[Array, "records 2"]) -> Float[Array, "9"]:
    """The nine summaries of Papamakarios and Murray (2016): `jaxlfi.tasks.summaries.series` of the two populations.

    In this order: mean X, mean Y, log(var X + 1), log(var Y + 1), autocorrelations of X at lags 1 and 2, of Y at
    lags 1 and 2, and the correlation of X with Y.

    Departure: correlations of a constant series are undefined, NaN in the original, and 0 here.

    Args:
        trajectory: predators and prey at every record, shape [T, 2], T >= 3.
    """
    return summaries.series(trajectory)
