"""The command `jaxlfi evaluate`: how saved policies perform on domains, their own and others.

This module imports neither jax nor numpy before it has to, so that `--help` answers at once.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from jaxlfi import flags
from jaxlfi.cli.command import Command
from jaxlfi.cli.domains import DOMAINS, domains_of
from jaxlfi.registry import ENVIRONMENTS

EXAMPLES = f"""\
{DOMAINS}
examples:
  jaxlfi evaluate whip runs/policies/*/*/policy.npz --domain runs/dlo-0 uniform median --out runs/cross.csv

"""


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("environment", metavar="ENVIRONMENT", help="an environment's name, as for jaxlfi train")
    parser.add_argument(
        "policies", nargs="+", type=Path, metavar="FILE", help="policy.npz files that jaxlfi train wrote"
    )
    parser.add_argument("--domain", nargs="+", required=True, metavar="DOMAIN", help="domains to evaluate on")
    parser.add_argument(
        "--episodes", type=int, default=128, metavar="N", help="number of episodes on each domain (default: 128)"
    )
    parser.add_argument(
        "--seed", type=flags.seed, default=0, metavar="N", help="seed of the points and episodes (default: 0)"
    )
    parser.add_argument(
        "--out", type=flags.output, metavar="FILE", help="a new .csv with one row per policy and domain"
    )
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")


def _run(arguments: argparse.Namespace) -> None:
    from jaxlfi.io import compile_cache, files, text_table

    compile_cache.enable()
    from rich.table import Table

    from jaxlfi.cli import tables
    from jaxlfi.rl.evaluation import cross_evaluate
    from jaxlfi.rl.policy import load

    if arguments.out is not None and (arguments.out.exists() or arguments.out.suffix != ".csv"):
        raise ValueError(f"out: expected a new .csv file, got {arguments.out}")
    if arguments.out is not None:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)  # if this fails, it fails before the work
    environment = ENVIRONMENTS.load(arguments.environment)
    policies = {str(path): load(path) for path in arguments.policies}
    draws = domains_of(environment, arguments.domain)
    rows = cross_evaluate(environment, policies, draws, arguments.episodes, arguments.seed)
    table = Table(*rows[0], title=f"{arguments.episodes} episodes on each domain")
    for cells in zip(*(_cells([row[name] for row in rows]) for name in rows[0]), strict=True):
        table.add_row(*cells)
    tables.show(table)
    if arguments.out is not None:
        text = text_table.as_csv(list(rows[0]), (list(row.values()) for row in rows))
        files.write_bytes(arguments.out, text.encode())


def _cells(column: Sequence[str | float]) -> list[str]:
    from rich.markup import escape

    from jaxlfi.cli import tables

    texts = [escape(one) for one in column if isinstance(one, str)]
    return texts or tables.numbers([float(one) for one in column])


main = Command(
    "evaluate",
    "evaluate saved policies on other domains",
    _arguments,
    _run,
    description="Evaluate saved policies, without exploration noise, on points drawn from domains. All policies get "
    "the same episodes.",
    epilog=EXAMPLES,
)
parser = main.parser
