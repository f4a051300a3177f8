"""Is the chosen experiment the most informative, and is a ridge reported that no experiment breaks?

    python -m experiments.design --out experiments/results/design
    python -m experiments.design --out experiments/results/design --problems times starts --seed 7100
    python -m experiments.design --out experiments/results/design --tables    # only the tables

Truths of another seed are added to the existing ones.

For each truth, which is drawn at random, the nominal experiment is made first. Its posterior is exact: the likelihood
is known, and importance sampling or tempered particles find it, so the study measures the choice of designs and not a
network. From this posterior `jaxlfi.design` chooses the next experiments. They are made, as are the nominal one again
and experiments at random, and the posterior of all recordings is exact, too. For each of these, the widths of the 90 %
intervals are saved, whether they hold the truth, and the designs.

    arm     a motor turns an arm in a horizontal plane: mass, gear and damping form an exact ridge for any input
    load    the same, but a load of known mass may be fastened to the arm's end
    times   Lotka-Volterra: at which ten times both populations are counted
    starts  Lotka-Volterra: how many predators and prey are released
    furuta  a Furuta pendulum in MuJoCo: three chirps, compared with three of an expert's and three at random
    belt    a cart on an elastic belt in MuJoCo: the same
    queue   M/G/1: how many jobs are served before the queue is emptied, with a regression in place of posteriors
"""

import argparse
import json
from pathlib import Path

from jaxlfi.io import compile_cache

if __name__ == "__main__":  # before jax starts
    compile_cache.enable()

from experiments.design import queue, tables
from experiments.design.comparison import measured
from experiments.design.problems import PROBLEMS
from jaxlfi.io import files
from jaxlfi.io.provenance import environment

SEED = 20_430
"""Seed of all truths, recordings and searches."""
TRUTHS = 20


def main() -> None:
    """Measure, and write arrays and tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--truths", type=int, default=TRUTHS, metavar="N")
    parser.add_argument("--seed", type=int, default=SEED, metavar="N")
    parser.add_argument("--problems", nargs="+", default=[*PROBLEMS, "queue"], choices=[*PROBLEMS, "queue"])
    parser.add_argument("--tables", action="store_true", help="only make the tables anew")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in [] if arguments.tables else arguments.problems:
        path = arguments.out / "config.json"
        config = json.loads(path.read_text()) if path.exists() else {}
        config.setdefault(name, []).append({"truths": arguments.truths, "seed": arguments.seed} | environment())
        files.write_json(path, config)
        kept = arguments.out / f"{name}.npz"
        if name == "queue":
            queue.measured(arguments.truths, arguments.seed, kept)
        else:
            measured(PROBLEMS[name], arguments.truths, arguments.seed, kept)
    files.write_bytes(arguments.out / "table.md", tables.table(arguments.out).encode())


if __name__ == "__main__":
    main()
