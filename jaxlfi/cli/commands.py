"""The work of the command line's commands; `jaxlfi.cli.parser` parses their arguments."""

import argparse
import dataclasses
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxlfi.bayessim.batch import RunSpec
from jaxlfi.bayessim.keys import key_of
from jaxlfi.bayessim.presets import all_rounds
from jaxlfi.bayessim.settings import Settings
from jaxlfi.cli import choices, interrupts, summaries, tables, train
from jaxlfi.cli.exit_status import removed_if, resuming
from jaxlfi.cli.tables import Output
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.truncated_mixture import log_mass
from jaxlfi.distributions.truncation import TRIES
from jaxlfi.io import files as atomic
from jaxlfi.io import host_devices, run_summary, text_table, workfolder
from jaxlfi.io.formats import COMPARE, GRID, RUN, RUNS, TRAINING
from jaxlfi.io.locks import locked
from jaxlfi.io.progress import RoundProgress
from jaxlfi.io.run_summary import RunSummary
from jaxlfi.io.shell import quoted
from jaxlfi.io.workfolder import StoreError
from jaxlfi.registry import TASKS
from jaxlfi.runs import execute as executing
from jaxlfi.runs import export
from jaxlfi.runs import folder as folders
from jaxlfi.runs.checkpoint import CheckpointError
from jaxlfi.runs.execute import BatchPlan, Observed
from jaxlfi.runs.load import load
from jaxlfi.runs.polishing import polished
from jaxlfi.studies import calibration, grid
from jaxlfi.studies.calibration.widths import sentence
from jaxlfi.studies.grid import Work
from jaxlfi.tasks import priors
from jaxlfi.tasks.errors import ExecutorError, SimulatorError
from jaxlfi.tasks.observation import with_gaps_of
from jaxlfi.tasks.presimulated import presimulated, read_simulations
from jaxlfi.tasks.task import Task

Prepared = tuple[Path, tuple[BatchPlan, Observed] | Work]
SUMMARISED = (RUN, RUNS, COMPARE)
"""Formats of the folders whose runs have summaries, for `--json`."""
REPORTED = (*SUMMARISED, GRID)
"""Formats of the folders that `report` draws."""
EXPECTED = (SimulatorError, CheckpointError, StoreError, OSError)
"""Errors caused by the input of a run or by the disk, which are reported in one line."""
LOW_MASS = 0.01
"""Mass of the posterior inside its support below which `jaxlfi sample` warns."""
DIAGNOSTICS = "diagnostics"
"""Default folder of the diagnostics within that of their run, where a run's page looks for them."""


def tasks(arguments: argparse.Namespace, output: Output) -> None:
    """`jaxlfi tasks [NAME]`."""
    if arguments.name:
        _describe_task(TASKS.load(arguments.name), output.results)
        return
    table = Table("task", "parameters", "supports", "observation")
    for name in TASKS.names():
        try:
            if wanted := TASKS.wanted(name):
                table.add_row(escape(name), "", "", escape(f"give it as {wanted}"))
                continue
            task = TASKS.load(name)
        except ValueError as error:  # one broken package must not hide the others
            table.add_row(escape(name), "", "", escape(str(error).splitlines()[0]))
            continue
        given = "given" if task.observation is not None else "simulated at the truth" if task.truth is not None else "-"
        table.add_row(*map(escape, (name, ", ".join(task.names), ", ".join(task.supports), given)))
    tables.show(table, output.results)
    output.results.print("Details: jaxlfi tasks NAME. Your own: module:factory in place of a name.")


def _describe_task(task: Task, console: Console) -> None:
    columns = ["parameter", "unit", *task.supports, "Phi"]
    if task.truth is not None:
        columns.append("truth")
    table = Table(*map(escape, columns), title=escape(task.name))
    for d, name in enumerate(task.names):
        boxes = [f"[{float(box.low[d]):g}, {float(box.high[d]):g}]" for box in (*task.supports.values(), task.feasible)]
        truth = [f"{float(task.truth[d]):.4g}"] if task.truth is not None else []
        table.add_row(*map(escape, (name, task.units[d], *boxes, *truth)))
    tables.show(table, console)
    logs = f" Inferred as logarithms: {', '.join(task.log)}." if task.log else ""
    console.print(escape(f"Supports, Phi and truth in natural units; the first support is the default.{logs}"))


