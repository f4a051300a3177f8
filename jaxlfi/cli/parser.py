"""The command line: `jaxlfi tasks | infer | compare | grid | resume | sample | diagnose | report`, and tasks' own.

A package adds commands with `[project.entry-points."jaxlfi.commands"]` in pyproject.toml: a name, and a
`jaxlfi.cli.command.Command`, or any function that takes the words after the name and returns the exit status.

This module imports neither jax nor numpy, so that `--help` answers at once, and so that settings that jax needs before
it starts can be made once the arguments are known.
"""

import argparse
import contextlib
import dataclasses
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jaxlfi
from jaxlfi import flags, references
from jaxlfi.cli import help_texts, interrupts, multi_process
from jaxlfi.cli.command import Command, OneLineParser
from jaxlfi.cli.exit_status import refuse, resuming, warnings_in_lines
from jaxlfi.cli.own_fields import FIELDS, HELP
from jaxlfi.cli.own_fields import PRESETS as VALUES
from jaxlfi.fields import declared
from jaxlfi.io.formats import PLAN, recorded
from jaxlfi.registry import COMMANDS, ESTIMATORS, HEURISTICS, TASKS, Classes, package_of

PRESETS = ("quick", "paper")
METHODS = ("bayessim", "tsnpe", "apt", "npe", "snle")
OWN_COMMANDS = ("tasks", "infer", "compare", "grid", "resume", "sample", "diagnose", "report")
SETTINGS = "jaxlfi.bayessim.settings:Settings"
"""The class whose fields are the settings of a run."""


@dataclasses.dataclass(frozen=True)
class Families:
    """Declared fields, by class name, of the classes whose fields have flags; empty for packages not imported."""

    rules: flags.Families = dataclasses.field(default_factory=lambda: _own(HEURISTICS))  # the heuristics
    networks: flags.Families = dataclasses.field(default_factory=lambda: _own(ESTIMATORS))  # the estimators

    def __add__(self, others: "Families") -> "Families":
        """Both; for a class that both have, the fields of the others."""
        return Families({**self.rules, **others.rules}, {**self.networks, **others.networks})


def _own(family: Classes) -> flags.Families:
    """All registered names, with the fields of our own classes."""
    registered = family.points().items()
    return {name: {} if others else FIELDS.get(point.value, {}) for name, (point, *others) in registered}


def _foreign(arguments: argparse.Namespace) -> dict[Classes, list[str]]:
    """Names of other packages' classes in the arguments."""
    configured = getattr(arguments, "configurations", None) or ()
    rules = {getattr(arguments, "heuristic", None), *(word.partition("+")[2] for word in configured)}
    found = {}
    for family, names in ((HEURISTICS, rules), (ESTIMATORS, {getattr(arguments, "estimator", None)})):
        others = {name for name, (point, *_) in family.points().items() if point.value not in FIELDS}
        found[family] = sorted(name for name in names if name and (":" in name or name in others))
    return found


def _imported(foreign: Mapping[Classes, Sequence[str]]) -> Families:
    """The fields of these classes, which are imported, and jax with them.

    Raises:
        ValueError: if they cannot be imported.
    """
    return Families(*({name: declared(family.load(name)) for name in names} for family, names in foreign.items()))


