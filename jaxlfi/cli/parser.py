"""The command line: `jaxlfi tasks | infer | compare | grid | resume | sample | diagnose | report`, and those of tasks.

A package adds commands of its own by `[project.entry-points."jaxlfi.commands"]` in pyproject.toml: a name, and a
function that takes the words after it and returns the exit status.

This module imports neither jax nor numpy, so that `--help` answers at once and so that what has to be set
before jax starts can be set after the arguments are known.
"""

import argparse
import dataclasses
import itertools
import json
import math
import sys
import traceback
from collections.abc import Mapping, Sequence
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import NoReturn

import jaxlfi
from jaxlfi import flags, source_fields
from jaxlfi.fields import Declared

PRESETS = ("quick", "paper")
METHODS = ("bayessim", "apt", "npe", "snle")
HEURISTICS, ESTIMATORS = "jaxlfi.heuristics", "jaxlfi.estimators"
"""The entry-point groups of classes whose fields have flags."""
SETTINGS = "jaxlfi.bayessim.settings:Settings"
"""The class whose fields are the settings of a run."""
FILE_WIDTH = 120
"""Characters in a line of output that goes to a file or a pipe."""

GLOSSARY = """\
names and symbols:
  support         Theta, the box the parameters are drawn from; it is what the heuristics adapt
  feasible        Phi, the limits that no adapted support leaves
"""
"""The part of the glossary in `--help` that is not made from the heuristics' hyperparameters."""

MAIN_EXAMPLES = """\
examples:
  jaxlfi tasks                                   what there is to infer
  jaxlfi infer lotka_volterra --support misspecified --heuristic edge --out runs/edge
  jaxlfi compare lotka_volterra --seeds 10 --out runs/comparison
  jaxlfi grid lotka_volterra --vary expansion=0.1,0.2,0.4 --out runs/grid
  jaxlfi resume runs/comparison                  go on after a crash, to the same result bit for bit
  jaxlfi sample runs/edge -n 1000                draws from the posterior, in natural units
  jaxlfi diagnose runs/edge                      whether the posterior can be believed
  jaxlfi report runs/comparison                  draw the pictures again

Bad input ends with one line on stderr and exit status 2; nothing is ever overwritten.
"""

INFER_EXAMPLES = """\
examples:
  jaxlfi infer lotka_volterra --support misspecified --heuristic edge --out runs/edge
  jaxlfi infer lotka_volterra --mass-threshold 0.01 --expansion 0.1 0.1 0.2 0.2 --out runs/gentle
  jaxlfi infer spring:task --observation real.csv --support-low 1 0.1 --support-high 10 1 --out runs/spring
  jaxlfi infer lotka_volterra --preset paper --seeds 4 --out runs/paper
  jaxlfi infer whip --object dlo-0 --heuristic edge --out runs/dlo-0
  jaxlfi infer whip --object dlo-2 rollout-7.npz --out runs/two-rollouts

"""

COMPARE_EXAMPLES = """\
A configuration is SUPPORT (kept fixed) or SUPPORT+HEURISTIC. All configurations and seeds run side by side;
the same seed means the same observation in all of them. All make the same number of rounds, whether their
posteriors have settled or not.

examples:
  jaxlfi compare lotka_volterra --seeds 10 --out runs/comparison
  jaxlfi compare lotka_volterra --configurations ok broad broad+centre --seeds 20 --out runs/broad

"""


GRID_EXAMPLES = """\
Every combination of values is run with every seed, side by side in chunks that fit the memory; the same seed means
the same observation in all of them. Hyperparameters on no axis keep the paper's values, or those of their flags.

examples:
  jaxlfi grid lotka_volterra --support misspecified --out runs/edge-grid \\
      --vary zone_fraction=0.05,0.1,0.2 mass_threshold=0.001,0.005,0.05 expansion=0.1,0.2,0.4
  jaxlfi grid lotka_volterra --heuristic mode --vary proximity=0.2,0.4 --vary expansion=0.1,0.2 --out runs/mode-grid

"""