def infer(arguments: argparse.Namespace, output: Output) -> Prepared:
    """Prepare `jaxlfi infer`."""
    task = choices.task_of(arguments)
    settings = choices.build_settings(arguments, task)
    first = None
    if arguments.simulations is None:
        support_name, support = choices.support_of(arguments, task)
    else:
        own = arguments.support is not None or arguments.support_low is not None or arguments.support_high is not None
        support_name, support = choices.support_of(arguments, task) if own else ("own", None)
        first, support = presimulated(task, read_simulations(arguments.simulations), support)
    kinds = choices.heuristics_of(arguments, [arguments.heuristic])
    rule = choices.build_heuristic(arguments, arguments.heuristic, kinds, settings, task)
    configuration = support_name if arguments.heuristic == "none" else f"{support_name}+{arguments.heuristic}"
    specs = tuple(RunSpec(configuration, support_name, support, rule, seed) for seed in choices.seeds_of(arguments))
    return _begun(arguments, RUN if len(specs) == 1 else RUNS, task, settings, specs, output, first)


def compare(arguments: argparse.Namespace, output: Output) -> Prepared:
    """Prepare `jaxlfi compare`."""
    task = choices.task_of(arguments)
    settings = choices.build_settings(arguments, task, all_rounds)
    configurations = arguments.configurations or choices.default_configurations(task)
    if len(set(configurations)) < len(configurations):
        raise ValueError(f"configurations: expected distinct ones, got {configurations}")
    parts = [choices.configuration_parts(name) for name in configurations]
    kinds = choices.heuristics_of(arguments, [heuristic for _, heuristic in parts])
    build = lambda heuristic: choices.build_heuristic(arguments, heuristic, kinds, settings, task)
    # Seeds are the slow index, so that every device gets all configurations, fast and slow ones.
    specs = tuple(
        RunSpec(name, support, task.support(support), build(heuristic), seed)
        for seed in choices.seeds_of(arguments)
        for name, (support, heuristic) in zip(configurations, parts, strict=True)
    )
    return _begun(arguments, COMPARE, task, settings, specs, output)


def _begun(
    arguments: argparse.Namespace, kind: str, task: Task, settings: Settings, specs: tuple, output: Output, first=None
) -> Prepared:
    """The folder and the work of runs, after everything was checked."""
    processes = arguments.joined
    if processes.writes:
        workfolder.refuse_occupied(arguments.out)
    observation = choices.observation_of(arguments, task, lambda line: _say(output.notes, line))
    task = with_gaps_of(task, observation, settings.estimator.embedding != "none")
    polish = False if kind == COMPARE else arguments.polish  # heuristics are compared by their own posteriors
    if polish is None:
        polish = executing.polishable(task, settings)
    plan = BatchPlan(kind, arguments.task, task, arguments.preset, settings, specs, arguments.keep_network, polish)
    observed = executing.prepare(plan, observation, first, processes)
    for name, box in {spec.support_name: spec.support for spec in plan.specs}.items():
        if (mass := priors.require_mass(plan.task.inference.prior, box, name)) < priors.LOW_INSIDE:
            missed = (1 - mass) ** TRIES
            _warn(
                output,
                f"only {mass:.2g} of the prior lies in {name}: {missed:.0%} of its draws are approximate, picked from "
                "uniform ones by the prior's density",
            )
    if processes.writes:
        executing.begin(arguments.out, plan, observed, processes)
        _hold(arguments, arguments.out)
    return arguments.out, (plan, observed)


def _hold(arguments: argparse.Namespace, folder: Path) -> None:
    """Lock a folder against other commands' processes until the command ends."""
    if arguments.joined.writes:
        arguments.closing.enter_context(locked(folder))


