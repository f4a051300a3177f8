"""What the command line's commands do; `jaxlfi.cli.parser` parses, this module works."""

import argparse
import csv
import dataclasses
import io
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaxlfi import diagnostics
from jaxlfi.bayessim.batch import RunSpec
from jaxlfi.bayessim.convergence import LAG
from jaxlfi.bayessim.keys import key_of
from jaxlfi.bayessim.presets import METHODS, PRESETS, all_rounds
from jaxlfi.bayessim.settings import Settings
from jaxlfi.bayessim.widths import expected_widths
from jaxlfi.cli import train
from jaxlfi.diagnostics.bounds import bound_summary
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncation import TRIES
from jaxlfi.estimators import registry as estimators
from jaxlfi.fields import declared
from jaxlfi.heuristics import Heuristic, paired
from jaxlfi.heuristics import registry as heuristics
from jaxlfi.io import files as atomic
from jaxlfi.io.progress import RoundProgress
from jaxlfi.runs import execute as executing
from jaxlfi.runs import export
from jaxlfi.runs import folder as run_store
from jaxlfi.runs.checkpoint import CheckpointError
from jaxlfi.runs.execute import BatchPlan, Observed
from jaxlfi.runs.load import load
from jaxlfi.runs.run import Run
from jaxlfi.studies import calibration, grid
from jaxlfi.studies.calibration.widths import sentence
from jaxlfi.studies.grid import Work
from jaxlfi.tasks import priors
from jaxlfi.tasks import registry as task_lookup
from jaxlfi.tasks.host import SimulatorError
from jaxlfi.tasks.observation import read_for
from jaxlfi.tasks.presimulated import presimulated, read_simulations
from jaxlfi.tasks.task import Task

Prepared = tuple[Path, tuple[BatchPlan, Observed] | Work]
EXPECTED = (SimulatorError, CheckpointError, run_store.StoreError)
"""Errors that the input of a run causes; they are reported in one line."""
LOW_MASS = 0.01
"""Mass of the posterior inside its support below which `jaxlfi sample` warns."""
DIAGNOSTICS = "diagnostics"
"""Folder of the diagnostics in that of their run, where no other is given; a run's page looks for them there."""
BOOTSTRAP = 2000
"""Bootstrap resamples for the interval of a mean."""
CONFIGURATION_DEFAULTS = ("ok", "misspecified", "broad")
"""Supports that are compared by default, where the task has them."""


def tasks(arguments: argparse.Namespace, console: Console) -> None:
    """`jaxlfi tasks [NAME]`."""
    if arguments.name:
        _describe_task(task_lookup.load(arguments.name), console)
        return
    table = Table("task", "parameters", "supports", "observation")
    for name in task_lookup.names():
        try:
            task = task_lookup.load(name)
        except ValueError as error:  # one broken package must not hide the others
            table.add_row(escape(name), "", "", escape(str(error).splitlines()[0]))
            continue
        given = "given" if task.observation is not None else "simulated at the truth" if task.truth is not None else "-"
        table.add_row(*map(escape, (name, ", ".join(task.space.labels), ", ".join(task.supports), given)))
    console.print(table)
    console.print("Details: jaxlfi tasks NAME. Your own: module:factory in place of a name.")


def _describe_task(task: Task, console: Console) -> None:
    columns = ["parameter", "unit", *task.supports, "Phi"]
    if task.truth is not None:
        columns.append("truth")
    table = Table(*map(escape, columns), title=escape(task.name))
    for d, name in enumerate(task.names):
        boxes = [f"[{float(box.low[d]):g}, {float(box.high[d]):g}]" for box in (*task.supports.values(), task.feasible)]
        truth = [f"{float(task.truth[d]):.4g}"] if task.truth is not None else []
        table.add_row(*map(escape, (name, task.units[d], *boxes, *truth)))
    console.print(table)
    logs = f" Inferred as logarithms: {', '.join(task.log)}." if task.log else ""
    console.print(escape(f"Supports, Phi and truth in natural units; the first support is the default.{logs}"))


