"""Our methods compared with sbi's and BayesFlow's, on the same observations, seeds, simulators and budgets.

    python -m experiments.sota --simulations 1000 --methods npe sbi-npe bayesflow-npe --seeds 5

Each case (setting, method, budget, seed) is one row of OUT/results.csv, written as soon as it is finished; a finished
case is not run again, so the same command continues an interrupted run. OUT/tables.md is made from the rows, and
OUT/config.json has settings and versions. Methods of other libraries need the `bench` extra. The comparison and its
fairness are discussed in experiments/studies/sota.md.
"""

import argparse
import contextlib
import importlib
import importlib.metadata
import itertools
import signal
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from experiments.sota import rows
from experiments.sota.cases import SETTINGS, case_of
from experiments.sota.measures import DRAWS, FLOOR, Found, judged
from experiments.sota.ours import NAMES, settings_of
from jaxlfi.io import files as atomic
from jaxlfi.io.provenance import environment
from jaxlfi.runs.describe import settings_to_json

MODULES = {
    **dict.fromkeys(NAMES, "ours"),
    **dict.fromkeys(("sbi-npe", "sbi-apt", "sbi-tsnpe", "sbi-snle"), "sbi_methods"),
    "bayesflow-npe": "bayesflow_methods",
}
"""Modules of each method's `infer(method, case, simulations)`; those of other libraries are imported on request."""
METHODS = (
    *("bayessim", "bayessim+edge", "npe", "sbi-npe", "bayesflow-npe"),
    *("apt", "sbi-apt", "tsnpe", "sbi-tsnpe", "snle", "sbi-snle"),
)
"""All methods, in the order of the tables."""
PACKAGES = ("sbi", "torch", "nflows", "bayesflow", "keras")
"""Packages of other libraries whose versions are recorded."""


def wanted(settings: list[str], methods: list[str], simulations: list[int], seeds: range) -> list[rows.Row]:
    """The cases in the order they are run in, such that those that share a compiled program follow one another.

    A heuristic has nothing to adapt if the support is right, so `bayessim+edge` is run only on the wrong one.
    """
    every = itertools.product(simulations, settings, methods, seeds)
    return [
        dict(zip(rows.IDENTITY, (setting, method, str(budget), str(seed)), strict=True))
        for budget, setting, method, seed in every
        if method != "bayessim+edge" or SETTINGS[setting][1] == "misspecified"
    ]


def inference(method: str) -> Callable:
    """The function that runs a method.

    Raises:
        SystemExit: in one line, if its library is not installed.
    """
    try:
        return importlib.import_module(f"experiments.sota.{MODULES[method]}").infer
    except ImportError as error:
        raise SystemExit(f"{method}: {error}") from None


@contextlib.contextmanager
def at_most(seconds: int):
    """Raise TimeoutError in code that takes longer, if it is in Python.

    The signal is caught only in the main thread, where cases are run.
    """

    def stop(*_):
        raise TimeoutError(f"gave up after {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def finished(what: rows.Row, infer: Callable, limit: int) -> rows.Row:
    """Run a case: its row, with a note instead of measures if another library fails or takes too long."""
    case, simulations = case_of(what["setting"], int(what["seed"])), int(what["simulations"])
    row = dict.fromkeys(rows.COLUMNS, "") | what
    if what["method"] in NAMES:
        found = infer(what["method"], case, simulations)
        return row | described(found) | judged(case, found)
    try:
        with at_most(limit):
            found = infer(what["method"], case, simulations)
    # An exception of another library is a result of the comparison.
    except Exception as error:
        first_line = (str(error).strip() or type(error).__name__).splitlines()[0]
        return row | {"note": f"{type(error).__name__}: {first_line}"[:200]}
    return row | described(found) | judged(case, found)


def described(found: Found) -> rows.Row:
    """Costs as they are written to a row."""
    return {
        "seconds": f"{found.seconds:.1f}",
        "compile_seconds": f"{found.compile_seconds:.1f}",
        "simulated": str(found.simulated),
        "failed": str(found.failed),
        "note": found.note,
    }


def version(package: str) -> str:
    """The version of an installed package, or "not installed"."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def config(budgets: list[int], limit: int) -> dict:
    """Settings of our methods and of the evaluation, and versions."""
    ours = {
        f"{method}, {budget}": settings_to_json(settings_of(method, budget)) for method in NAMES for budget in budgets
    }
    more = {package: version(package) for package in PACKAGES}
    return {"settings": ours, "draws": DRAWS, "floor": FLOOR, "limit": limit, "others": more, **environment()}


def main() -> None:
    """Run what is missing, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--settings", nargs="+", choices=list(SETTINGS), default=list(SETTINGS))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--simulations", nargs="+", type=int, default=[1000, 10_000], help="budgets, failures included")
    parser.add_argument("--seeds", type=int, default=5, help="how many")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument(
        "--limit", type=int, default=900, help="seconds after which a case of another library is given up"
    )
    parser.add_argument("--out", type=Path, default=Path("experiments/results/sota"))
    arguments = parser.parse_args()
    if min(arguments.simulations) < 100:
        parser.error(f"--simulations: expected at least 100, ten a round, got {min(arguments.simulations)}")
    path, console = arguments.out / "results.csv", Console(soft_wrap=True)
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    cases = wanted(arguments.settings, arguments.methods, arguments.simulations, seeds)
    there = rows.read(path)
    left = rows.missing(cases, there)
    functions = {method: inference(method) for method in dict.fromkeys(one["method"] for one in left)}
    arguments.out.mkdir(parents=True, exist_ok=True)
    if left:
        budgets = {*arguments.simulations, *(int(row["simulations"]) for row in there)}
        atomic.write_json(arguments.out / "config.json", config(sorted(budgets), arguments.limit))
    for number, one in enumerate(left, start=1):
        row = finished(one, functions[one["method"]], arguments.limit)
        rows.append(path, row)
        console.print(f"{number} of {len(left)}:", *(f"{name} {value}" for name, value in row.items() if value))
    text = rows.tables(rows.read(path), list(SETTINGS), METHODS)
    atomic.write_bytes(arguments.out / "tables.md", text.encode())
    print(text)


if __name__ == "__main__":
    main()
