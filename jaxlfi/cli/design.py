"""The command `jaxlfi design`: which experiment to make next, for a run whose task has a design.

This module imports neither jax nor numpy before it has to, so that `--help` answers at once.
"""

import argparse
import contextlib
from pathlib import Path

from jaxlfi import flags
from jaxlfi.cli.command import Command

EXAMPLES = """\
The task says what can be chosen: Task(simulate, ..., design={"amplitude": (0.1, 1.0, "N m")}), simulate(key, theta,
design). Bits are the information that an experiment is expected to bring, with the Monte Carlo error in brackets; +- is
half of each parameter's expected 90 % interval after it, ridge how many times narrower the direction becomes that the
posterior determines worst, and fails the share of simulations that fail or are unsafe.

examples:
  jaxlfi design runs/decay                          the experiment that tells most
  jaxlfi design runs/furuta --experiments 3         three at once, each counting on the others
  jaxlfi design runs/furuta --about ridge           what tells most of the worst-determined direction
  jaxlfi design runs/whip                           the next whip, played by jaxlfi whip control experiment_1.csv

"""


def _arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("run", type=Path, metavar="RUN", help="the folder of one finished run (of one seed)")
    add("--experiments", type=int, default=1, metavar="N", help="number of experiments to choose (default: 1)")
    add(
        "--about",
        nargs="+",
        default=(),
        metavar="NAME",
        help="parameters of interest, or ridge: the direction that the posterior determines worst "
        "(default: all parameters)",
    )
    add(
        "--method",
        choices=("auto", "fisher", "contrastive"),
        default="auto",
        help="Fisher information, a contrastive lower bound from simulations, or the former if the noise is declared "
        "(default: auto)",
    )
    add("--inflation", type=float, default=2.0, metavar="X", help="designs are rated over the posterior widened "
        "by this factor (default: 2)")  # fmt: skip
    add("--share", type=float, default=0.2, metavar="X", help="weight of the heuristic's next box (default: 0.2)")
    add("--tolerance", type=float, default=0.05, metavar="X", help="largest fraction of the posterior for which "
        "an experiment may fail (default: 0.05)")  # fmt: skip
    add("--rated", type=int, metavar="N", help="designs rated for each experiment (default: 300; outside JAX 75)")
    add(
        "--simulations",
        type=int,
        metavar="N",
        help="simulations of each design, contrastive (default: 1024; outside JAX 256)",
    )
    add("--seed", type=flags.seed, default=0, metavar="N", help="seed of all random numbers (default: 0)")
    add("--task", metavar="TASK", help="the task, for a run that was made in Python")
    add("--out", type=flags.output, metavar="DIR", help="a new folder (default: design in the run's folder)")
    add("--no-figures", action="store_true", help="do not draw figures")
    add("--quiet", action="store_true", help="print results and warnings only")
    add("--debug", action="store_true", help="show the traceback of an error")


def _run(arguments: argparse.Namespace) -> None:
    from jaxlfi.io import compile_cache

    compile_cache.enable()
    from rich.markup import escape
    from rich.table import Table

    from jaxlfi.cli import tables
    from jaxlfi.design import choosing, played, recommendation
    from jaxlfi.io.progress import RoundProgress
    from jaxlfi.io.workfolder import refuse_occupied
    from jaxlfi.registry import TASKS
    from jaxlfi.runs.load import load
    from jaxlfi.tasks.experiments import require_design

    out = arguments.out or arguments.run / "design"
    refuse_occupied(out)
    run = load(arguments.run, None if arguments.task is None else TASKS.load(arguments.task))
    if run.task is None:
        raise ValueError("task: expected a run whose task can be found, got one made in Python: --task module:factory")
    require_design(run.task)
    output = tables.Output.of(arguments.quiet)
    rated = arguments.rated or recommendation.default(run.task, choosing.RATED)
    steps = choosing.steps(arguments.experiments, rated)
    bar = RoundProgress(output.notes, steps, 0, run.task.name, "design") if output.notes.is_terminal else None
    with bar or contextlib.nullcontext():
        found = run.design(
            arguments.experiments,
            arguments.about,
            arguments.method,
            inflation=arguments.inflation,
            share=arguments.share,
            tolerance=arguments.tolerance,
            rated=arguments.rated,
            simulations=arguments.simulations,
            seed=arguments.seed,
            advanced=bar.advance if bar else lambda designs: None,
        )
    headings, rows = found.table()
    table = Table(*map(escape, headings), title=escape(f"{run.task.name}: experiments, by {found.method}"))
    for row in rows:
        table.add_row(*map(escape, row))
    tables.show(table, output.results)
    for line in found.sentences():
        output.results.print(escape(line), soft_wrap=True, highlight=False)
    found.save(out)
    if why := played.lacking(found.task.design.controls):
        output.results.print(escape(f"controls are written as CSV only: {why}"), soft_wrap=True, highlight=False)
    output.notes.print(escape(f"design: {out}"), soft_wrap=True, highlight=False)
    if not arguments.no_figures:
        from jaxlfi.figures import designs

        output.notes.print(escape(f"picture: {designs.report(out)}"), soft_wrap=True, highlight=False)


main = Command(
    "design",
    "recommend the next experiment",
    _arguments,
    _run,
    description="Which experiment of a run's task is expected to tell most of its parameters.",
    epilog=EXAMPLES,
)
parser = main.parser