DIAGNOSE_EXAMPLES = """\
Truths are drawn from the run's own posterior, and from the prior over a support, and simulated. The run's method is
asked for the posterior of each: by its network, where the run had one round and kept it (--method npe, or --rounds 1
--keep-network), else by repeating the whole inference side by side, in chunks that are saved as they end. A command
that was stopped goes on when it is given again. It takes about as long as that many runs; a failed check does not
change the exit status, 0.

widths, of each parameter, at each reference:
  honest        90 % intervals held 90 % of the truths, and are known to be of the right width to within 1.5
  too narrow    they held fewer; the number is how many times as wide they would have to be. too wide: more
  biased        truths lie to one side of the intervals' medians
  undecided     too few truths to tell
  At the posterior: is the method honest where this run ended up? Over a support: for objects of all kinds?

checks, over a support:
  rank          of each truth among its draws, by parameter (simulation-based calibration)
  coverage      how often the densest region of a level holds the truth; around random points (TARP)
  classifier    accuracy of a classifier that separates truths from draws, given the simulation
  predictive    (of the run itself) whether its own observation looks like simulations of its own posterior
verdicts:
  over-confident, under-confident: posteriors are too narrow, too wide; biased low, high: they lie below, above
  the truths. A check fails at p up to 0.01, corrected for the number of parameters.

examples:
  jaxlfi diagnose runs/npe
  jaxlfi diagnose runs/edge --reference posterior,ok --truths 200
  jaxlfi diagnose runs/edge --reference posterior --out runs/edge-at-its-posterior
  jaxlfi diagnose runs/gaussian --against reference.csv

"""