def infer(arguments: argparse.Namespace, console: Console) -> Prepared:
    """Prepare `jaxlfi infer`."""
    task = task_lookup.load(arguments.task)
    settings = build_settings(arguments, task)
    first = None
    if arguments.simulations is None:
        support_name, support = _support(arguments, task)
    else:
        own = arguments.support is not None or arguments.support_low is not None or arguments.support_high is not None
        support_name, support = _support(arguments, task) if own else ("own", None)
        first, support = presimulated(task, read_simulations(arguments.simulations), support)
    rule = build_heuristic(arguments, arguments.heuristic, settings, task)
    heuristics.refuse_foreign(arguments.hyperparameters, [arguments.heuristic])
    configuration = support_name if arguments.heuristic == "none" else f"{support_name}+{arguments.heuristic}"
    specs = tuple(RunSpec(configuration, support_name, support, rule, seed) for seed in _seeds(arguments))
    kind = run_store.RUN if len(specs) == 1 else run_store.RUNS
    plan = BatchPlan(kind, arguments.task, task, arguments.preset, settings, specs, arguments.keep_network)
    return _begun(arguments, plan, console, first)


def compare(arguments: argparse.Namespace, console: Console) -> Prepared:
    """Prepare `jaxlfi compare`."""
    task = task_lookup.load(arguments.task)
    settings = build_settings(arguments, task, all_rounds)
    configurations = arguments.configurations or default_configurations(task)
    if len(set(configurations)) < len(configurations):
        raise ValueError(f"configurations: expected distinct ones, got {configurations}")
    parts = [_configuration(name) for name in configurations]
    heuristics.refuse_foreign(arguments.hyperparameters, [heuristic for _, heuristic in parts])
    # Seeds are the slow index, so that every device gets all configurations, fast and slow ones.
    specs = tuple(
        RunSpec(name, support, task.support(support), build_heuristic(arguments, heuristic, settings, task), seed)
        for seed in _seeds(arguments)
        for name, (support, heuristic) in zip(configurations, parts, strict=True)
    )
    kind = run_store.COMPARE
    plan = BatchPlan(kind, arguments.task, task, arguments.preset, settings, specs, arguments.keep_network)
    return _begun(arguments, plan, console, None)


def _begun(arguments: argparse.Namespace, plan: BatchPlan, console: Console, first: Any) -> Prepared:
    """The folder of a plan, after everything was checked."""
    run_store.refuse_occupied(arguments.out)
    observed = executing.prepare(plan, _observation(arguments, plan.task), first)
    for name, box in {spec.support_name: spec.support for spec in plan.specs}.items():
        if (mass := priors.require_mass(plan.task.inference.prior, box, name)) < priors.LOW_INSIDE:
            missed = (1 - mass) ** TRIES
            _warn(
                console, f"only {mass:.2g} of the prior lies in {name}: {missed:.0%} of its draws are uniform instead"
            )
    executing.begin(arguments.out, plan, observed)
    return arguments.out, (plan, observed)


def grid_command(arguments: argparse.Namespace, console: Console) -> Prepared:
    """Prepare `jaxlfi grid`."""
    task = task_lookup.load(arguments.task)
    settings = build_settings(arguments, task, all_rounds)
    axes = grid.parse_axes(arguments.vary)
    heuristics.refuse_foreign(arguments.hyperparameters, [arguments.heuristic])
    for axis in axes:
        if axis.name in arguments.hyperparameters:
            raise ValueError(f"{axis.name}: expected it on an axis or as a flag of its own, got both")
    name = arguments.support or next(iter(task.supports))
    plan = grid.Grid(
        task=task,
        support=task.support(name),
        rule=build_heuristic(arguments, arguments.heuristic, settings, task),
        axes=axes,
        seeds=tuple(_seeds(arguments)),
        settings=settings,
        reference=arguments.task,
        preset=arguments.preset,
        support_name=name,
    )
    observation = _observation(arguments, task)
    run_store.refuse_occupied(arguments.out)
    _say(console, f"{task.name}: compiling for {plan.size} runs")
    return arguments.out, grid.begin(arguments.out, plan, observation, arguments.runs_per_chunk)


def resume(arguments: argparse.Namespace, console: Console) -> Prepared | None:
    """Prepare `jaxlfi resume`: nothing is left to do where the run is complete."""
    folder = arguments.folder
    if grid.is_grid(folder):
        return _resume_grid(folder, console)
    if train.is_training(folder):
        train.resume(folder, console, not arguments.no_figures)
        return None
    config = run_store.read_config(folder)
    if config.get("status") == "finished" or ("status" not in config and (folder / "posterior.npz").exists()):
        executing.clean(folder)
        _say(console, _COMPLETE.format(folder=folder))
        return None
    plan = executing.reopen(folder)
    if changed := executing.changed_versions(config):
        _warn(console, f"begun with {', '.join(changed)}: the result may differ in rounding from an uninterrupted one")
    return folder, plan


