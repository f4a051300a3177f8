"""Speed of a sensitivity grid: `python -m experiments.benchmarks.grid`.

Times whole runs of EDGE on Lotka-Volterra at `quick`, ten rounds each, in one process:

* side by side: the runs of a grid as one chunk of one compiled program over all devices (`jaxlfi.studies.grid`);
* one after another: the same runs through a compiled `jaxlfi.infer`, as in a loop over hyperparameters.

Both exclude compilation. The cost per run falls with the number of runs in a chunk, up to some 40 on two cores.
"""

import argparse
import os
import statistics
import time

if "XLA_FLAGS" not in os.environ:  # read once, when jax starts
    os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={os.cpu_count() or 1}"

import jax

from jaxlfi import QUICK, infer
from jaxlfi.bayessim.keys import key_of
from jaxlfi.envs.lotka_volterra import task as lotka_volterra
from jaxlfi.heuristics import Edge
from jaxlfi.studies.grid import Axis, Grid, grid_runs, prepare, run_chunk

AXES = (Axis("mass_threshold", (0.001, 0.005, 0.05)), Axis("expansion", (0.1, 0.2, 0.4)))


def main() -> None:
    """Measure both and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4, help="of each of the nine combinations")
    parser.add_argument("--single", type=int, default=5, help="runs timed one after another")
    arguments = parser.parse_args()
    task = lotka_volterra()
    grid = Grid(
        task,
        task.support("misspecified"),
        Edge(),
        AXES,
        seeds=tuple(range(arguments.seeds)),
        settings=QUICK,
        support_name="misspecified",
    )
    work = prepare(grid, runs_per_chunk=grid.size)
    begin = time.perf_counter()
    run_chunk(work, range(grid.size))
    side_by_side = (time.perf_counter() - begin) / grid.size

    seconds = []
    every = grid_runs(grid)
    specs = [every[i * len(every) // arguments.single] for i in range(arguments.single)]
    for spec in [specs[0], *specs]:  # the first call compiles
        begin = time.perf_counter()
        run = infer(key_of(spec.seed), task, support=spec.support_name, heuristic=spec.heuristic, settings=QUICK)
        jax.block_until_ready(run.belief)
        seconds.append(time.perf_counter() - begin)
    single = statistics.mean(seconds[1:])
    print(f"jax {jax.__version__}, {jax.device_count()} {jax.default_backend()} devices, {os.cpu_count()} cores")
    print(f"{'':<28}{'runs':>6}{'s a run':>10}")
    print(f"{'side by side, one chunk':<28}{grid.size:>6}{side_by_side:>10.2f}")
    print(f"{'one after another':<28}{len(specs):>6}{single:>10.2f}")
    print(f"a grid is {single / side_by_side:.2f} times faster than its runs one after another")


if __name__ == "__main__":
    main()
