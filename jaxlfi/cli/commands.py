"""What the command line's commands do; `jaxlfi.cli.parser` parses, this module works."""

import argparse
import dataclasses
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from jaxlfi import diagnostics
from jaxlfi.bayessim.algorithm import Settings
from jaxlfi.bayessim.batch import Lane
from jaxlfi.bayessim.presets import METHODS, PRESETS
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.estimator import Estimator
from jaxlfi.heuristics import Heuristic, paired, registry
from jaxlfi.io import files as atomic
from jaxlfi.runs import export, session
from jaxlfi.runs import folder as run_store
from jaxlfi.runs.checkpoint import CheckpointError
from jaxlfi.runs.inference import simulator_shapes
from jaxlfi.runs.load import posterior_samples
from jaxlfi.runs.session import Plan
from jaxlfi.studies import calibration as diagnosis
from jaxlfi.studies import grid as sweep
from jaxlfi.studies.grid import Work
from jaxlfi.tasks.observation import SimulatorError
from jaxlfi.tasks.registry import observation as observations
from jaxlfi.tasks.registry import registry as task_lookup
from jaxlfi.tasks.task import Task

Prepared = tuple[Path, Plan | Work]
EXPECTED = (SimulatorError, CheckpointError, run_store.StoreError)
"""Errors of a run that are the input's, and told in one line."""
LEAKAGE = 0.01
"""Share of the posterior inside its support below which draws from it are warned of."""
BOOTSTRAP = 2000
"""Resamples of an interval."""


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
            table.add_row(name, "", "", str(error).splitlines()[0])
            continue
        given = "given" if task.observation is not None else "simulated at the truth" if task.truth is not None else "-"
        table.add_row(name, ", ".join(task.coordinates), ", ".join(task.supports), given)
    console.print(table)
    console.print("Details: jaxlfi tasks NAME. Your own: module:factory in place of a name.")


def _describe_task(task: Task, console: Console) -> None:
    columns = ["parameter", "unit", *task.supports, "Phi"]
    if task.truth is not None:
        columns.append("truth")
    table = Table(*columns, title=task.name)
    for d, name in enumerate(task.coordinates):
        boxes = [f"[{float(box.low[d]):g}, {float(box.high[d]):g}]" for box in (*task.supports.values(), task.feasible)]
        truth = [f"{float(task.truth[d]):.4g}"] if task.truth is not None else []
        table.add_row(name, task.units[d], *boxes, *truth)
    console.print(table)
    console.print("Supports and Phi are boxes for the parameters as they are named here; the first is the default.")


def infer(arguments: argparse.Namespace, console: Console) -> Prepared:
    """Prepare `jaxlfi infer`."""
    task = task_lookup.load(arguments.task)
    settings = build_settings(arguments, task)
    support_name, support = _support(arguments, task)
    heuristic = build_heuristic(arguments, arguments.heuristic, settings, task)
    registry.refuse_foreign(arguments.hyperparameters, [arguments.heuristic])
    configuration = support_name if arguments.heuristic == "none" else f"{support_name}+{arguments.heuristic}"
    lanes = tuple(Lane(configuration, support_name, support, heuristic, seed) for seed in _seeds(arguments))
    kind = run_store.RUN if len(lanes) == 1 else run_store.RUNS
    plan = Plan(kind, arguments.task, task, arguments.preset, settings, lanes, arguments.keep_network)
    session.begin(arguments.out, plan, _observation(arguments, task))
    return arguments.out, plan


def compare(arguments: argparse.Namespace, console: Console) -> Prepared:
    """Prepare `jaxlfi compare`."""
    task = task_lookup.load(arguments.task)
    settings = build_settings(arguments, task)
    configurations = arguments.configurations or default_configurations(task)
    if len(set(configurations)) < len(configurations):
        raise ValueError(f"configurations: expected distinct ones, got {configurations}")
    parts = [_configuration(name) for name in configurations]
    registry.refuse_foreign(arguments.hyperparameters, [heuristic for _, heuristic in parts])
    # Seeds are the slow index, so that every device gets all configurations, fast and slow ones.
    lanes = tuple(
        Lane(name, support, task.support(support), build_heuristic(arguments, heuristic, settings, task), seed)
        for seed in _seeds(arguments)
        for name, (support, heuristic) in zip(configurations, parts, strict=True)
    )
    plan = Plan(run_store.COMPARE, arguments.task, task, arguments.preset, settings, lanes, arguments.keep_network)
    session.begin(arguments.out, plan, _observation(arguments, task))
    return arguments.out, plan