_COMPLETE = "{folder} is complete: nothing to resume. Its pictures: jaxlfi report {folder}"


def _resume_grid(folder: Path, console: Console) -> Prepared | None:
    config = grid.read_config(folder)
    if config.get("status") == "finished":
        _say(console, _COMPLETE.format(folder=folder))
        return None
    changed = executing.changed_versions(config)
    if config.get("devices") != (here := jax.local_device_count()):
        changed.append(f"{config.get('devices')} devices, now {here}")
    if changed:
        _warn(console, f"begun with {', '.join(changed)}: results differ by rounding")
    return folder, grid.reopen(folder)


def report(arguments: argparse.Namespace, console: Console) -> None:
    """`jaxlfi report`."""
    (grid if grid.is_grid(arguments.folder) else run_store).read_config(arguments.folder)
    draw(arguments.folder, console)


def sample(arguments: argparse.Namespace, console: Console) -> None:
    """`jaxlfi sample DIR`."""
    out = arguments.out or arguments.folder / "samples.csv"
    if out.suffix not in (".csv", ".npz", ".nc"):
        raise ValueError(f"out: expected a name that ends in .csv or .npz, or .nc for ArviZ, got {out}")
    if out.exists() or out.is_symlink():
        raise ValueError(f"out: expected a new file, got {out}, which exists")
    if not 0 <= arguments.seed < 2**63:
        raise ValueError(f"seed: expected a number from 0 to 2^63 - 1, got {arguments.seed}")
    posterior = load(arguments.folder).posterior
    if out.suffix == ".nc":
        export.write_netcdf(out, arguments.folder, arguments.number, arguments.seed)
    else:
        draws = np.asarray(posterior.sample(key_of(arguments.seed), arguments.number))
        names = posterior.space.names
        if out.suffix == ".npz":
            atomic.write_arrays(out, {"theta": draws, "names": np.asarray(names)})
        else:
            text = io.StringIO()
            writer = csv.writer(text, lineterminator="\n")
            writer.writerows([names, *([f"{value:.8g}" for value in row] for row in draws)])
            atomic.write_bytes(out, text.getvalue().encode())
    _say(console, f"samples: {out}")
    if posterior.mass_inside < LOW_MASS:
        _warn(
            console,
            f"only {float(posterior.mass_inside):.2g} of the posterior lies in the support it was truncated to; it may "
            "be wrong.",
        )


def diagnose(arguments: argparse.Namespace, console: Console) -> None:
    """`jaxlfi diagnose DIR`."""
    task = None if arguments.task is None else task_lookup.load(arguments.task)
    run = calibration.read_run(arguments.folder, task)
    asked = arguments.reference
    if asked is None:
        asked = f"{calibration.POSTERIOR},{next(iter(run.task.supports))}"
    plans = calibration.plans_of(asked, run.task, arguments.truths, arguments.draws, arguments.seed)
    reference = None
    if arguments.against is not None:
        reference = arguments.against.name, calibration.read_reference(arguments.against, run.task)
    out = arguments.out or arguments.folder / DIAGNOSTICS
    found = calibration.diagnose(out, run, plans, console, reference)
    for widths in found.widths:
        _say(console, f"{widths.heading}:")
        for name, one in widths.rows:
            _say(console, f"  {sentence(name, one)}")
    console.print(checks_table(found.checks))
    _say(console, f"diagnostics: {out}")
    if arguments.no_figures:
        return
    for path in _figures().checks.report(out):
        _say(console, f"{'page' if path.suffix == '.html' else 'picture'}: {path}")
    if out == arguments.folder / DIAGNOSTICS and (arguments.folder / "report.html").exists():
        _figures().report(arguments.folder)  # it says how far widths can be trusted, and this is known now
        _say(console, f"page of the run, again: {arguments.folder / 'report.html'}")


def checks_table(checks: Sequence[calibration.Check]) -> Table:
    """One line a check."""
    table = Table("check", "statistic", "expected", "p-value", "verdict")
    for check in checks:
        p_value = "" if np.isnan(check.p_value) else f"{check.p_value:.2g}"
        colour = {"": "", diagnostics.OK: "green"}.get(check.verdict, "red")
        cells = map(escape, (check.name, check.statistic, check.expected, p_value, check.verdict))
        table.add_row(*cells, style=colour)
    return table


