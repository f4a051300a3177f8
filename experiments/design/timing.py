"""CPU time of choosing an experiment: the first time, with compilation, and once more.

    python -m experiments.design.timing --out experiments/results/design/timing.json

For the example's Furuta pendulum (3 s in steps of 2 ms, no part compiled), a few designs are rated, and the time for
the default number is extrapolated from theirs.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from experiments.design import arms, machines
from experiments.design.comparison import chosen_for
from jaxlfi.design import choosing
from jaxlfi.design.fisher import FisherRater
from jaxlfi.design.recommendation import default
from jaxlfi.design.regions import region
from jaxlfi.envs.lotka_volterra import designed
from jaxlfi.io import files, provenance
from jaxlfi.tasks.task import Task

NARROW = 0.02
"""The posterior's standard deviation, in widths of the box."""
DESIGNS = 8
"""Number of designs that are rated for a simulator outside JAX."""


def seconds(function: Callable[[], object]) -> float:
    """CPU time that a call takes, over all cores."""
    begun = time.process_time()
    function()
    return time.process_time() - begun


def posterior(task: Task) -> np.ndarray:
    """Draws about the truth, [N, D]."""
    box, rng = task.support(None), np.random.default_rng(0)
    width = np.asarray(box.high, float) - np.asarray(box.low, float)
    return np.asarray(task.space.to_inference(task.truth)) + NARROW * width * rng.standard_normal((4096, task.dim))


def in_jax(task: Task) -> dict[str, float]:
    """CPU times of a choice among the default number of designs."""
    draws = posterior(task)
    own = lambda: chosen_for(jax.random.key(0), task, draws)
    return {"first": seconds(own), "again": seconds(own), "rated": default(task, choosing.RATED)}


def on_host(task: Task) -> dict[str, float]:
    """CPU times of a few designs, and of the default number."""
    box = task.support(None)
    low, high = np.asarray(box.low, float), np.asarray(box.high, float)
    draws = np.clip(posterior(task), low, high)
    wide = np.random.default_rng(1).uniform(low, high, draws.shape)
    places = region(0.8, draws), region(0.2, wide)
    starts = choosing.spread(task, DESIGNS + 1, np.random.default_rng(2))
    rater = FisherRater(jax.random.key(0), task, places)
    first = seconds(lambda: choosing.rate(rater, starts[:1], tolerance=0.999))
    each = seconds(lambda: choosing.rate(rater, starts[1:], tolerance=0.999)) / DESIGNS
    rated = default(task, choosing.RATED)
    return {"first": first + each * (rated - 1), "again": each * rated, "rated": rated, "each": each}


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    out = parser.parse_args().out
    found = {
        "load": in_jax(arms.arm(True)),
        "times": in_jax(designed.times()),
        "furuta": on_host(machines.furuta(step=0.002, duration=3.0)),
    }
    for name, row in found.items():
        print(name, {what: round(value, 2) for what, value in row.items()})
    files.write_json(out, found | {"environment": provenance.environment()})


if __name__ == "__main__":
    main()
