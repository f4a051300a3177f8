"""What commands print at their end: tables of results, lines on rounds and widths, and warnings."""

from collections.abc import Mapping, Sequence

import numpy as np
from rich.markup import escape
from rich.table import Table

from jaxlfi import diagnostics
from jaxlfi.bayessim.convergence import LAG, changes
from jaxlfi.bayessim.widths import widths_note
from jaxlfi.diagnostics.bootstrap import bootstrap_interval
from jaxlfi.diagnostics.bounds import bound_warnings
from jaxlfi.io.run_summary import RunSummary
from jaxlfi.runs import execute as executing
from jaxlfi.runs.execute import BatchPlan
from jaxlfi.runs.run import Run
from jaxlfi.studies import calibration, grid
from jaxlfi.tasks import failures

COMMONEST = 3
"""Largest number of reasons of failed simulations that are printed."""


def by_configuration(plan: BatchPlan, runs: Sequence[Run]) -> dict[str, list[Run]]:
    """The runs of each configuration, in the plan's order."""
    found: dict[str, list[Run]] = {}
    for spec, run in zip(plan.specs, runs, strict=True):
        found.setdefault(spec.configuration, []).append(run)
    return found


def parameter_table(found: RunSummary) -> Table:
    """What is known about each parameter of a run."""
    headings, rows = found.table()
    table = Table(*headings)
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def summary_table(plan: BatchPlan, runs: Sequence[Run]) -> Table:
    """The results, with one line per configuration, over its seeds."""
    table = Table("configuration", "seeds", "theta error [95 %]", "median", "traj. error", "success", "final support")
    lines = executing.results(plan, runs)
    for configuration, own in by_configuration(plan, runs).items():
        error, trajectory, success = (
            np.array([line[name] for line in lines if line["configuration"] == configuration])
            for name in ("theta_error", "trajectory_error", "success_rate")
        )
        boxes = [run.final_support() for run in own]
        low, high = (np.median([np.asarray(getattr(box, end)) for box in boxes], axis=0) for end in ("low", "high"))
        table.add_row(
            escape(configuration),
            str(len(own)),
            _with_interval(error),
            "-" if np.isnan(error).any() else f"{np.median(error):.2f}",
            "-" if np.isnan(trajectory).all() else f"{np.nanmean(trajectory):.2f}",
            f"{np.mean(success):.0%}",
            escape(" ".join(f"[{a:.2g}, {b:.2g}]" for a, b in zip(low, high, strict=True))),
        )
    return table


def _with_interval(values: np.ndarray) -> str:
    """The mean, and its 95 % bootstrap interval over seeds if there are several."""
    if np.isnan(values).any():
        return "-"
    if len(values) == 1:
        return f"{values[0]:.2f}"
    low, high = bootstrap_interval(values)
    return f"{np.mean(values):.2f} [{low:.2f}, {high:.2f}]"


def failure_lines(runs: Sequence[Run]) -> list[str]:
    """How many simulations failed, and the most common reasons; empty if none did."""
    found = failures.together([(run.failure_log, run.history["failed"]) for run in runs])
    attempted = sum(int(np.sum(run.history["attempted"])) for run in runs)
    if not found:
        return []
    head = f"failed: {sum(one.count for one in found)} of {attempted} simulations"
    lines = [f"  {one.count} {one.reason}{': ' if one.message else ''}{one.message}" for one in found[:COMMONEST]]
    return [head + ("; the most common reasons:" if len(found) > COMMONEST else ":"), *lines]


def rounds_lines(plan: BatchPlan, runs: Sequence[Run]) -> list[str]:
    """Whether runs that may end once they have settled have done so, in one line per configuration."""
    lines: list[str] = []
    if not 0 < plan.settings.min_rounds <= plan.settings.rounds:
        return lines
    for configuration, own in by_configuration(plan, runs).items():
        made = [np.count_nonzero(~np.asarray(run.history["settled"][:-1])) + 1 for run in own]
        restless = [run.history for run in own if not run.history["settled"][-1]]
        extent = f"{made[0]}" if len(set(made)) == 1 else f"{min(made)} to {max(made)}"
        verdict = "the posterior has settled"
        if restless:
            verdict = f"{len(restless)} of {len(own)} posteriors {_changes(restless)}"
        lines.append(f"rounds of {configuration}: {extent}; {verdict}")
    return lines


def _changes(histories: Sequence[Mapping[str, np.ndarray]]) -> str:
    """How runs that had not settled still changed over their last rounds."""
    moved, rescaled, turned = (
        max(float(history[name][-1]) for history in histories) for name in ("moved", "rescaled", "turned")
    )
    if not np.isfinite(moved):
        return f"made too few rounds to have settled: they are compared over {LAG}"
    listed = ", ".join(changes(moved, rescaled, turned))
    return f"still changed over the last {LAG} rounds: {listed} (--rounds allows for more)"