class OneLineParser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """One line on stderr, and exit status 2."""
        self.exit(2, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


@dataclasses.dataclass(frozen=True)
class Families:
    """Classes whose fields have flags, by the names they are registered by or as `module:Class`.

    Attributes:
        heuristics: their sources.
        estimators: their sources.
    """

    heuristics: Mapping[str, source_fields.Source]
    estimators: Mapping[str, source_fields.Source]

    @staticmethod
    def of(words: Sequence[str]) -> "Families":
        """All that are installed, and those that the words name, as their sources describe them."""
        heuristics = [*_values(words, "--heuristic"), *(word.partition("+")[2] for word in words)]
        return Families(
            *(
                source_fields.of_group(group) | {name: source_fields.of_class(name) for name in named if ":" in name}
                for group, named in ((HEURISTICS, heuristics), (ESTIMATORS, _values(words, "--estimator")))
            )
        )

    @property
    def rules(self) -> flags.Families:
        """Fields of the heuristics."""
        return {name: source.fields for name, source in self.heuristics.items()}

    @property
    def networks(self) -> flags.Families:
        """Fields of the estimators."""
        return {name: source.fields for name, source in self.estimators.items()}


def _values(words: Sequence[str], flag: str) -> list[str]:
    """What the words give for a flag."""
    after = [value for word, value in itertools.pairwise([*words, ""]) if word == flag]
    return after + [word.removeprefix(f"{flag}=") for word in words if word.startswith(f"{flag}=")]


def _run_fields() -> Mapping[str, Declared]:
    return source_fields.of_class(SETTINGS).fields


def parser(families: Families | None = None) -> argparse.ArgumentParser:
    """The whole command line.

    Args:
        families: classes whose fields have flags; by default all that are installed.
    """
    families = Families.of(()) if families is None else families
    glossary = GLOSSARY + flags.glossary(families.rules)
    formatter = argparse.RawDescriptionHelpFormatter
    top = OneLineParser(
        prog="jaxlfi",
        description="Likelihood-free inference that notices when the prior's support is wrong, and moves it.",
        epilog=MAIN_EXAMPLES,
        formatter_class=formatter,
    )
    top.add_argument("--version", action="version", version=f"jaxlfi {jaxlfi.__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    tasks = commands.add_parser("tasks", help="list tasks, or describe one", description="List tasks, or describe one.")
    tasks.add_argument("name", nargs="?", metavar="TASK", help="describe this one: parameters, units, supports, truth")

    infer = commands.add_parser(
        "infer",
        help="infer a task's parameters",
        description="Infer a task's parameters from one observed trajectory, adapting the support.",
        epilog=INFER_EXAMPLES + glossary,
        formatter_class=formatter,
    )
    infer.add_argument(
        "--support", metavar="NAME", help="the support to begin with, by name (default: the task's first)"
    )
    infer.add_argument(
        "--support-low",
        nargs="+",
        type=float,
        metavar="X",
        help="your own support's lower bounds, one a parameter, in natural units",
    )
    infer.add_argument("--support-high", nargs="+", type=float, metavar="X", help="its upper bounds")
    infer.add_argument(
        "--simulations",
        type=Path,
        metavar="FILE",
        help="an .npz of simulations made before, in place of the first round's: theta [N, D] in natural units, "
        "trajectory [N, ...] or summaries x [N, S], and where they were not drawn uniformly log_density [N]",
    )
    infer.add_argument(
        "--heuristic",
        default="edge",
        metavar="NAME",
        help=_registered("how the support is adapted", families.rules, "edge"),
    )
    _add_shared(infer, families, seeds=1)

    compare = commands.add_parser(
        "compare",
        help="run supports and heuristics side by side",
        description="Run supports and heuristics side by side, over several seeds, and tabulate the errors.",
        epilog=COMPARE_EXAMPLES + glossary,
        formatter_class=formatter,
    )
    compare.add_argument(
        "--configurations",
        nargs="+",
        metavar="SUPPORT[+HEURISTIC]",
        help="what to compare (default: ok, misspecified, broad, and misspecified with edge, mode, centre)",
    )
    _add_shared(compare, families, seeds=4)

    grid = commands.add_parser(
        "grid",
        help="run a heuristic over a grid of its hyperparameters",
        description="Run a heuristic over a grid of its hyperparameters, to see how sensitive it is to them.",
        epilog=GRID_EXAMPLES + glossary,
        formatter_class=formatter,
    )
    grid.add_argument(
        "--vary",
        nargs="+",
        action="extend",
        required=True,
        metavar="NAME=V,V,...",
        help="a hyperparameter and its values, as in expansion=0.1,0.2,0.4; several, or the flag again",
    )
    grid.add_argument(
        "--support", metavar="NAME", help="the support to begin with, by name (default: the task's first)"
    )
    grid.add_argument(
        "--heuristic",
        default="edge",
        metavar="NAME",
        help=_registered("whose hyperparameters vary", families.rules, "edge"),
    )
    grid.add_argument(
        "--runs-per-chunk",
        type=int,
        metavar="N",
        help="runs computed and saved together (default: as many as there is memory for)",
    )
    _add_shared(grid, families, seeds=4, networks=False)

    resume = commands.add_parser(
        "resume",
        help="go on with a run that was stopped",
        description="Go on with a run that was stopped or killed.",
    )
    resume.add_argument("folder", type=Path, metavar="DIR", help="the folder the command was given")
    _add_machine(resume)

    sample = commands.add_parser(
        "sample",
        help="draw from the posterior of a run",
        description="Draw parameters from the posterior of a finished run, in natural units.",
    )
    sample.add_argument("folder", type=Path, metavar="DIR", help="the folder of one run (of one seed)")
    sample.add_argument("-n", "--number", type=int, default=1000, metavar="N", help="draws (default: 1000)")
    sample.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the draws (default: 0)")
    sample.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="a new .csv or .npz file, or .nc for ArviZ's InferenceData (default: samples.csv in the folder)",
    )

    diagnose = commands.add_parser(
        "diagnose",
        help="check whether the posterior of a run can be believed",
        description="Check whether the posteriors of a run's method are calibrated, and whether its own fits.",
        epilog=DIAGNOSE_EXAMPLES,
        formatter_class=formatter,
    )
    diagnose.add_argument("folder", type=Path, metavar="DIR", help="the folder of one finished run (of one seed)")
    diagnose.add_argument(
        "--reference",
        metavar="NAME[,NAME]",
        help="where truths are drawn: posterior, the name of a support, or one of each (default: posterior, and the "
        "task's first support)",
    )
    diagnose.add_argument("--truths", type=int, default=100, metavar="N", help="of each reference (default: 100)")
    diagnose.add_argument(
        "--draws", type=int, default=200, metavar="L", help="draws from the posterior of each (default: 200)"
    )
    diagnose.add_argument("--seed", type=int, default=0, metavar="S", help="of all random numbers (default: 0)")
    diagnose.add_argument(
        "--task",
        metavar="TASK",
        help="what was inferred, for a run that was made in Python (default: the task recorded with the run)",
    )
    diagnose.add_argument(
        "--against",
        type=Path,
        metavar="FILE",
        help="samples to compare the run's posterior with, in natural units: a .csv with the parameters' names as "
        'headings, or an .npz with an array "theta"',
    )
    diagnose.add_argument(
        "--out", type=Path, metavar="DIR", help="a new folder for the results (default: diagnostics in the run's)"
    )
    _add_machine(diagnose)

    report = commands.add_parser(
        "report",
        help="draw the pictures of a run",
        description="Draw all pictures of a folder from its saved files.",
    )
    report.add_argument("folder", type=Path, metavar="DIR", help="a folder that infer, compare or grid wrote")
    for name in foreign_commands():
        commands.add_parser(name, add_help=False, help=f"commands of its own: jaxlfi {name} --help")
    return top


def foreign_commands() -> dict[str, EntryPoint]:
    """Commands that installed packages add, by name."""
    return {point.name: point for point in entry_points(group="jaxlfi.commands")}


def parse(words: Sequence[str]) -> argparse.Namespace:
    """The arguments.

    Where the source of a class does not show all its fields, and there are flags that nothing else knows, the class is
    imported, and jax with it.

    Raises:
        ValueError: if that fails.
    """
    families = Families.of(words)
    arguments, unknown = parser(families).parse_known_args(words)
    if not unknown:
        return arguments
    rules, networks = _rules_used(arguments), {getattr(arguments, "estimator", None)} - {None}
    if any(not families.heuristics[name].complete for name in rules & set(families.heuristics)) or any(
        not families.estimators[name].complete for name in networks & set(families.estimators)
    ):
        prepare_jax(arguments)
        families = _imported(families, rules, networks)
    return parser(families).parse_args(words)


def _imported(families: Families, rules: set[str], networks: set[str]) -> Families:
    """The families with what some classes really declare."""
    from jaxlfi.estimators import registry as estimators
    from jaxlfi.fields import declared
    from jaxlfi.heuristics import registry as heuristics

    real = lambda registry, names: {
        name: source_fields.Source(declared(registry.load(name)), complete=True) for name in names
    }
    return Families(
        {**families.heuristics, **real(heuristics, rules)}, {**families.estimators, **real(estimators, networks)}
    )


def _rules_used(arguments: argparse.Namespace) -> set[str]:
    """Names of the heuristics that a command is going to use, right or wrong."""
    configured = getattr(arguments, "configurations", None) or ()
    named = [getattr(arguments, "heuristic", None), *(word.partition("+")[2] for word in configured)]
    return {name for name in named if name}


def _registered(what: str, families: flags.Families, default: str) -> str:
    names = ", ".join(name for name in families if ":" not in name)
    return f"{what}: {names}, or your own as module:Class (default: {default})"


def _add_shared(command: argparse.ArgumentParser, families: Families, seeds: int, networks: bool = True) -> None:
    """Arguments that `infer`, `compare` and `grid` have in common; `grid` saves no networks."""
    command.add_argument(
        "task", metavar="TASK", help="a task's name (see jaxlfi tasks), or module:factory; NAME,key=value sets options"
    )
    command.add_argument(
        "--object",
        nargs="+",
        action="extend",
        metavar="NAME",
        help="what is observed, where the task knows several objects (short for TASK,object=NAME); several names or "
        "files: recordings of one object, each under its own actions, believed together (short for "
        "TASK,object=NAME;NAME)",
    )
    command.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new or empty folder for the results")
    command.add_argument(
        "--method",
        choices=METHODS,
        default="bayessim",
        help="bayessim; apt: sequential, flows, atomic loss (SNPE-C); npe: flows, one round; snle: sequential, "
        "likelihoods (default: bayessim)",
    )
    command.add_argument(
        "--preset", choices=PRESETS, default="quick", help="the settings to start from (default: quick)"
    )
    command.add_argument("--seeds", type=int, default=seeds, metavar="N", help=f"number of runs (default: {seeds})")
    command.add_argument("--first-seed", type=int, default=0, metavar="N", help="the first run's seed (default: 0)")
    command.add_argument(
        "--observation",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="the observed trajectory, .csv (a row a record, a column a channel) or .npz; several files: independent "
        "trials of the same parameters, believed together "
        "(default: the task's own, or one simulated at the known truth)",
    )
    _add_machine(command)
    if networks:
        command.add_argument("--keep-network", action="store_true", help="also save the trained networks (network.npz)")

    rounds = command.add_argument_group("rounds (default: the preset's)")
    flags.add(rounds, {"run": _run_fields()}, into="settings", defaults=False)
    network = command.add_argument_group("network and training (default: the preset's)")
    network.add_argument(
        "--estimator", metavar="NAME", help=_registered("the density estimator", families.networks, "the method's")
    )
    flags.add(network, families.networks, into="settings", defaults=False)
    hyper = command.add_argument_group("heuristics (one number, or one a parameter)")
    flags.add(hyper, families.rules, into="hyperparameters", several=True)
    command.set_defaults(settings={}, hyperparameters={})


def _add_machine(command: argparse.ArgumentParser) -> None:
    """Arguments about how, not what."""
    command.add_argument("--no-figures", action="store_true", help="draw no pictures at the end")
    command.add_argument("--debug", action="store_true", help="show where an error came from")
    command.add_argument("--no-cache", action="store_true", help="compile anew, without the cache of compiled programs")


def prepare_jax(arguments: argparse.Namespace) -> None:
    """Set what must be set before jax starts.

    On CPU jax sees one device, and runs of small networks do not fill it: with as many devices as cores, each takes
    its part of a batch. A single run stays on one device, whose matrix products then use all cores.
    """
    from jaxlfi.io import host_devices

    runs = _runs(arguments)
    if runs > 1:
        # The same batch on the same number of devices repeats bit for bit.
        host_devices.divide(_recorded(arguments).get("devices") or min(host_devices.processors(), runs))
    if not getattr(arguments, "no_cache", True):
        from jaxlfi.io import compile_cache

        compile_cache.enable()


TYPICAL_CONFIGURATIONS = 6
"""Of a comparison that names none: three supports, and one of them with three heuristics."""


def _runs(arguments: argparse.Namespace) -> int:
    """How many runs a command is going to have, as far as its arguments show."""
    if arguments.command == "resume":
        recorded = _recorded(arguments)
        return (
            len(recorded.get("runs") or ()) if isinstance(recorded.get("runs"), list) else 2
        )  # a grid does not list its runs
    if arguments.command == "compare":
        return arguments.seeds * (len(arguments.configurations) if arguments.configurations else TYPICAL_CONFIGURATIONS)
    if arguments.command == "grid":
        return arguments.seeds * math.prod(axis.count(",") + 1 for axis in arguments.vary)
    if arguments.command == "diagnose":
        return arguments.truths
    return getattr(arguments, "seeds", 1)


def _recorded(arguments: argparse.Namespace) -> dict:
    """What the work to go on with says of itself, where there is some; whether it is sound is checked later."""
    if arguments.command == "resume":
        path = arguments.folder / "config.json"
    elif arguments.command == "diagnose":
        path = (arguments.out or arguments.folder / "diagnostics") / "plan.json"
    else:
        return {}
    try:
        config = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return config if isinstance(config, dict) else {}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        0; 2 for bad input; 130 where it was interrupted.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if words and (foreign := foreign_commands().get(words[0])):
        return foreign.load()(words[1:])
    try:
        arguments = parse(words)
    except ValueError as error:
        return _refuse(error)
    if getattr(arguments, "object", None) is not None:
        arguments.task = f"{arguments.task},object={';'.join(arguments.object)}"
    if len(getattr(arguments, "observation", None) or ()) > 1 and ",trials=" not in arguments.task:
        learnt = arguments.settings.get("embedding") == "trials" and ",pooling=" not in arguments.task
        arguments.task = f"{arguments.task},trials={len(arguments.observation)}{',pooling=all' * learnt}"
    prepare_jax(arguments)
    prepared = None
    try:
        from rich.console import Console

        from jaxlfi.cli import commands

        console = Console() if sys.stdout.isatty() else Console(width=FILE_WIDTH)
        try:
            prepared = commands.COMMANDS[arguments.command](arguments, console)
        except (ValueError, OSError) as error:
            return _refuse(error, getattr(arguments, "debug", False))
        if prepared is not None:
            try:
                commands.run(*prepared, arguments, console)
            except commands.EXPECTED as error:
                return _refuse(error, getattr(arguments, "debug", False))
    except KeyboardInterrupt:
        advice = f"; continue with: jaxlfi resume {prepared[0]}" if prepared else ""
        if arguments.command == "diagnose":
            advice = "; the same command goes on from here"
        print(f"jaxlfi: interrupted{advice}", file=sys.stderr)
        return 130
    return 0


def _refuse(error: Exception, debug: bool = False) -> int:
    """Report an error in one line, and where it came from on request."""
    if debug:
        traceback.print_exception(error)
    text = " ".join(str(error).split()) or type(error).__name__
    print(f"jaxlfi: error: {text}", file=sys.stderr)
    return 2
