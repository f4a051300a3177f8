"""Coverage of the intervals of the chosen experiments, which are made again at the same truths.

    python -m experiments.design.coverage --results experiments/results/design

Intervals are those of the least-squares fit that starts from the truth, and of its derivatives; the pendulum's
posteriors lie about such fits. The output is whether they hold the truth, [truths, arms, repeats, D].
"""

import argparse
from pathlib import Path

import jax
import numpy as np

from experiments.design import laplace
from experiments.design.comparison import recorded_at
from experiments.design.problems import PROBLEMS
from experiments.design.queue import NORMAL
from jaxlfi.io import files

PROBLEM = "furuta"
"""Name of the problem: its posteriors lie about a least-squares fit, those of the others do not."""
REPEATS = 2
"""Number of repetitions of each truth's experiments."""
SEED = 7600
"""First seed of their noise."""


def main() -> None:
    """Record, fit, and count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, required=True, metavar="DIR")
    arguments = parser.parse_args()
    task, kept = PROBLEMS[PROBLEM].task(), np.load(arguments.results / f"{PROBLEM}.npz")
    nominal, found = np.array([task.design.nominal]), []
    for number, truth in enumerate(kept["truth"]):
        inner = np.asarray(task.space.to_inference(truth), float)
        arms = []
        for arm, designs in enumerate(kept["design"][number]):
            every = np.concatenate([nominal, designs])
            deviation = kept["width"][number, 1 + arm] / (2 * NORMAL)
            held = []
            for repeat in range(REPEATS):
                key = jax.random.fold_in(jax.random.key(SEED + number), len(kept["arms"]) * repeat + arm)
                recorded = recorded_at(key, task, truth, every)
                _, mean, covariance = laplace.fitted(task, recorded, every, inner, deviation)
                held.append(np.abs(mean - inner) < NORMAL * np.sqrt(np.diagonal(covariance)))
            arms.append(held)
        found.append(arms)
        files.write_arrays(
            arguments.results / f"{PROBLEM}_coverage.npz", {"held": np.array(found), "arms": kept["arms"]}
        )
        print(f"{task.name}: truth {number + 1}: {np.mean(found, axis=(0, 2, 3)).round(3).tolist()}", flush=True)


if __name__ == "__main__":
    main()