def widths_lines(plan: BatchPlan, runs: Sequence[Run]) -> list[str]:
    """What is known about the widths of the rounds' posteriors, in one line, or several if heuristics differ.

    Polished posteriors are left out: their summaries say what they rest on.
    """
    names: dict[str, list[str]] = {}
    shares: dict[str, list[float]] = {}
    for spec, run in zip(plan.specs, runs, strict=True):
        if run.unpolished is not None:
            continue
        line = widths_note(plan.settings, spec.heuristic)
        names.setdefault(line, [])
        names[line] += [spec.configuration] * (spec.configuration not in names[line])
        shares.setdefault(line, []).append(_effective_share(run.history))
    several = len(names) > 1
    return [
        f"widths{' of ' + ', '.join(names[line]) if several else ''}: {line}{_of_draws(shares[line])}" for line in names
    ]


def _effective_share(history: Mapping[str, np.ndarray]) -> float:
    shares = history.get("effective_share", np.ones(1))  # runs from before it was recorded lack it
    return float(shares[-1]) if len(shares) else 1.0


def _of_draws(shares: Sequence[float]) -> str:
    """The effective sample size of a correction that weights draws, relative to their number, over several runs."""
    if min(shares) == 1:
        return ""
    least, most = (f"{share:.0%}" if share >= 0.005 else "under 1%" for share in (min(shares), max(shares)))
    return f"; effective sample size {least if least == most else f'{least} to {most}'} of the draws"


def warnings(plan: BatchPlan, runs: Sequence[Run]) -> list[str]:
    """Warnings about a batch: failed simulations or training, wrong bounds, an observation unlike the simulations."""
    return [
        *failure_warnings(plan, runs),
        *training_warnings(plan, runs),
        *support_warnings(plan, runs),
        *summary_warnings(runs),
        *observation_warnings(plan, runs),
    ]


def failure_warnings(plan: BatchPlan, runs: Sequence[Run]) -> list[str]:
    """Warnings about runs of a batch without a successful simulation in the first round."""
    found = []
    for configuration, own in by_configuration(plan, runs).items():
        if empty := sum(int(run.history["succeeded"][0]) == 0 for run in own):
            found.append(
                f"{configuration}: all simulations of the first round failed in {empty} of {len(own)} runs, whose "
                "posteriors say nothing: is the simulator defined on this support?"
            )
    return found


def training_warnings(plan: BatchPlan, runs: Sequence[Run]) -> list[str]:
    """Warnings about runs whose networks did not learn, as gradients were not finite."""
    warnings = []
    settings = plan.settings.estimator
    for configuration, own in by_configuration(plan, runs).items():
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
    """Warnings about runs that ended with a bound that looks wrong and that their heuristic cannot move."""
    warnings = []
    for configuration, own in by_configuration(plan, runs).items():
        evidence, grows = [run.bound_evidence for run in own], own[0].heuristic.grows
        found = bound_warnings(plan.task.space, plan.task.units, evidence, own[0].feasible, grows)
        warnings += [f"{configuration}: {text}" for text in found]
    return warnings


def summary_warnings(runs: Sequence[Run]) -> list[str]:
    """Warnings about summaries that do not vary, for the first run with such summaries."""
    return next((found for run in runs if (found := run.unresolved)), [])


def observation_warnings(plan: BatchPlan, runs: Sequence[Run]) -> list[str]:
    """Warnings about observations unlike all simulations of their runs: the first such run, and the number of them."""
    warnings = []
    for configuration, own in by_configuration(plan, runs).items():
        found = [texts for run in own if (texts := run.misspecification)]
        shown = [text for texts in found for text in texts]
        if len(own) > 1:
            shown = [f"{text} (in {len(found)} of {len(own)} runs, this is the first)" for text in shown[:1]]
        warnings += [f"{configuration}: {text}" for text in shown]
    return warnings


def checks_table(checks: Sequence[calibration.Check]) -> Table:
    """A table with one line per check."""
    table = Table("check", "statistic", "expected", "p-value", "verdict")
    for check in checks:
        p_value = "" if np.isnan(check.p_value) else f"{check.p_value:.2g}"
        colour = {"": "", diagnostics.OK: "green"}.get(check.verdict, "red")
        cells = map(escape, (check.name, check.statistic, check.expected, p_value, check.verdict))
        table.add_row(*cells, style=colour)
    return table


def marginal_table(study: grid.Grid, arrays: Mapping[str, np.ndarray]) -> Table:
    """A table with one line per value of each hyperparameter, over the seeds and the other hyperparameters."""
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
    """Mean and standard deviation of the finite values."""
    values = values[np.isfinite(values)]
    return f"{np.mean(values):.2f} ± {np.std(values, ddof=min(1, values.size - 1)):.2f}" if values.size else "-"
