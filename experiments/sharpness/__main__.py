"""How sharp and calibrated posteriors are: the default call on problems as users bring them, against exact ones.

    python -m experiments.sharpness --problems tuning --methods bayessim npe --seeds 8 --truths 40
    python -m experiments.sharpness --problems held-out
    python -m experiments.sharpness --quick

Each problem has a right box, one that is wrong by one bound and one that is wrong by all. Wrong boxes are run with EDGE
only, against the exact posterior on the box that the run ended with. `--seeds` observations are of the problem's own
truth, and `--truths` of truths drawn near it, from the right box, from which coverage is computed. Existing results are
not run again; the table is made from the arrays. Problems that are `held-out` (`experiments.sharpness.held_out`) must
not be looked at while settings are chosen, so that the default is `tuning`, all others.
"""

import argparse
import json
from pathlib import Path

from jaxlfi.io import compile_cache, host_devices

if __name__ == "__main__":  # before jax starts
    host_devices.divide()
    compile_cache.enable()

from experiments.sharpness import runner
from experiments.sharpness.catalogue import LATER, chosen
from experiments.sharpness.references import referenced_case
from experiments.sharpness.tables import table

QUICK = ("right/fixed", "one/edge")
"""Boxes and heuristics of `--quick`: with its seeds, one batch of each problem."""
QUICK_PROBLEMS = (
    *("spring", "poisson_regression", "ar1", "circle"),
    *("thermocouple", "negative_binomial", "ornstein_uhlenbeck", "ridge"),
)
"""Problems of `--quick`, if requested; two minutes each on two cores, half of which is compiling."""
QUICK_SEEDS = 4
TRUTHS_KEPT = 12
"""Largest number of truths for problems whose references take long and are kept."""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    sets = f"tuning, held-out, all, {', '.join(LATER)}, mujoco, or names"
    parser.add_argument("--problems", nargs="+", default=["tuning"], help=sets)
    parser.add_argument("--boxes", nargs="+", choices=runner.BOXES, default=list(runner.BOXES))
    parser.add_argument("--heuristics", nargs="+", choices=list(runner.RULES), default=["fixed", "edge"])
    parser.add_argument("--simulations", nargs="+", type=int, default=[1000], help="in ten rounds, failures included")
    parser.add_argument("--methods", nargs="+", choices=runner.METHODS, default=["bayessim"])
    parser.add_argument("--seeds", type=int, default=8, help="observations of each problem's own truth")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--truths", type=int, default=40, help="truths drawn near it, each with an observation")
    parser.add_argument("--settings", type=json.loads, default={}, help="fields of run or estimator to replace, JSON")
    parser.add_argument("--out", type=Path, default=Path("runs/sharpness/results"))
    parser.add_argument("--quick", action="store_true", help="4 seeds, no truths, two boxes, quick problems")
    return parser


def main(argv: list[str] | None = None) -> None:
    """Run what is missing, and write the table."""
    words = parser()
    arguments = words.parse_args(argv)
    try:
        problems = chosen(arguments.problems)
    except ValueError as error:
        words.error(str(error))
    if min(arguments.simulations) < 100:
        words.error(f"--simulations: expected at least 100, ten a round, got {min(arguments.simulations)}")
    if arguments.quick:
        problems = [problem for problem in problems if problem.name in QUICK_PROBLEMS]
    seeds, truths = (QUICK_SEEDS, 0) if arguments.quick else (arguments.seeds, arguments.truths)
    for problem in problems:
        cases = [
            referenced_case(problem, kind, arguments.first_seed + number)
            for kind, count in (("own", seeds), ("near", min(truths, TRUTHS_KEPT) if problem.kept else truths))
            for number in range(count)
        ]
        jobs = runner.jobs_of(problem, arguments.boxes, arguments.heuristics, cases)
        if arguments.quick:
            jobs = [job for job in jobs if f"{job.box}/{job.heuristic}" in QUICK]
        for simulations in arguments.simulations:
            for method in arguments.methods:
                runner.run(problem, method, simulations, jobs, arguments.settings, arguments.out)
                print(table(arguments.out, [problem.name], [method]), flush=True)
    text = table(arguments.out, [problem.name for problem in problems])
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
