"""Growth of time and memory with the size of a problem: `python -m experiments.benchmarks.growth`.

One size is varied at a time: the number of rounds, of simulations in total, of parameters D, of summaries S, or of
runs side by side. The simulator is linear with noise and takes no time. Each point is a separate process. Its CPU
seconds are measured, as other programs may share the machine, separately for compilation and for all rounds, and so is
the largest size in bytes of a compiled program with its arguments. `quick` trains for 100 passes through the
simulations; here it trains for `PASSES`, so that the work before and after training weighs more.

Existing points are not measured again. The exponent of a size is the slope of a least-squares fit of the logarithm of
the time, or of the memory, to that of the size, over the larger half of the sizes.

    --sweeps NAME ...    vary only these sizes
    --new                measure all points again
"""

import argparse
import json
import math
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

SAVED = Path(__file__).parents[1] / "results/growth/points.json"
PASSES = 10
SWEEPS: dict[str, tuple[int, ...]] = {
    "rounds": (10, 25, 50, 100),
    "simulations": (1_000, 10_000, 30_000, 100_000),
    "parameters": (2, 8, 16, 32, 64),
    "summaries": (10, 100, 1_000, 10_000),
    "runs": (1, 16, 64, 256),
}
"""Sizes that are varied, and their values."""
BASE = {"rounds": 3, "simulations": 300, "parameters": 2, "summaries": 10, "runs": 1}
"""Values of the other sizes; if rounds are varied, there are `EACH` simulations per round."""
EACH = 100


def measured(sweep: str, size: int) -> dict[str, float]:
    """CPU seconds and bytes of one point, measured in this process."""
    import jax
    import jax.numpy as jnp

    from jaxlfi.bayessim.batch import RunSpec, stack_inputs
    from jaxlfi.bayessim.host import engine_for
    from jaxlfi.bayessim.presets import QUICK
    from jaxlfi.bayessim.rounds import run_rounds
    from jaxlfi.distributions.support import Support
    from jaxlfi.heuristics import Edge
    from jaxlfi.studies.grid.chunks import program_bytes
    from jaxlfi.tasks.task import Task

    point = BASE | {sweep: size} | ({"simulations": size * EACH} if sweep == "rounds" else {})
    dim, obs, each = point["parameters"], point["summaries"], -(-point["simulations"] // point["rounds"])
    mixing = jnp.asarray(np.random.default_rng(0).normal(size=(obs, dim)) / math.sqrt(dim), jnp.float32)
    box = Support([-2.0] * dim, [2.0] * dim)
    task = Task(
        lambda key, theta: mixing @ theta + 0.1 * jax.random.normal(key, (obs,)),
        names=tuple(f"parameter {d}" for d in range(dim)),
        supports={"box": box},
        feasible=box,
    )
    settings = QUICK.replace(
        rounds=point["rounds"],
        min_rounds=0,
        simulations_per_round=each,
        simulation_budget=each,
        estimator=QUICK.estimator.replace(epochs=PASSES),
    )
    specs = [RunSpec("box", "box", box, Edge(), seed) for seed in range(point["runs"])]
    observed = np.repeat(np.asarray(mixing @ jnp.full(dim, 0.3))[None], point["runs"], axis=0)
    engine = engine_for(task, settings, stack_inputs(specs, observed, observed)[0])
    begun = time.process_time()
    size_of = program_bytes(engine)  # compiles
    compiled = time.process_time()
    run_rounds(engine, engine.start(), range(point["rounds"]), lambda *_: None)
    return {"compile": compiled - begun, "seconds": time.process_time() - compiled, "bytes": size_of}


def exponent(sizes: Mapping[int, float]) -> float:
    """The slope of log-values on log-sizes over the larger half of the sizes, by least squares.

    Example:
        >>> round(exponent({1: 5.0, 2: 5.0, 10: 3.0, 100: 300.0}), 2)
        2.0
    """
    larger = sorted(sizes)[len(sizes) // 2 :] if len(sizes) > 2 else sorted(sizes)
    return float(np.polyfit(np.log(larger), np.log([sizes[size] for size in larger]), 1)[0])


def table(points: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """The table of the page."""
    lines = ["| varied | sizes | seconds | exponent | MB | exponent |", "|---|---|---|---|---|---|"]
    for sweep in SWEEPS:
        if len(found := {int(size): point for size, point in points.get(sweep, {}).items()}) < 2:
            continue
        of = lambda name, found=found: {size: found[size][name] for size in sorted(found)}
        seconds, memory = of("seconds"), of("bytes")
        cells = [
            ", ".join(f"{size:,}" for size in seconds),
            ", ".join(f"{value:.3g}" for value in seconds.values()),
            f"{exponent(seconds):.2f}",
            ", ".join(f"{value / 1e6:,.3g}" for value in memory.values()),
            f"{exponent(memory):.2f}",
        ]
        lines.append(f"| {sweep} | {' | '.join(cells)} |")
    return "\n".join(lines)


def draw(points: Mapping[str, Mapping[str, Mapping[str, float]]], path: Path) -> None:
    """Draw time over size, one panel per varied size."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.6 * len(points), 2.6), layout="constrained")
    for axes, (sweep, found) in zip(figure.subplots(1, len(points), squeeze=False)[0], points.items(), strict=True):
        sizes = sorted(map(int, found))
        axes.loglog(sizes, [found[str(size)]["seconds"] for size in sizes], "o-")
        axes.set(xlabel=sweep, ylabel="seconds of all rounds")
        axes.grid(True)
    figure.savefig(path, dpi=100)


def main() -> None:
    """Measure the missing points, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sweeps", nargs="+", default=list(SWEEPS), choices=SWEEPS, help="numbers that are varied")
    parser.add_argument("--new", action="store_true", help="measure anew")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(measured(arguments.one[0], int(arguments.one[1]))))
        return
    points: dict[str, dict[str, Any]] = json.loads(SAVED.read_text()) if SAVED.exists() and not arguments.new else {}
    SAVED.parent.mkdir(parents=True, exist_ok=True)
    for sweep in arguments.sweeps:
        for size in SWEEPS[sweep]:
            if str(size) in points.setdefault(sweep, {}):
                continue
            words = [sys.executable, "-m", "experiments.benchmarks.growth", "--one", sweep, str(size)]
            done = subprocess.run(words, capture_output=True, text=True, check=True)
            points[sweep][str(size)] = json.loads(done.stdout.splitlines()[-1])
            SAVED.write_text(json.dumps(points, indent=1) + "\n")
            print(sweep, size, points[sweep][str(size)], flush=True)
    draw(points, SAVED.with_name("growth.png"))
    print(table(points))


if __name__ == "__main__":
    main()