def parser(families: Families | None = None) -> argparse.ArgumentParser:
    """The whole command line, with flags for the fields of classes: by default of all installed ones."""
    families = families or Families()
    top = OneLineParser(
        prog="jaxlfi",
        description="Likelihood-free inference that notices when the prior's support is wrong, and moves it.",
        epilog=help_texts.MAIN_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"jaxlfi {jaxlfi.__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in own_commands(families):
        command.add_to(commands)
    for name, points in COMMANDS.points().items():
        if name not in OWN_COMMANDS:
            help = HELP.get(points[0].value, f"commands of its own: jaxlfi {name} --help").replace("%", "%%")
            commands.add_parser(name, add_help=False, help=help)
    return top


def own_commands(families: Families) -> list[Command]:
    """The commands of inference; those of policies, of tasks and of other packages are entry points."""
    glossary = help_texts.GLOSSARY + flags.glossary(families.rules)
    return [
        Command("tasks", "list tasks, or describe one", _tasks, _work, "List tasks, or describe one."),
        Command(
            "infer",
            "infer a task's parameters",
            lambda command: _infer(command, families),
            _work,
            "Infer a task's parameters from one observed trajectory, adapting the support.",
            help_texts.INFER_EXAMPLES + glossary,
        ),
        Command(
            "compare",
            "compare supports and heuristics over several seeds",
            lambda command: _compare(command, families),
            _work,
            "Run supports and heuristics over several seeds, and tabulate their errors.",
            help_texts.COMPARE_EXAMPLES + glossary,
        ),
        Command(
            "grid",
            "run a heuristic over a grid of its hyperparameters",
            lambda command: _grid(command, families),
            _work,
            "Run a heuristic over a grid of its hyperparameters, to see how sensitive it is to them.",
            help_texts.GRID_EXAMPLES + glossary,
        ),
        Command(
            "resume",
            "continue an interrupted run, or a finished one with more simulations",
            _resume,
            _work,
            "Continue a run that was interrupted, or a finished one with more rounds or simulations.",
            help_texts.RESUME_EXAMPLES,
        ),
        Command(
            "sample",
            "draw from the posterior of a run",
            _sample,
            _work,
            "Draw parameters from the posterior of a finished run, in natural units.",
        ),
        Command(
            "diagnose",
            "check whether the posterior of a run is calibrated",
            _diagnose,
            _work,
            "Check whether the posteriors of a run's method are calibrated, and whether the run's posterior fits its "
            "observation.",
            help_texts.DIAGNOSE_EXAMPLES,
        ),
        Command(
            "report",
            "draw the figures of a run",
            _report,
            _work,
            "Draw all figures of a run, comparison or grid from its saved files.",
        ),
    ]


def _tasks(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "name", nargs="?", metavar="TASK", help="the task to describe: parameters, units, supports, truth"
    )


def _infer(command: argparse.ArgumentParser, families: Families) -> None:
    add = command.add_argument
    _add_support(add)
    add(
        "--support-low",
        nargs="+",
        type=float,
        metavar="X",
        help="lower bounds of your own support, one per parameter, in natural units",
    )
    add("--support-high", nargs="+", type=float, metavar="X", help="upper bounds of that support")
    add(
        "--polish",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="refine the posterior without further learning, or do not (default: refine it if the task can; MuJoCo "
        "models can, by least squares and the likelihood of simulations)",
    )
    add(
        "--simulations",
        type=Path,
        metavar="FILE",
        help="an .npz of existing simulations that replace those of the first round: theta [N, D] in natural units, "
        "trajectory [N, ...] or summaries x [N, S], and, if they were not drawn uniformly, log_density [N]",
    )
    _add_heuristic(add, "heuristic that adapts the support", families)
    _add_json(command)
    _add_shared(command, families, seeds=1)


def _compare(command: argparse.ArgumentParser, families: Families) -> None:
    command.add_argument(
        "--configurations",
        nargs="+",
        metavar="SUPPORT[+HEURISTIC]",
        help="configurations to compare (default: ok, misspecified, broad, and misspecified with edge, mode, centre)",
    )
    _add_json(command)
    _add_shared(command, families, seeds=4)


def _grid(command: argparse.ArgumentParser, families: Families) -> None:
    add = command.add_argument
    add(
        "--vary",
        nargs="+",
        action="extend",
        required=True,
        metavar="NAME=V,V,...",
        help="a hyperparameter and its values, as in expansion=0.1,0.2,0.4; may be repeated",
    )
    _add_support(add)
    _add_heuristic(add, "heuristic whose hyperparameters vary", families)
    add(
        "--runs-per-chunk",
        type=int,
        metavar="N",
        help="number of runs computed and saved together (default: as many as fit in memory)",
    )
    _add_shared(command, families, seeds=4, networks=False)


def _resume(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("folder", type=Path, metavar="DIR", help="the folder of the interrupted or finished command")
    more = command.add_mutually_exclusive_group()
    more.add_argument(
        "--rounds",
        type=int,
        metavar="N",
        help="total number of rounds, also for a finished run (default: the original number)",
    )
    more.add_argument(
        "--simulations",
        type=int,
        metavar="N",
        help="total number of valid simulations, also for a finished run: makes as many rounds as that takes",
    )
    _add_executor(command)
    multi_process.add_flags(command)
    _add_json(command)
    _add_machine(command)


def _sample(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("folder", type=Path, metavar="DIR", help="the folder of one run (of one seed)")
    add("-n", "--number", type=int, default=1000, metavar="N", help="number of draws (default: 1000)")
    add("--seed", type=flags.seed, default=0, metavar="N", help="seed of the draws (default: 0)")
    add(
        "--out",
        type=flags.output,
        metavar="FILE",
        help="a new .csv or .npz file, .nc for ArviZ's InferenceData, or - for CSV on standard output (default: "
        "samples.csv in the folder)",
    )


def _diagnose(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("folder", type=Path, metavar="DIR", help="the folder of one finished run (of one seed)")
    add(
        "--reference",
        metavar="NAME[,NAME]",
        help="where truths are drawn: posterior, the name of a support, or one of each (default: posterior, and the "
        "task's first support)",
    )
    add("--truths", type=int, default=100, metavar="N", help="number of truths at each reference (default: 100)")
    add(
        "--draws", type=int, default=200, metavar="L", help="number of draws from each truth's posterior (default: 200)"
    )
    add("--seed", type=int, default=0, metavar="S", help="seed of all random numbers (default: 0)")
    add(
        "--task",
        metavar="TASK",
        help="the task, for a run that was made in Python (default: the task recorded with the run)",
    )
    add(
        "--against",
        type=Path,
        metavar="FILE",
        help="samples to compare the run's posterior with, in natural units: a .csv with the parameters' names as "
        'headings, or an .npz with an array "theta"',
    )
    add(
        "--out",
        type=flags.output,
        metavar="DIR",
        help="a new folder for the results (default: diagnostics in the run's folder)",
    )
    _add_executor(command)
    _add_machine(command)


def _report(command: argparse.ArgumentParser) -> None:
    command.add_argument("folder", type=Path, metavar="DIR", help="a folder that infer, compare or grid wrote")


def foreign_command(name: str) -> Callable[[list[str]], int] | None:
    """The command of that name that an installed package adds.

    Raises:
        ValueError: if several packages add it, or it cannot be imported.
    """
    packages = [package_of(point) for point in COMMANDS.points().get(name, ())]
    if packages and name in OWN_COMMANDS:
        COMMANDS.refuse_clash(name, ["jaxlfi", *packages])
    return COMMANDS.find(name) if packages else None


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Parse the arguments.

    Classes of other packages are imported if they are named and there are flags that nothing else knows.

    Raises:
        ValueError: if that fails.
    """
    families = Families()
    if {"-h", "--help"} & set(words):
        with contextlib.suppress(ValueError):  # show help whatever is wrong with a package
            families += _imported(_foreign(_named_by(words)))
    arguments, unknown = parser(families).parse_known_args(words)
    if not unknown:
        return arguments
    if not any((foreign := _foreign(arguments)).values()):
        return parser(families).parse_args(words)
    prepare_jax(arguments)
    return parser(families + _imported(foreign)).parse_args(words, argparse.Namespace(joined=arguments.joined))


def _named_by(words: Sequence[str]) -> argparse.Namespace:
    """The classes that words name, whether or not they are the arguments of a command."""
    finder = OneLineParser(add_help=False)
    finder.add_argument("--heuristic", nargs="?")
    finder.add_argument("--estimator", nargs="?")
    finder.add_argument("--configurations", nargs="*")
    return finder.parse_known_args([word for word in words if word not in ("-h", "--help")])[0]


def _registered(what: str, families: flags.Families, default: str) -> str:
    names = ", ".join(name for name in families if ":" not in name)
    return f"{what}: {names}, or your own as module:Class (default: {default})"


def _add_support(add: Callable[..., Any]) -> None:
    add("--support", metavar="NAME", help="name of the initial support (default: the task's first)")


def _add_heuristic(add: Callable[..., Any], what: str, families: Families) -> None:
    add("--heuristic", default="edge", metavar="NAME", help=_registered(what, families.rules, "edge"))


def _add_shared(command: argparse.ArgumentParser, families: Families, seeds: int, networks: bool = True) -> None:
    """Add the arguments that `infer`, `compare` and `grid` have in common; `grid` saves no networks."""
    add = command.add_argument
    add("task", metavar="TASK", help="a task's name (see jaxlfi tasks), or module:factory; NAME,key=value sets options")
    add(
        "--object",
        nargs="+",
        action="extend",
        metavar="NAME",
        help="the observed object or recording, for tasks that have several (short for TASK,object=NAME); several "
        "names or files are recordings of one object, each with its own actions, and are combined into one posterior",
    )
    add("--out", type=flags.output, required=True, metavar="DIR", help="a new or empty folder for the results")
    add(
        "--method",
        choices=METHODS,
        default="bayessim",
        help="inference method: bayessim; tsnpe (sequential flows, proposals from a truncated prior); apt (sequential "
        "flows with the atomic loss, SNPE-C); npe (flows, one round); snle (sequential neural likelihood) (default: "
        "bayessim)",
    )
    add("--preset", choices=PRESETS, default="quick", help="the settings to start from (default: quick)")
    add("--seeds", type=int, default=seeds, metavar="N", help=f"number of runs (default: {seeds})")
    add("--first-seed", type=int, default=0, metavar="N", help="the first run's seed (default: 0)")
    add(
        "--observation",
        type=Path,
        nargs="+",
        metavar="FILE",
        help="the observed trajectory, .csv (one row per record, one column per channel) or .npz; several files are "
        "independent trials of the same parameters and are combined into one posterior "
        "(default: the task's own, or one simulated at the known truth)",
    )
    _add_machine(command)
    multi_process.add_flags(command)
    if networks:
        _add_executor(command)
        add("--keep-network", action="store_true", help="also save the trained networks (network.npz)")

    rounds = command.add_argument_group(
        "rounds (default: the preset's, shown for bayessim; a task or method may have its own)"
    )
    flags.add(rounds, {"run": FIELDS[SETTINGS]}, into="settings", presets=VALUES)
    network = command.add_argument_group(
        "network and training (default: the preset's, shown for bayessim; a task or method may have its own)"
    )
    network.add_argument(
        "--estimator", metavar="NAME", help=_registered("the density estimator", families.networks, "the method's")
    )
    flags.add(network, families.networks, into="settings", presets=VALUES)
    hyper = command.add_argument_group("heuristics (one number, or one per parameter)")
    flags.add(hyper, families.rules, into="hyperparameters", several=True)
    command.set_defaults(settings={}, hyperparameters={})


def _add_json(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--json",
        action="store_true",
        help="print the summary as JSON to stdout, and everything else to stderr; for several runs, an object that "
        "maps folders to summaries",
    )


def _add_machine(command: argparse.ArgumentParser) -> None:
    """Add the arguments for how a command runs, not what it computes."""
    add = command.add_argument
    add("--no-figures", action="store_true", help="do not draw figures")
    add("--quiet", action="store_true", help="print results and warnings only")
    add("--debug", action="store_true", help="show the traceback of an error")
    add("--no-cache", action="store_true", help="do not use the cache of compiled programs")


def _add_executor(command: argparse.ArgumentParser) -> None:
    """Add the arguments for where a host simulator runs."""
    where = command.add_argument_group("simulators outside JAX")
    where.add_argument("--workers", type=int, metavar="N", help="number of local worker processes")
    where.add_argument(
        "--scheduler", metavar="ADDRESS", help="address of a Dask scheduler whose cluster runs the simulations"
    )
    where.add_argument(
        "--simulation-timeout",
        type=float,
        metavar="SECONDS",
        help="time limit of one simulation (default: none; for resume, the run's own)",
    )


def prepare_jax(arguments: argparse.Namespace) -> None:
    """Set what must be set before jax starts, and join the other processes of the command (`arguments.joined`).

    On a CPU, jax sees one device, which runs of small networks do not fill: with as many devices as cores, each takes
    its part of a batch. A single run stays on one device, whose matrix products then use all cores.

    Raises:
        ValueError: if the other processes cannot be joined.
    """
    from jaxlfi.io import compile_cache, host_devices

    if hasattr(arguments, "joined"):  # already started, for a class of another package
        return
    if getattr(arguments, "no_cache", True):
        os.environ[compile_cache.SWITCH] = "0"
    else:
        compile_cache.enable()
    arguments.joined = multi_process.join(arguments)
    runs, processes = _runs(arguments), arguments.joined.count
    if runs > 1:
        # The same batch on the same number of devices repeats bit for bit.
        devices = _recorded(arguments).get("devices")
        if not isinstance(devices, int) or not 1 <= devices <= MAX_DEVICES:
            devices = min(host_devices.processors() * processes, runs)
        host_devices.divide(math.ceil(devices / processes))


MAX_DEVICES = 1024
"""Largest number of devices that is accepted from a folder's record, which may be damaged."""
TYPICAL_CONFIGURATIONS = 6
"""Number of configurations of a comparison that names none: three supports, and one of them with three heuristics."""


def _runs(arguments: argparse.Namespace) -> int:
    """The number of runs of a command, as far as its arguments show."""
    if arguments.command == "resume":
        recorded = _recorded(arguments)
        if "trainings" in recorded:
            return 1  # policies fill all cores as one device
        runs = recorded.get("runs")
        return len(runs) if isinstance(runs, list) else 2  # a grid does not list its runs
    if arguments.command == "compare":
        return arguments.seeds * (len(arguments.configurations) if arguments.configurations else TYPICAL_CONFIGURATIONS)
    if arguments.command == "grid":
        return arguments.seeds * math.prod(axis.count(",") + 1 for axis in arguments.vary)
    if arguments.command == "diagnose":
        return arguments.truths
    return getattr(arguments, "seeds", 1)


def _recorded(arguments: argparse.Namespace) -> dict:
    """The record of the work to be continued, if there is any; its soundness is checked later."""
    if arguments.command == "resume":
        return recorded(arguments.folder)
    if arguments.command == "diagnose":
        return recorded(arguments.out or arguments.folder / "diagnostics", PLAN)
    return {}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: the words; by default those of this process, which is then ended if it is interrupted.

    Returns:
        0; 2 for bad input; 130 if it was interrupted.
    """
    if argv is None:
        return interrupts.watched(lambda: main(sys.argv[1:]))
    with warnings_in_lines():
        return _run(list(argv))


def _run(words: list[str]) -> int:
    try:
        foreign = foreign_command(words[0]) if words else None
    except ValueError as error:
        return refuse("jaxlfi", error)
    if foreign:
        with interrupts.orderly(not getattr(foreign, "run", foreign).__module__.startswith("jaxlfi.")):
            return foreign(words[1:])
    if multi_process.asked(words):
        return multi_process.work(lambda: _main(words), lambda: _advice(words), "jaxlfi", "--debug" in words)
    return _main(words)


def _main(words: Sequence[str]) -> int:
    """Do what the words ask for; returns the exit status."""
    begun: list[Path] = []
    again = "; the same command goes on from here" if words[:1] == ["diagnose"] else ""
    with interrupts.advising("jaxlfi", lambda: resuming(begun[0]) if begun else again):
        try:
            try:
                arguments = parse(words)
            except ValueError as error:
                return refuse("jaxlfi", error)
            arguments.begun = begun
            return _work(arguments)
        except KeyboardInterrupt:
            return interrupts.report()


def _work(arguments: argparse.Namespace) -> int:
    """Do what arguments ask for, and add the folder that can be resumed to `arguments.begun`."""
    debug = getattr(arguments, "debug", False)
    try:
        if arguments.command in ("infer", "compare", "grid"):
            arguments.task = _reference(arguments)
            _refuse_early(arguments)
        prepare_jax(arguments)
    except ValueError as error:
        return refuse("jaxlfi", error, debug)
    from jaxlfi.cli import commands, tables

    quiet, json = getattr(arguments, "quiet", False), getattr(arguments, "json", False)
    output = tables.Output.of(quiet, json, silent=not arguments.joined.writes)
    with contextlib.ExitStack() as closing:
        arguments.closing = closing
        try:
            prepared = commands.COMMANDS[arguments.command](arguments, output)
        except (ValueError, OSError) as error:
            if interrupts.is_unread(error):
                raise
            return refuse("jaxlfi", error, debug)
        if prepared is not None:
            arguments.begun.append(prepared[0])
            try:
                commands.run(*prepared, arguments, output)
            except commands.EXPECTED as error:
                if interrupts.is_unread(error):
                    raise
                return refuse("jaxlfi", error, debug, commands.advice(error, prepared))
        arguments.joined.leave()
    return 0


def _refuse_early(arguments: argparse.Namespace) -> None:
    """Refuse errors that can be found before jax starts, which takes seconds; all is checked again later.

    Raises:
        ValueError: for an unknown task, or a folder that is not empty.
    """
    from jaxlfi.io import workfolder  # loads NumPy, which help does not need

    TASKS.require(references.parse(arguments.task, TASKS.word)[0])
    if not multi_process.wanted(arguments):  # another process may have created files in it
        workfolder.refuse_occupied(arguments.out)


def _reference(arguments: argparse.Namespace) -> str:
    """The task's reference, with the options that other arguments request."""
    reference = arguments.task
    if arguments.object is not None:
        reference = references.with_option(reference, "object", *arguments.object)
    options = references.parse(reference)[1]
    if len(arguments.observation or ()) > 1 and "trials" not in options:
        reference = references.with_option(reference, "trials", str(len(arguments.observation)))
        if arguments.settings.get("embedding") == "trials" and "pooling" not in options:
            reference = references.with_option(reference, "pooling", "all")
    return reference


def _advice(words: Sequence[str]) -> str:
    """What to do if one of several processes was lost."""
    arguments, _ = parser().parse_known_args(words)
    folder = arguments.folder if arguments.command == "resume" else arguments.out
    return resuming(folder) if (folder / "config.json").exists() else ""