def grid_command(arguments: argparse.Namespace, output: Output) -> Prepared:
    """Prepare `jaxlfi grid`."""
    task = TASKS.load(arguments.task)
    settings = choices.build_settings(arguments, task, all_rounds)
    axes = grid.parse_axes(arguments.vary)
    kinds = choices.heuristics_of(arguments, [arguments.heuristic])
    for axis in axes:
        if axis.name in arguments.hyperparameters:
            raise ValueError(f"{axis.name}: expected it on an axis or as a flag of its own, got both")
    name = arguments.support or next(iter(task.supports))
    plan = grid.Grid(
        task=task,
        support=task.support(name),
        rule=choices.build_heuristic(arguments, arguments.heuristic, kinds, settings, task),
        axes=axes,
        seeds=tuple(choices.seeds_of(arguments)),
        settings=settings,
        reference=arguments.task,
        preset=arguments.preset,
        support_name=name,
    )
    observation = choices.observation_of(arguments, task, lambda line: _say(output.notes, line))
    if arguments.joined.writes:
        workfolder.refuse_occupied(arguments.out)
    _say(output.notes, f"{task.name}: compiling for {plan.size} runs")
    work = grid.begin(arguments.out, plan, observation, arguments.runs_per_chunk, arguments.joined)
    _hold(arguments, arguments.out)
    return arguments.out, work


def resume(arguments: argparse.Namespace, output: Output) -> Prepared | None:
    """Prepare `jaxlfi resume`; nothing is left to do if the run is complete."""
    folder = arguments.folder
    if folder.is_dir():
        _hold(arguments, folder)
    config = workfolder.read(folder, *REPORTED, TRAINING)
    if arguments.json and config["format"] not in SUMMARISED:
        raise ValueError(f"json: expected a folder of infer or compare, which has summaries, got {folder}")
    more = "rounds" if arguments.rounds is not None else "simulations" if arguments.simulations is not None else None
    if more is not None and config["format"] != RUN:
        raise ValueError(f"{more}: expected the folder of one run (of one seed), got {folder}")
    if config["format"] == TRAINING:
        train.resume(folder, output, not arguments.no_figures, arguments.joined)
        return None
    if more is not None:
        if arguments.joined.count > 1:
            raise ValueError(f"{more}: expected one process, got several")
        executing.extend(folder, arguments.rounds, arguments.simulations)
        config = workfolder.read(folder, RUN)
    if config.get("status") == "finished" or ("status" not in config and (folder / "posterior.npz").exists()):
        if arguments.joined.writes:
            executing.clean(folder)
        _say(
            output.notes, f"{folder} is complete: nothing to resume. Its pictures: {quoted('jaxlfi', 'report', folder)}"
        )
        if arguments.json and arguments.joined.writes:
            _print_json(folder, config)
        return None
    if config["format"] == GRID:
        work, what = grid.reopen(folder), "results differ by rounding"
    else:
        plan, observed = executing.reopen(folder)
        if config.get("executor", False) and (arguments.workers, arguments.scheduler) == (None, None):
            arguments.workers = host_devices.processors()
            _say(output.notes, f"simulations: in {arguments.workers} processes on this machine")
        work = dataclasses.replace(plan, task=choices.simulated_again(arguments, folder, plan.task)), observed
        what = "the result may differ in rounding from an uninterrupted one"
    if changed := executing.changed_machine(config, arguments.joined):
        _warn(output, f"begun with {', '.join(changed)}: {what}")
    return folder, work


def report(arguments: argparse.Namespace, output: Output) -> None:
    """`jaxlfi report`."""
    workfolder.read(arguments.folder, *REPORTED)
    draw(arguments.folder, output.notes)


