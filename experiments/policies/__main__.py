"""The study of policies, stage by stage; each keeps existing results, and can be interrupted and repeated.

python -m experiments.policies posteriors --out experiments/results/policies/study
python -m experiments.policies train --out experiments/results/policies/study --only dlo-0-edge uniform
"""

import argparse
import itertools
from pathlib import Path

from experiments.policies.study import HEURISTICS, OBJECTS, ORDER, Study, chosen

WHERE = ("simulation", "objects")


def posteriors(study: Study, arguments: argparse.Namespace) -> None:
    """Posteriors of each object by EDGE and on the fixed support, and a least-squares point."""
    from experiments.policies import making

    known = [f"{dlo}-{how}" for dlo, how in itertools.product(OBJECTS, (*HEURISTICS, "sysid"))]
    for name in chosen(arguments.only, known):
        making.believe(study, name)


def train(study: Study, arguments: argparse.Namespace) -> None:
    """Train policies on all domains, with the inference that they need."""
    from experiments.policies import making

    settings = [] if arguments.total_steps is None else ["--total-steps", str(arguments.total_steps)]
    names, n = chosen(arguments.only, ORDER), arguments.side_by_side
    for first in range(0, len(names), n):
        making.learn(study, names[first : first + n], arguments.seeds, settings)


def evaluate(study: Study, arguments: argparse.Namespace) -> None:
    """Evaluate all trained policies and baselines, in simulation and on the FEM objects."""
    from experiments.policies import actions, evaluation
    from jaxlfi.envs.whip.environment import make
    from jaxlfi.io import compile_cache

    compile_cache.enable()
    environment, trained = make(), study.policies()
    blind = [name for name in actions.NAMES if name not in actions.OWN or study.has(actions.OWN[name])]
    names = chosen(arguments.only, [*blind, *trained])
    for name in names:
        if name in actions.NAMES:
            actions.search(study, environment, name)
    if "simulation" in arguments.where:
        evaluation.in_simulation(study, names, arguments.episodes)
    if "objects" in arguments.where:
        evaluation.on_objects(study, names, arguments.displaced)
        evaluation.stills(study)


def collect(study: Study, arguments: argparse.Namespace) -> None:
    """Collect the results so far in a few files, from which reports are made."""
    from experiments.policies import collection

    collection.collect(study)


def report(study: Study, arguments: argparse.Namespace) -> None:
    """Make tables, figures and text from the collected results."""
    from experiments.policies import report

    report.write(study.out, arguments.readme)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    top = argparse.ArgumentParser(
        prog="python -m experiments.policies",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    stages = top.add_subparsers(required=True, metavar="STAGE")
    for stage in (posteriors, train, evaluate, collect, report):
        one = stages.add_parser(stage.__name__, help=stage.__doc__, description=stage.__doc__)
        one.set_defaults(stage=stage)
        one.add_argument("--out", type=Path, required=True, metavar="DIR", help="the folder of the study")
        if stage in (posteriors, train, evaluate):
            one.add_argument("--only", nargs="+", default=[], metavar="NAME", help="some of it, in this order")
        if stage is report:
            one.add_argument("--readme", type=Path, metavar="FILE", help="also write the text into it")
        if stage is train:
            one.add_argument("--seeds", type=int, default=4, metavar="N", help="of each domain (default: 4)")
            one.add_argument("--side-by-side", type=int, default=6, metavar="N", help="domains at a time (default: 6)")
            one.add_argument("--total-steps", type=int, metavar="N", help="of each training (default: the preset's)")
        if stage is evaluate:
            one.add_argument("--where", nargs="+", choices=WHERE, default=WHERE, help="(default: both)")
            one.add_argument("--episodes", type=int, default=64, metavar="N", help="on each domain (default: 64)")
            one.add_argument("--displaced", type=int, default=16, metavar="N", help="places of objects (default: 16)")
    return top


def main() -> None:
    """Run a stage."""
    arguments = parser().parse_args()
    try:
        arguments.stage(Study(arguments.out), arguments)
    except ValueError as error:
        raise SystemExit(f"python -m experiments.policies: error: {error}") from None


if __name__ == "__main__":
    main()
