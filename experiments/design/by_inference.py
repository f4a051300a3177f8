"""Do the chosen experiments also narrow the posteriors that `jaxlfi.infer` finds, by its defaults?

    python -m experiments.design.by_inference --results experiments/results/design --truths 4

Of the first truths of the Furuta pendulum, the first recording with the three chosen experiments, and with the three at
random, are made again and inferred, with least squares at the end (`polish`) and without. What is written is how wide
the 90 % intervals are, [truths, arms, D], whether they hold the truth, simulations and processor seconds. Truths that
are there are not inferred again.
"""

import argparse
import time
from pathlib import Path

from jaxlfi.io import compile_cache, host_devices

if __name__ == "__main__":  # before jax starts
    host_devices.divide()
    compile_cache.enable()

import jax
import numpy as np
from rich.console import Console

import jaxlfi
from experiments.design import machines
from experiments.design.comparison import recorded_at
from jaxlfi.io import files
from jaxlfi.io.provenance import environment
from jaxlfi.runs.polishing import polished

ARMS = ("chosen", "at random")
SEED = 8100
"""Of the recordings' noise and of inference."""
DRAWS = 4096
"""Of each posterior."""


def intervals(run: jaxlfi.Run, key: jax.Array, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Widths of a posterior's 90 % intervals in inference space, and whether they hold the truth, [D] each."""
    low, high = np.quantile(np.asarray(run.posterior.sample(key, DRAWS, "inference")), [0.05, 0.95], axis=0)
    inner = np.asarray(run.task.space.to_inference(truth))
    return high - low, (low < inner) & (inner < high)


def main() -> None:
    """Infer, and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, required=True, metavar="DIR")
    parser.add_argument("--truths", type=int, default=4, metavar="N")
    arguments = parser.parse_args()
    task, kept = machines.furuta(), np.load(arguments.results / "furuta.npz")
    nominal, names = np.array([task.design.nominal]), [str(name) for name in kept["arms"]]
    path = arguments.results / "furuta_inferred.npz"
    there = files.read_arrays(path) if path.exists() else {}
    found = {name: list(values) for name, values in there.items() if name != "arms"}
    for number in range(len(found.get("seconds", ())), arguments.truths):
        truth, rows = kept["truth"][number], []
        for place, name in enumerate(ARMS):
            designs = np.concatenate([nominal, kept["design"][number, names.index(name)]])
            keys = jax.random.split(jax.random.fold_in(jax.random.key(SEED + number), place), 3)
            recorded = machines.furuta_recorded(designs, recorded_at(keys[0], task, truth, designs))
            began = time.process_time()
            run = jaxlfi.infer(keys[1], recorded)
            seconds = time.process_time() - began
            better = polished(run, Console(quiet=True))
            (width, held), (finer, finer_held) = (intervals(one, keys[2], truth) for one in (run, better))
            rows.append(
                {
                    "width": width,
                    "held": held,
                    "polished_width": finer,
                    "polished_held": finer_held,
                    "simulations": run.simulations_used,
                    "seconds": seconds,
                }
            )
        for name in rows[0]:
            found.setdefault(name, []).append([row[name] for row in rows])
        arrays = {name: np.array(values) for name, values in found.items()}
        files.write_arrays(path, arrays | {"arms": np.array(ARMS)})
        files.write_json(path.with_suffix(".json"), {"truths": number + 1, "seed": SEED} | environment())
        ratio = np.prod(arrays["width"][:, 0] / arrays["width"][:, 1], axis=1)
        print(f"truth {number + 1}: product of widths against random {ratio[-1]:.3f}", flush=True)


if __name__ == "__main__":
    main()