def sample(arguments: argparse.Namespace, output: Output) -> None:
    """`jaxlfi sample DIR`."""
    out = arguments.out or arguments.folder / "samples.csv"
    printed = str(out) == "-"
    if printed:
        output = Output.of(quiet=True)  # warnings on standard error
    elif out.suffix not in (".csv", ".npz", ".nc"):
        raise ValueError(f"out: expected a name that ends in .csv or .npz, or .nc for ArviZ, or -, got {out}")
    elif out.exists() or out.is_symlink():
        raise ValueError(f"out: expected a new file, got {out}, which exists")
    posterior = load(arguments.folder).posterior
    if out.suffix == ".nc":
        export.write_netcdf(out, arguments.folder, arguments.number, arguments.seed)
    else:
        draws = np.asarray(posterior.sample(key_of(arguments.seed), arguments.number))
        names = posterior.space.names
        if out.suffix == ".npz":
            atomic.write_arrays(out, {"theta": draws, "names": np.asarray(names)})
        else:
            text = text_table.as_csv(names, ([f"{value:.8g}" for value in row] for row in draws))
            if printed:
                sys.stdout.write(text)
            else:
                atomic.write_bytes(out, text.encode())
    _say(output.notes, f"samples: {out}")
    # The mass of the mixture as fitted: the density may continue beyond a bound that cut it off, which says nothing.
    own = isinstance(posterior.density, GaussianMixture)
    inside = float(np.exp(log_mass(posterior.mixture, posterior.support)) if own else posterior.mass_inside)
    if inside < LOW_MASS:
        _warn(output, f"only {inside:.2g} of the posterior lies in the support it was truncated to; it may be wrong.")


def diagnose(arguments: argparse.Namespace, output: Output) -> None:
    """`jaxlfi diagnose DIR`."""
    task = None if arguments.task is None else TASKS.load(arguments.task)
    run = calibration.read_run(arguments.folder, task)
    run = run.replace(task=choices.simulated_again(arguments, arguments.folder, run.task))
    references = arguments.reference
    if references is None:
        references = f"{calibration.POSTERIOR},{next(iter(run.task.supports))}"
    plans = calibration.plans_of(references, run.task, arguments.truths, arguments.draws, arguments.seed)
    reference = None
    if arguments.against is not None:
        reference = arguments.against.name, calibration.read_reference(arguments.against, run.task)
    out = arguments.out or arguments.folder / DIAGNOSTICS
    with interrupts.orderly(run.task.on_host):
        found = calibration.diagnose(out, run, plans, output.notes, reference)
    for widths in found.widths:
        _say(output.results, f"{widths.heading}:")
        for name, one in widths.rows:
            _say(output.results, f"  {sentence(name, one)}")
    tables.show(summaries.checks_table(found.checks), output.results)
    _say(output.notes, f"diagnostics: {out}")
    if arguments.no_figures:
        return
    for path in _figures().checks.report(out):
        _name(output.notes, path)
    if out == arguments.folder / DIAGNOSTICS and (arguments.folder / "report.html").exists():
        _figures().report(arguments.folder)  # it says how far widths can be trusted, which is now known
        _say(output.notes, f"page of the run, again: {arguments.folder / 'report.html'}")


