"""Speed of tasks of MuJoCo models by engine: `python -m experiments.benchmarks.mujoco`.

Simulations per second of the examples under their recorded controls, with parameters drawn from Phi: by MuJoCo's
threaded rollouts on all cores, and by MJX in one compiled program. Every simulation has its own model, which MuJoCo
compiles in both cases; parameters are redrawn for each call, so no model is cached. Compilation of the program is timed
separately. The table shows the best of several calls, since other programs may share the machine, and the simulations
per second of CPU time that all threads of that call spent. Of the examples, MJX cannot simulate the puck.
"""

import argparse
import os
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from jaxlfi.envs.mujoco import task as mujoco_task
from jaxlfi.tasks.task import Task

FOLDER = Path(__file__).parents[2] / "examples/mujoco"
ENGINES = ("native", "mjx")


def drawn(task: Task, count: int, seed: int) -> np.ndarray:
    """Parameters from Phi, uniform in inference space; in natural units, shape [count, D]."""
    feasible = task.inference.feasible
    points = np.random.default_rng(seed).uniform(feasible.low, feasible.high, (count, task.dim))
    return np.asarray(task.space.to_natural(points), np.float32)


def simulations(task: Task, count: int) -> Callable[[int], tuple]:
    """A function from a seed, which draws parameters and noise, to `count` simulations."""
    if task.on_host:
        return lambda seed: task.simulate.function(np.random.default_rng(seed), drawn(task, count, seed))
    # Without the newer fusions of XLA, which take longer to compile on CPU and gain nothing here.
    options = {"xla_cpu_use_fusion_emitters": False} if jax.default_backend() == "cpu" else {}
    many = jax.jit(jax.vmap(task.simulate), compiler_options=options)
    return lambda seed: many(jax.random.split(jax.random.key(seed), count), drawn(task, count, seed))


def timed(call: Callable[[int], tuple], repeats: int) -> tuple[float, float, float, int]:
    """Seconds of the first call and of the fastest other one, CPU seconds of the latter, and failed simulations."""
    seconds, failed = [], 0
    for seed in range(1 + repeats):
        wall, processor = time.perf_counter(), time.process_time()
        _, outcome = jax.device_get(jax.block_until_ready(call(seed)))
        seconds.append((time.perf_counter() - wall, time.process_time() - processor))
        failed += int(np.count_nonzero(outcome))
    return seconds[0][0], *min(seconds[1:]), failed


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", nargs="+", default=["furuta", "arm", "finger"], help="of examples/mujoco")
    parser.add_argument("--simulations", type=int, nargs="+", default=[100], help="in a batch")
    parser.add_argument("--repeats", type=int, default=5, help="timed calls of each")
    arguments = parser.parse_args()
    print(f"jax {jax.__version__}, {jax.device_count()} {jax.default_backend()} devices, {os.cpu_count()} cores")
    print(f"{'':<10}{'engine':<8}{'batch':>6}{'first [s]':>11}{'simulations/s':>15}{'per core s':>12}{'failed':>8}")
    for name in arguments.examples:
        for engine in ENGINES:
            task = mujoco_task(FOLDER / f"{name}.toml", engine=engine)
            for count in arguments.simulations:
                first, wall, processor, failed = timed(simulations(task, count), arguments.repeats)
                speeds = f"{count / wall:>15.0f}{count / processor:>12.0f}"
                print(f"{name:<10}{engine:<8}{count:>6}{first:>11.1f}{speeds}{failed:>8}", flush=True)


if __name__ == "__main__":
    main()
