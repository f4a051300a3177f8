"""Speed of the Lotka-Volterra jump process: `python -m experiments.benchmarks.lotka_volterra`.

Prints simulations per second at the true rates and under the OK prior U[-5, 2]^4 of log-rates, for

* ours on two shards (two host devices, `jax.shard_map`) and on one;
* the textbook algorithm in JAX: one `while_loop` per simulation, threefry, `vmap`;
* the textbook algorithm in numba, compiled, on all cores (needs the `bench` extra);
* the textbook algorithm in NumPy, the test oracle.

Compilation is timed separately; each timed call ends with `block_until_ready`. Best and median of
several calls are shown, since other programs may share the machine, with the CPU time spent per
second in the best call ("cores") and the simulations per CPU second.
"""

import dataclasses
import os
import statistics
import time
from collections.abc import Callable

DEVICES = 2
if "XLA_FLAGS" not in os.environ:  # read once, when jax starts
    os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={DEVICES}"

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from jaxlfi.envs.lotka_volterra import jump_process as lv  # noqa: E402

TRUTH = np.log([0.01, 0.5, 1.0, 0.01]).astype(np.float32)
PRIOR_BOUNDS = (-5.0, 2.0)
PROCESS = lv.JumpProcess()

Run = Callable[[], object]


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the measurement.

    Attributes:
        simulations: batch size of the fast simulators (ours, numba).
        textbook_simulations: batch size of the plain vmapped while loop.
        numpy_simulations: total number of simulations by NumPy.
        repeats: number of timed calls of each; the slow ones (NumPy) are called once.
        slots: slots per shard, see `Schedule`.
        phase: events per phase, see `Schedule`.
    """

    simulations: int = 8192
    textbook_simulations: int = 256
    numpy_simulations: int = 30
    repeats: int = 5
    slots: int = lv.Schedule.slots
    phase: int = lv.Schedule.phase


@dataclasses.dataclass(frozen=True)
class Timing:
    """Seconds of the first call, which compiles; best and median of the others; cores in use."""

    first: float
    best: float
    median: float
    cores: float


def measure(run: Run, repeats: int) -> Timing:
    """Times `run` after a first call that compiles."""
    first = _timed(run)[0]
    calls = [_timed(run) for _ in range(repeats)]
    best = min(calls)
    return Timing(first, best[0], statistics.median(wall for wall, _ in calls), best[1] / best[0])


def _timed(run: Run) -> tuple[float, float]:
    """Wall and CPU seconds of one call."""
    wall, processor = time.perf_counter(), time.process_time()
    jax.block_until_ready(run())
    return time.perf_counter() - wall, time.process_time() - processor


def log_rates_of(setting: str, count: int) -> jax.Array:
    """Log-rates [count, 4] at the truth or drawn from the prior."""
    if setting == "truth":
        return jnp.broadcast_to(TRUTH, (count, 4))
    low, high = PRIOR_BOUNDS
    return jax.random.uniform(jax.random.key(1), (count, 4), minval=low, maxval=high)


def ours(config: Config, setting: str, shards: int) -> tuple[Run, float]:
    """Our simulator on `shards` devices, and the fraction of slot-steps that are idle."""
    schedule = lv.Schedule(slots=config.slots, phase=config.phase)
    keys = jax.random.split(jax.random.key(0), config.simulations)
    log_rates = log_rates_of(setting, config.simulations)

    def sharded(function, outputs):
        devices = jax.devices()[:shards]
        automatic = (jax.sharding.AxisType.Auto,)
        mesh = jax.make_mesh((shards,), ("shard",), devices=devices, axis_types=automatic)
        split = jax.sharding.PartitionSpec("shard")
        place = jax.sharding.NamedSharding(mesh, split)
        arguments = jax.device_put((keys, log_rates), place)
        compiled = jax.jit(jax.shard_map(function, mesh=mesh, in_specs=split, out_specs=outputs(split)))
        return lambda: compiled(*arguments)

    def work(keys, log_rates):
        result = lv.make_batch_simulator(PROCESS, schedule)(keys, log_rates)
        return result.steps, result.phases[None]

    steps, phases = sharded(work, lambda split: (split, split))()
    executed = float(phases.sum()) * schedule.slots * schedule.phase
    idle = 1 - float(steps.sum(dtype=jnp.float32)) / executed
    simulate = jax.vmap(lv.make_simulator(PROCESS, schedule))
    return sharded(simulate, lambda split: split), idle


def textbook_jax(config: Config, setting: str) -> Run:
    """The straightforward Gillespie algorithm: a loop over events for one simulation, and vmap."""
    rates = jnp.exp(log_rates_of(setting, config.textbook_simulations))
    keys = jax.random.split(jax.random.key(0), config.textbook_simulations)
    change = jnp.array([[1, 0], [-1, 0], [0, 1], [0, -1]], jnp.float32)
    grid = PROCESS.interval * jnp.arange(PROCESS.intervals + 1)

    def simulate(key, rates):
        def unfinished(carry):
            _, _, row, events, _, _ = carry
            return (row < len(grid)) & (events < PROCESS.max_events)

        def event(carry):
            key, state, row, events, time, records = carry
            key, wait_key, reaction_key = jax.random.split(key, 3)
            x, y = state
            propensities = rates * jnp.array([x * y, x, y, x * y])
            total = propensities.sum()
            time += jax.random.exponential(wait_key) / total
            level = jax.random.uniform(reaction_key) * total
            reaction = jnp.searchsorted(jnp.cumsum(propensities)[:-1], level, side="right")
            state = jnp.where(total > 0, state + change[reaction], state)
            next_row = jnp.searchsorted(grid, time, side="right")
            passed = (jnp.arange(len(grid)) >= row) & (jnp.arange(len(grid)) < next_row)
            records = jnp.where(passed[:, None], state, records)
            return key, state, next_row, events + 1, time, records

        initial = jnp.array([PROCESS.predators, PROCESS.prey], jnp.float32)
        records = jnp.zeros((len(grid), 2)).at[0].set(initial)
        start = (key, initial, jnp.int32(1), 0, 0.0, records)
        _, _, row, _, _, records = jax.lax.while_loop(unfinished, event, start)
        return records, row < len(grid)

    compiled = jax.jit(jax.vmap(simulate))
    return lambda: compiled(keys, rates)


def textbook_numba(config: Config, setting: str) -> Run:
    """The same loop compiled by numba, simulations spread over all cores."""
    try:
        import numba
    except ImportError as error:
        raise ImportError("numba is missing: install the extra `bench` to compare with it") from error

    rates = np.exp(np.asarray(log_rates_of(setting, config.simulations), np.float64))
    initial = (float(PROCESS.predators), float(PROCESS.prey))
    intervals, interval, max_events = PROCESS.intervals, PROCESS.interval, PROCESS.max_events

    @numba.njit(parallel=True, fastmath=True)
    def simulate(rates):
        records = np.zeros((len(rates), intervals + 1, 2), np.float32)
        failure = np.zeros(len(rates), np.int32)
        for i in numba.prange(len(rates)):
            r1, r2, r3, r4 = rates[i]
            x, y = initial
            time, row, events = 0.0, 1, 0
            records[i, 0, 0], records[i, 0, 1] = x, y
            while row <= intervals:
                first = r1 * x * y
                second = first + r2 * x
                third = second + r3 * y
                total = third + r4 * x * y
                if total == 0.0:
                    records[i, row:, 0], records[i, row:, 1] = x, y
                    break
                if events == max_events:
                    failure[i] = 1
                    break
                time -= np.log(1.0 - np.random.random()) / total  # noqa: NPY002 - numba's own generator
                level = np.random.random() * total  # noqa: NPY002
                if level < first:
                    x += 1.0
                elif level < second:
                    x -= 1.0
                elif level < third:
                    y += 1.0
                else:
                    y -= 1.0
                events += 1
                while row <= intervals and time >= row * interval:
                    records[i, row, 0], records[i, row, 1] = x, y
                    row += 1
        return records, failure

    return lambda: simulate(rates)


def textbook_numpy(config: Config, setting: str) -> Run:
    """The test oracle, one simulation at a time."""
    from tests.oracles import gillespie

    log_rates = np.asarray(log_rates_of(setting, config.numpy_simulations))
    rng = np.random.default_rng(0)
    return lambda: [gillespie.simulate(rng, row) for row in log_rates]


def report(name: str, setting: str, count: int, timing: Timing, idle: float | None = None) -> None:
    """Prints one line of the table."""
    lost = "" if idle is None else f"{100 * idle:.1f} %"
    print(
        f"{name:<22}{setting:<8}{count:>7}{count / timing.best:>11,.0f}"
        f"{count / timing.median:>11,.0f}{timing.cores:>7.2f}"
        f"{count / timing.best / timing.cores:>11,.0f}{timing.first:>9.2f}{lost:>8}",
        flush=True,
    )


def main(config: Config) -> None:
    """Measures all and prints the table."""
    devices = f"{jax.device_count()} {jax.default_backend()} devices"
    print(f"jax {jax.__version__}, {devices}, {os.cpu_count()} cores")
    print(f"{config.slots} slots, phases of {config.phase} events")
    heads = ("simulator", "rates", "batch", "best 1/s", "median 1/s", "cores", "per core s")
    print("{:<22}{:<8}{:>7}{:>11}{:>11}{:>7}{:>11}{:>9}{:>8}".format(*heads, "first s", "idle"))
    for setting in ("truth", "prior"):
        for shards in sorted({jax.device_count(), 1}, reverse=True):
            run, idle = ours(config, setting, shards)
            timing = measure(run, config.repeats)
            report(f"ours, shards: {shards}", setting, config.simulations, timing, idle)
        try:
            timing = measure(textbook_numba(config, setting), config.repeats)
            report("numba, all cores", setting, config.simulations, timing)
        except ImportError as error:
            print(error)
        timing = measure(textbook_jax(config, setting), min(config.repeats, 3))
        report("JAX while_loop, vmap", setting, config.textbook_simulations, timing)
        seconds, processor = _timed(textbook_numpy(config, setting))
        timing = Timing(0.0, seconds, seconds, processor / seconds)
        report("NumPy", setting, config.numpy_simulations, timing)


if __name__ == "__main__":
    main(Config())