def run(folder: Path, work: tuple[BatchPlan, Observed] | Work, arguments: argparse.Namespace, console: Console) -> None:
    """Run what `infer`, `compare`, `grid` or `resume` prepared, and print what came of it."""
    if isinstance(work, Work):
        _run_grid(folder, work, arguments, console)
        return
    plan, observed = work
    count = len(plan.specs)
    label = f"{plan.task.name}: {count} {'run' if count == 1 else 'runs in a batch'}"
    done = executing.rounds_done(folder)
    try:
        with RoundProgress(console, plan.settings.rounds, done, label) as progress:
            on_round = lambda index, row: progress.advance()
            runs = executing.execute(plan, observed, folder, on_round, progress.compiled)
    except Exception:
        if arguments.command != "resume" and not executing.rounds_done(folder):
            shutil.rmtree(folder)  # made by this very command, and there is nothing in it to go on from
        raise
    executing.finish(folder, plan, runs)
    console.print(summary_table(plan, runs))
    for warning in (*training_warnings(plan, runs), *support_warnings(plan, runs)):
        _warn(console, warning)
    for line in (*rounds_lines(plan, runs), *widths_lines(plan)):
        _say(console, line)
    kind = "table" if plan.kind == run_store.COMPARE else "results"
    _say(console, f"{kind}: {folder / 'table.csv' if kind == 'table' else folder}")
    if not arguments.no_figures:
        draw(folder, console)


def rounds_lines(plan: BatchPlan, runs: Sequence[Run]) -> list[str]:
    """Whether runs that may end once they have settled have done so, in a line for each configuration."""
    lines: list[str] = []
    if not 0 < plan.settings.min_rounds <= plan.settings.rounds:
        return lines
    for configuration in dict.fromkeys(spec.configuration for spec in plan.specs):
        own = [run for spec, run in zip(plan.specs, runs, strict=True) if spec.configuration == configuration]
        made = [np.count_nonzero(~np.asarray(run.history["settled"][:-1])) + 1 for run in own]
        moved = [float(run.history["moved"][-1]) for run in own if not run.history["settled"][-1]]
        extent = f"{made[0]}" if len(set(made)) == 1 else f"{min(made)} to {max(made)}"
        verdict = "the posterior has settled"
        if moved:
            verdict = (
                f"{len(moved)} of {len(own)} posteriors still moved, by up to {max(moved):.1f} of their standard "
                f"deviations over the last {LAG} rounds (--rounds allows for more)"
            )
        lines.append(f"rounds of {configuration}: {extent}; {verdict}")
    return lines


def widths_lines(plan: BatchPlan) -> list[str]:
    """How far the widths of the runs' posteriors can be trusted, in one line; several where heuristics differ in it."""
    by_line: dict[str, list[str]] = {}
    for spec in plan.specs:
        names = by_line.setdefault(expected_widths(plan.settings, spec.heuristic), [])
        names += [spec.configuration] * (spec.configuration not in names)
    several = len(by_line) > 1
    return [f"widths{' of ' + ', '.join(names) if several else ''}: {line}" for line, names in by_line.items()]


def training_warnings(plan: BatchPlan, runs: Sequence[Run]) -> list[str]:
    """In words, where the networks of some runs did not learn: gradients that were not finite."""
    warnings = []
    settings = plan.settings.estimator
    for configuration in dict.fromkeys(spec.configuration for spec in plan.specs):
        own = [run for spec, run in zip(plan.specs, runs, strict=True) if spec.configuration == configuration]
        broken = sum(bool(np.any(np.asarray(run.history["nonfinite"]) > 0)) for run in own)
        if broken:
            steps = int(np.max([np.max(run.history["nonfinite"]) for run in own]))
            warnings.append(
                f"{configuration}: up to {steps} gradient steps of a round were not finite and were left out, in "
                f"{broken} of {len(own)} runs: lower learning_rate ({settings.learning_rate:g}) or clip_norm "
                f"({settings.clip_norm:g})."
            )
    return warnings


def support_warnings(plan: BatchPlan, runs: Sequence[Run]) -> list[str]:
    """In words, where runs ended with a bound that looks wrong and that their heuristic cannot move."""
    warnings = []
    for configuration in dict.fromkeys(spec.configuration for spec in plan.specs):
        own = [run for spec, run in zip(plan.specs, runs, strict=True) if spec.configuration == configuration]
        beliefs, grows = [run.belief for run in own], own[0].heuristic.grows
        found = bound_summary(plan.task.space.labels, beliefs, own[0].feasible, grows=grows)
        warnings += [f"{configuration}: {text}" for text in found]
    return warnings