def run(folder: Path, work: tuple[BatchPlan, Observed] | Work, arguments: argparse.Namespace, output: Output) -> None:
    """Run what `infer`, `compare`, `grid` or `resume` prepared, and print the results."""
    if isinstance(work, Work):
        _run_grid(folder, work, arguments, output)
        return
    plan, observed = work
    processes, count = arguments.joined, len(plan.specs)
    label = f"{plan.task.name}: {count} {'run' if count == 1 else 'runs in a batch'}"
    done = executing.rounds_done(folder) if processes.writes else 0
    made_here = processes.writes and arguments.command != "resume"
    removing = removed_if(folder, lambda: made_here and not executing.rounds_done(folder))
    progress = RoundProgress(output.notes, plan.settings.rounds, done, label)
    with removing, interrupts.orderly(plan.task.on_host), progress:
        on_round = lambda index, row: progress.advance()
        runs = executing.execute(plan, observed, folder, on_round, progress.compiled, progress.simulated, processes)
    if not processes.writes:
        return
    if plan.polish:
        runs = [polished(run, output.notes) for run in runs]
    executing.finish(folder, plan, runs)
    if arguments.json:
        _print_json(folder, folders.read_config(folder))
    if plan.kind == RUN:
        found = RunSummary.read(folder).at(folder)
        tables.show(summaries.parameter_table(found), output.results)
        for line in (*found.sentences, *found.steps()):
            _say(output.results, line)
    if plan.kind != RUN or plan.task.truth is not None:
        tables.show(summaries.summary_table(plan, runs), output.results)
    for warning in summaries.warnings(plan, runs):
        _warn(output, warning)
    several = () if plan.kind == RUN else (*summaries.failure_lines(runs), *summaries.rounds_lines(plan, runs))
    for line in (*several, *summaries.widths_lines(plan, runs)):  # a single run's summary contains them
        _say(output.results, line)
    kind = "table" if plan.kind == COMPARE else "results"
    _say(output.notes, f"{kind}: {folder / 'table.csv' if kind == 'table' else folder}")
    if not arguments.no_figures:
        draw(folder, output.notes)


def _print_json(folder: Path, config: Mapping[str, Any]) -> None:
    """Print the summary of a finished run; for several runs, an object of summaries by the runs' folders.

    Raises:
        StoreError: if there is none, as in folders of earlier versions.
    """

    def summary(one: Path) -> Any:
        if not (path := one / run_summary.NAME).exists():
            raise StoreError(f"json: expected a run with {path}, got one of an earlier version")
        return atomic.read_json(path)

    several = {run["folder"]: folder / run["folder"] for run in config.get("runs", ()) if run["folder"] != "."}
    found = {name: summary(one) for name, one in several.items()} if several else summary(folder)
    print(json.dumps(found, indent=2))


def advice(error: Exception, prepared: Prepared) -> str:
    """What to do about an error of a run, for the end of its line."""
    from_outside = isinstance(error, ExecutorError | OSError)  # a lost cluster, a full disk
    return resuming(prepared[0]) if from_outside and prepared[0].exists() else ""


def _run_grid(folder: Path, work: Work, arguments: argparse.Namespace, output: Output) -> None:
    made_here = arguments.joined.writes and arguments.command != "resume"
    with removed_if(folder, lambda: made_here and not (folder / "chunks").exists()):
        arrays = grid.advance(folder, work, output.notes, arguments.joined)
    if not arguments.joined.writes:
        return
    tables.show(summaries.marginal_table(work.grid, arrays), output.results)
    _say(output.notes, f"table: {folder / 'table.csv'}")
    if not arguments.no_figures:
        draw(folder, output.notes)


def draw(folder: Path, console: Console) -> None:
    """Draw all figures of a folder from its saved files, and print their paths and that of the page that shows them."""
    for path in _figures().report(folder):
        _name(console, path)


def _name(console: Console, path: Path) -> None:
    """Print the path of a page or a figure that was drawn."""
    _say(console, f"{'page' if path.suffix == '.html' else 'figure'}: {path}")


def _figures():
    """The package of figures, imported only here, as only pictures need matplotlib."""
    try:
        import jaxlfi.figures.checks
    except ImportError as error:
        raise StoreError(f"pictures: expected matplotlib to be installed, got: {error}") from error
    return jaxlfi.figures


def _say(console: Console, text: str) -> None:
    """Print a line as it is: names of folders and tasks are not markup."""
    console.print(escape(text), soft_wrap=True, highlight=False)


def _warn(output: Output, text: str) -> None:
    output.warnings.print(escape(f"warning: {text}"), style="yellow", soft_wrap=True, highlight=False)


COMMANDS = {
    "tasks": tasks,
    "infer": infer,
    "compare": compare,
    "grid": grid_command,
    "resume": resume,
    "sample": sample,
    "diagnose": diagnose,
    "report": report,
}
"""The function of each command, by its name."""
