"""Speed of simulations in worker processes: `python -m experiments.benchmarks.executors`.

A simulator that sleeps for 50 ms stands for one that is slow and that JAX cannot trace. The same simulations are made
in this process one after another, and by workers on this machine (`--workers N` of the command line), whose start is
timed separately. Then a simulator that crashes its process in 5 % of its runs has to complete a full round.
"""

import argparse
import dataclasses
import os
import signal
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxlfi
from jaxlfi.envs.gaussian_linear import task as gaussian
from jaxlfi.tasks.executors import one_by_one, workers
from jaxlfi.tasks.simulation import simulate_in_waves
from jaxlfi.tasks.task import Task

CRASHES = 0.05
KEY = jax.random.key(0)


def sleeping(rng, theta, seconds=0.05):
    """One simulation that takes some time."""
    time.sleep(seconds)
    return theta + rng.normal(size=len(theta))


def crashing(rng, theta):
    """One simulation that crashes its process now and then."""
    if rng.uniform() < CRASHES:
        os.kill(os.getpid(), signal.SIGSEGV)
    return theta + rng.normal(size=len(theta))


def task_of(simulate) -> Task:
    """The Gaussian task with another simulator."""
    return dataclasses.replace(gaussian(), simulate=jaxlfi.HostSimulator(simulate, each=True))


def timed(task: Task, wanted: int, budget: int | None = None):
    """A round's simulations, and the seconds they took."""
    theta = jnp.zeros((budget or wanted, 2))
    began = time.perf_counter()
    found = jax.block_until_ready(simulate_in_waves(KEY, task, theta, wanted, (2,)))
    return found, time.perf_counter() - began


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--simulations", type=int, default=400, help="that sleep")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4, 8])
    arguments = parser.parse_args()
    sleepy = task_of(sleeping)
    for count in (1, arguments.simulations):  # compiles the summaries
        timed(task_of(lambda rng, theta: theta), count)
    alone, serial = timed(sleepy, arguments.simulations)
    print(f"jax {jax.__version__}, {os.cpu_count()} cores, {arguments.simulations} simulations that sleep 50 ms")
    print(f"{'':<14}{'start [s]':>10}{'seconds':>10}{'speed-up':>10}{'same bits':>11}")
    print(f"{'this process':<14}{'':>10}{serial:>10.2f}{1.0:>10.2f}")
    for count in arguments.workers:
        with workers(count) as executor:
            task = one_by_one(sleepy, executor)
            _, start = timed(task, 2 * count)
            found, seconds = timed(task, arguments.simulations)
        same = np.array_equal(found.x, alone.x)
        print(f"{count:>2} {'workers':<11}{start:>10.2f}{seconds:>10.2f}{serial / seconds:>10.2f}{same!s:>11}")
    with workers(max(arguments.workers)) as executor:
        found, seconds = timed(one_by_one(task_of(crashing), executor), 1000, 1250)
    crashes = int(found.failed(len(task.reasons))[task.reasons.index("crash")])
    attempted, succeeded = int(found.attempted), int(found.succeeded)
    print(f"1000 wanted of a simulator that crashes in {CRASHES:.0%} of its runs, {max(arguments.workers)} workers:")
    print(f"{succeeded} of {attempted}, {crashes} crashes, {attempted - succeeded - crashes} lost, {seconds:.1f} s")


if __name__ == "__main__":
    main()