def _run_grid(folder: Path, work: Work, arguments: argparse.Namespace, console: Console) -> None:
    try:
        arrays = grid.advance(folder, work, console)
    except Exception:
        if arguments.command != "resume" and not (folder / "chunks").exists():
            shutil.rmtree(folder)  # made by this very command, and there is nothing in it to go on from
        raise
    console.print(marginal_table(work.grid, arrays))
    _say(console, f"table: {folder / 'table.csv'}")
    if not arguments.no_figures:
        draw(folder, console)


def marginal_table(study: grid.Grid, arrays: Mapping[str, np.ndarray]) -> Table:
    """One line a value of each hyperparameter, over the seeds and the other hyperparameters."""
    table = Table("hyperparameter", "value", "runs", "theta error", "traj. error", "success")
    for place, axis in enumerate(study.axes):
        for index, value in enumerate(axis.values):
            theta, trajectory, success = (
                np.ravel(np.take(arrays[name], index, axis=place))
                for name in ("theta_error", "trajectory_error", "success_rate")
            )
            table.add_row(
                axis.name,
                f"{value:g}",
                str(len(theta)),
                _mean_and_sd(theta),
                _mean_and_sd(trajectory),
                f"{np.mean(success):.0%}",
            )
    return table


def _mean_and_sd(values: np.ndarray) -> str:
    """Mean and standard deviation of the values that are known."""
    values = values[np.isfinite(values)]
    return f"{np.mean(values):.2f} ± {np.std(values, ddof=min(1, values.size - 1)):.2f}" if values.size else "-"


def draw(folder: Path, console: Console) -> None:
    """Draw all pictures of a folder from its saved files, and name them."""
    for path in _figures().report(folder):
        _say(console, f"picture: {path}")


def _figures():
    """The package of figures: matplotlib is needed for pictures only."""
    try:
        import jaxlfi.figures.checks
    except ImportError as error:
        raise run_store.StoreError(f"pictures: expected matplotlib to be installed, got: {error}") from error
    return jaxlfi.figures


def default_configurations(task: Task) -> list[str]:
    """Up to three supports kept fixed, and the misspecified one (or else the first) with every heuristic."""
    wanted = [name for name in CONFIGURATION_DEFAULTS if name in task.supports]
    supports = wanted or list(task.supports)[:3]
    adapted = "misspecified" if "misspecified" in supports else supports[0]
    return [*supports, *(f"{adapted}+{heuristic}" for heuristic in ("edge", "mode", "centre"))]


def build_settings(
    arguments: argparse.Namespace, task: Task, change: Callable[[Settings], Settings] = lambda preset: preset
) -> Settings:
    """The preset, with what the task asks for in its place, then changed, and what was given in place of all that."""
    preset = change(preset_for(task, arguments.method, arguments.preset))
    given = dict(arguments.settings)
    if "steps" in given and "epochs" not in given:
        given["epochs"] = 0
    if "epochs" in given and "steps" not in given:
        given["steps"] = 0
    if "simulation_budget" not in given and "simulations_per_round" in given:
        # The fraction of failures that a round can bear stays the preset's.
        given["simulation_budget"] = -(
            -given["simulations_per_round"] * preset.simulation_budget // preset.simulations_per_round
        )
    if arguments.estimator is not None:
        kind = estimators.load(arguments.estimator)
        preset = preset.replace(estimator=estimators.converted(preset.estimator, kind, {}))
    return with_settings(preset, given).check()


def preset_for(task: Task, method: str, preset: str) -> Settings:
    """A method at a preset, with the numbers that the task asks for in place of the preset's."""
    wanted = lambda fields: {name: value for name, value in task.settings.items() if name in declared(fields)}
    settings = PRESETS[preset]
    settings = METHODS[method](dataclasses.replace(settings, **wanted(settings)))  # it divides the rounds in its way
    return with_settings(settings, wanted(settings.estimator))


def with_settings(settings: Settings, given: Mapping[str, Any]) -> Settings:
    """Settings with those numbers replaced that are named, be they of the run or of its estimator.

    Args:
        settings: to begin with.
        given: by name.

    Raises:
        ValueError: for a name that neither has.
    """
    own = {name: value for name, value in given.items() if name in declared(settings)}
    others = {name: value for name, value in given.items() if name not in own}
    estimator = estimators.converted(settings.estimator, type(settings.estimator), others)
    return dataclasses.replace(settings, estimator=estimator, **own)