def grid(arguments: argparse.Namespace, console: Console) -> Prepared:
    """Prepare `jaxlfi grid`."""
    task = task_lookup.load(arguments.task)
    settings = build_settings(arguments, task)
    axes = sweep.parse_axes(arguments.vary)
    registry.refuse_foreign(arguments.hyperparameters, [arguments.heuristic])
    for axis in axes:
        if axis.name in arguments.hyperparameters:
            raise ValueError(f"{axis.name}: expected it on an axis or as a flag of its own, got both")
    name = arguments.support or next(iter(task.supports))
    plan = sweep.Grid(
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
    console.print(f"{task.name}: compiling for {plan.size} runs")
    return arguments.out, sweep.begin(arguments.out, plan, observation, arguments.lanes_per_chunk)


def resume(arguments: argparse.Namespace, console: Console) -> Prepared | None:
    """Prepare `jaxlfi resume`: nothing is left to do where the run is complete."""
    folder = arguments.folder
    if sweep.is_grid(folder):
        return _resume_grid(folder, console)
    config = run_store.read_config(folder)
    if config.get("status") == "finished" or ("status" not in config and (folder / "posterior.npz").exists()):
        console.print(_COMPLETE.format(folder=folder))
        return None
    if "lanes" not in config:
        raise run_store.StoreError(f"expected the folder a command was given, got {str(folder)!r}, one run of several")
    return folder, session.plan_of(config)


_COMPLETE = "{folder} is complete: nothing to resume. Its pictures: jaxlfi report {folder}"


def _resume_grid(folder: Path, console: Console) -> Prepared | None:
    config = sweep.read_config(folder)
    if config.get("status") == "finished":
        console.print(_COMPLETE.format(folder=folder))
        return None
    if config.get("devices") != (here := jax.local_device_count()):
        console.print(
            f"warning: begun on {config.get('devices')} devices and resumed on {here}: results differ by rounding",
            style="yellow",
            soft_wrap=True,
            highlight=False,
        )
    return folder, sweep.reopen(folder)


def report(arguments: argparse.Namespace, console: Console) -> None:
    """`jaxlfi report`."""
    (sweep if sweep.is_grid(arguments.folder) else run_store).read_config(arguments.folder)
    draw(arguments.folder, console)


def sample(arguments: argparse.Namespace, console: Console) -> None:
    """`jaxlfi sample DIR`."""
    out = arguments.out or arguments.folder / "samples.csv"
    if out.suffix not in (".csv", ".npz", ".nc"):
        raise ValueError(f"out: expected a name that ends in .csv or .npz, or .nc for ArviZ, got {out}")
    if out.exists():
        raise ValueError(f"out: expected a new file, got {out}, which exists")
    if out.suffix == ".nc":
        export.write_netcdf(out, arguments.folder, arguments.number, arguments.seed)
        console.print(f"samples: {out}", soft_wrap=True, highlight=False)
        return
    draws, names, inside = posterior_samples(arguments.folder, arguments.number, arguments.seed)
    if out.suffix == ".npz":
        atomic.write_arrays(out, {"theta": draws, "names": np.asarray(names)})
    else:
        rows = [",".join(names), *(",".join(f"{value:.8g}" for value in row) for row in draws)]
        atomic.write_bytes(out, ("\n".join(rows) + "\n").encode())
    console.print(f"samples: {out}", soft_wrap=True, highlight=False)
    if inside < LEAKAGE:
        console.print(
            f"warning: only {inside:.2g} of the posterior lies in the support it was truncated to; it may be wrong.",
            style="yellow",
            soft_wrap=True,
            highlight=False,
        )


def diagnose(arguments: argparse.Namespace, console: Console) -> None:
    """`jaxlfi diagnose DIR`."""
    subject = diagnosis.read_subject(arguments.folder)
    name = arguments.reference or next(iter(subject.task.supports))
    if name not in subject.task.supports:
        raise ValueError(f"reference: expected one of {sorted(subject.task.supports)}, got {name!r}")
    plan = diagnosis.Plan(name, arguments.truths, arguments.draws, arguments.seed)
    reference = None
    if arguments.against is not None:
        reference = arguments.against.name, diagnosis.read_reference(arguments.against, subject.task)
    out = arguments.out or arguments.folder / "diagnostics"
    checks = diagnosis.run(out, subject, plan, console, reference)
    console.print(checks_table(checks))
    console.print(f"diagnostics: {out}", soft_wrap=True, highlight=False)
    if not arguments.no_figures:
        for path in _figures().checks.report(out):
            console.print(f"picture: {path}", soft_wrap=True, highlight=False)


def checks_table(checks: Sequence[diagnosis.Check]) -> Table:
    """One line a check."""
    table = Table("check", "statistic", "expected", "p-value", "verdict")
    for check in checks:
        p_value = "" if np.isnan(check.p_value) else f"{check.p_value:.2g}"
        colour = {"": "", diagnostics.OK: "green"}.get(check.verdict, "red")
        table.add_row(check.name, check.statistic, check.expected, p_value, check.verdict, style=colour)
    return table


def run(folder: Path, plan: Plan | Work, arguments: argparse.Namespace, console: Console) -> None:
    """Run what `infer`, `compare`, `grid` or `resume` prepared, and tell what came of it."""
    if isinstance(plan, Work):
        _run_grid(folder, plan, arguments, console)
        return
    try:
        session.advance(folder, plan, console)
    except SimulatorError:
        if arguments.command != "resume" and not session.any_round(folder):
            shutil.rmtree(folder)  # made by this very command, and there is nothing in it to go on from
        raise
    console.print(summary_table(folder, plan))
    for warning in session.support_warnings(folder, plan):
        console.print(f"warning: {warning}", style="yellow", soft_wrap=True, highlight=False)
    if plan.kind == run_store.COMPARE:
        console.print(f"table: {folder / 'table.csv'}", soft_wrap=True, highlight=False)
    else:
        console.print(f"results: {folder}", soft_wrap=True, highlight=False)
    if not arguments.no_figures:
        draw(folder, console)


def _run_grid(folder: Path, work: Work, arguments: argparse.Namespace, console: Console) -> None:
    try:
        arrays = sweep.advance(folder, work, console)
    except SimulatorError:
        if arguments.command != "resume":
            shutil.rmtree(folder)  # raised in the first chunk only: there is nothing in it to go on from
        raise
    console.print(marginal_table(work.grid, arrays))
    console.print(f"table: {folder / 'table.csv'}", soft_wrap=True, highlight=False)
    if not arguments.no_figures:
        draw(folder, console)


def marginal_table(grid: sweep.Grid, arrays: Mapping[str, np.ndarray]) -> Table:
    """One line a value of each hyperparameter, over the seeds and the other hyperparameters."""
    table = Table("hyperparameter", "value", "runs", "theta error", "traj. error", "success")
    for place, axis in enumerate(grid.axes):
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
    """Of those that are known."""
    values = values[np.isfinite(values)]
    return f"{np.mean(values):.2f} ± {np.std(values, ddof=min(1, values.size - 1)):.2f}" if values.size else "-"


def draw(folder: Path, console: Console) -> None:
    """Draw all pictures of a folder from its saved files, and name them."""
    for path in _figures().report(folder):
        console.print(f"picture: {path}", soft_wrap=True, highlight=False)


def _figures():
    """The package of figures: matplotlib is needed for pictures only."""
    try:
        import jaxlfi.figures.checks
    except ImportError as error:
        raise run_store.StoreError(f"pictures: expected matplotlib to be installed, got: {error}") from error
    return jaxlfi.figures


def default_configurations(task: Task) -> list[str]:
    """Up to three supports kept fixed, and the misspecified one (or else the first) with every heuristic."""
    wanted = [name for name in ("ok", "misspecified", "broad") if name in task.supports]
    supports = wanted or list(task.supports)[:3]
    adapted = "misspecified" if "misspecified" in supports else supports[0]
    return [*supports, *(f"{adapted}+{heuristic}" for heuristic in ("edge", "mode", "centre"))]


def build_settings(arguments: argparse.Namespace, task: Task) -> Settings:
    """The preset, with what the task asks for in its place, and what was given in place of both."""
    preset = METHODS[arguments.method](with_settings(PRESETS[arguments.preset], task.settings))
    given = {name: value for name, value in vars(arguments).items() if value is not None}
    if "steps" in given and "epochs" not in given:
        given["epochs"] = 0
    if "epochs" in given and "steps" not in given:
        given["steps"] = 0
    if "hidden" in given:
        given["hidden"] = tuple(given["hidden"])
    if "simulation_budget" not in given and "simulations_per_round" in given:
        # The share of failures that a round can bear stays the preset's.
        given["simulation_budget"] = -(
            -given["simulations_per_round"] * preset.simulation_budget // preset.simulations_per_round
        )
    settings = with_settings(preset, given)
    for name in ("learning_rate", "weight_decay", "clip_norm"):
        value = getattr(settings.estimator, name)
        if not value >= 0 or (name != "clip_norm" and not np.isfinite(value)):
            raise ValueError(f"{name}: expected a number of at least 0, got {value}")
    return settings.check()


def with_settings(settings: Settings, given: Mapping[str, Any]) -> Settings:
    """Settings with those numbers replaced that are named, be they of the run or of its estimator."""
    named = lambda kind: {f.name: given[f.name] for f in dataclasses.fields(kind) if f.name in given}
    return dataclasses.replace(
        settings, estimator=dataclasses.replace(settings.estimator, **named(Estimator)), **named(Settings)
    )


def build_heuristic(arguments: argparse.Namespace, name: str, settings: Settings, task: Task) -> Heuristic:
    """A heuristic with the hyperparameters that were given, or else those that the task asks for.

    Components that it compares are matched first where networks start anew every round.
    """
    values = {**task.hyperparameters.get(name, {}), **registry.own(name, arguments.hyperparameters)}
    return paired(registry.build(name, values, task.dim), settings.estimator.warm_start)


def _configuration(name: str) -> tuple[str, str]:
    """Support and heuristic of "support" or "support+heuristic"."""
    support, plus, heuristic = name.partition("+")
    if plus:
        try:
            registry.load(heuristic)
        except ValueError as error:
            raise ValueError(f"configurations: expected support+heuristic, got {name!r}: {error}") from error
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
    if arguments.observation is None:
        return None
    trajectory = observations.read(arguments.observation)
    return trajectory if task.black_box else observations.fitted(trajectory, simulator_shapes(task))


def _seeds(arguments: argparse.Namespace) -> range:
    if arguments.seeds < 1 or not 0 <= arguments.first_seed < 2**31 - arguments.seeds:
        raise ValueError(
            f"seeds: expected at least 1, and first_seed at least 0, got {arguments.seeds} and {arguments.first_seed}"
        )
    return range(arguments.first_seed, arguments.first_seed + arguments.seeds)


def summary_table(folder: Path, plan: Plan) -> Table:
    """What came out: one line a configuration, over its seeds."""
    beliefs = [run_store.read_belief(folder / name) for name in plan.folders()]
    lines = session.results(folder, plan)
    table = Table("configuration", "seeds", "theta error [95 %]", "median", "traj. error", "success", "final support")
    for column in table.columns[:-1]:
        column.no_wrap = True
    for configuration in dict.fromkeys(lane.configuration for lane in plan.lanes):
        own = [i for i, lane in enumerate(plan.lanes) if lane.configuration == configuration]
        column = lambda name, own=own: np.array([lines[i][name] for i in own])
        error = column("theta_error")
        trajectory = column("trajectory_error")
        low = np.median([np.asarray(beliefs[i].support.low) for i in own], axis=0)
        high = np.median([np.asarray(beliefs[i].support.high) for i in own], axis=0)
        table.add_row(
            configuration,
            str(len(own)),
            _with_interval(error),
            "-" if np.isnan(error).any() else f"{np.median(error):.2f}",
            "-" if np.isnan(trajectory).all() else f"{np.nanmean(trajectory):.2f}",
            f"{np.mean(column('success_rate')):.0%}",
            " ".join(f"[{a:.2g}, {b:.2g}]" for a, b in zip(low, high, strict=True)),
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