def build_heuristic(arguments: argparse.Namespace, name: str, settings: Settings, task: Task) -> Heuristic:
    """A heuristic with the hyperparameters that were given, or else those that the task asks for.

    Components that it compares are matched first where networks start anew every round.
    """
    values = {**task.hyperparameters.get(name, {}), **heuristics.own(name, arguments.hyperparameters)}
    return paired(heuristics.build(name, values, task.dim), settings.estimator.warm_start)


def _configuration(name: str) -> tuple[str, str]:
    """Support and heuristic of "support" or "support+heuristic"."""
    support, plus, heuristic = name.partition("+")
    if plus and ":" not in heuristic and heuristic not in heuristics.names():
        known = ", ".join(heuristics.names())
        raise ValueError(f"configurations: expected support+heuristic with one of {known}, got {name!r}")
    if ":" in heuristic:
        raise ValueError(f"configurations: expected a registered heuristic, which names a folder, got {name!r}")
    return support, heuristic or "none"


def _support(arguments: argparse.Namespace, task: Task) -> tuple[str, Support]:
    low, high = arguments.support_low, arguments.support_high
    if low is None and high is None:
        name = arguments.support or next(iter(task.supports))
        return name, task.support(name)
    if low is None or high is None or arguments.support is not None:
        raise ValueError("support: expected --support NAME, or --support-low and --support-high together")
    return "own", task.support(Support(low, high))


def _observation(arguments: argparse.Namespace, task: Task) -> np.ndarray | None:
    return None if arguments.observation is None else read_for(task, *arguments.observation)


def _seeds(arguments: argparse.Namespace) -> range:
    if arguments.seeds < 1 or not 0 <= arguments.first_seed < 2**31 - arguments.seeds:
        raise ValueError(
            f"seeds: expected at least 1, and first_seed at least 0, got {arguments.seeds} and {arguments.first_seed}"
        )
    return range(arguments.first_seed, arguments.first_seed + arguments.seeds)


def summary_table(plan: BatchPlan, runs: Sequence[Run]) -> Table:
    """What came out: one line a configuration, over its seeds."""
    lines = executing.results(plan, runs)
    table = Table("configuration", "seeds", "theta error [95 %]", "median", "traj. error", "success", "final support")
    for column in table.columns[:-1]:
        column.no_wrap = True
    natural = [plan.task.space.box_to_natural(run.belief.support) for run in runs]
    for configuration in dict.fromkeys(spec.configuration for spec in plan.specs):
        own = [i for i, spec in enumerate(plan.specs) if spec.configuration == configuration]
        column = lambda name, own=own: np.array([lines[i][name] for i in own])
        error = column("theta_error")
        trajectory = column("trajectory_error")
        low = np.median([np.asarray(natural[i].low) for i in own], axis=0)
        high = np.median([np.asarray(natural[i].high) for i in own], axis=0)
        table.add_row(
            escape(configuration),
            str(len(own)),
            _with_interval(error),
            "-" if np.isnan(error).any() else f"{np.median(error):.2f}",
            "-" if np.isnan(trajectory).all() else f"{np.nanmean(trajectory):.2f}",
            f"{np.mean(column('success_rate')):.0%}",
            escape(" ".join(f"[{a:.2g}, {b:.2g}]" for a, b in zip(low, high, strict=True))),
        )
    return table


def _with_interval(values: np.ndarray) -> str:
    """The mean, and its 95 % bootstrap interval over seeds where there are several."""
    if np.isnan(values).any():
        return "-"
    if len(values) == 1:
        return f"{values[0]:.2f}"
    low, high = bootstrap_interval(values)
    return f"{np.mean(values):.2f} [{low:.2f}, {high:.2f}]"


def bootstrap_interval(values: np.ndarray, level: float = 0.95) -> tuple[float, float]:
    """Percentile bootstrap interval of a mean, the same each time it is asked for."""
    rng = np.random.default_rng(0)
    means = np.mean(rng.choice(values, (BOOTSTRAP, len(values))), axis=1)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def _say(console: Console, text: str) -> None:
    """A line as it is: names of folders and tasks are no markup."""
    console.print(escape(text), soft_wrap=True, highlight=False)


def _warn(console: Console, text: str) -> None:
    console.print(escape(f"warning: {text}"), style="yellow", soft_wrap=True, highlight=False)


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
