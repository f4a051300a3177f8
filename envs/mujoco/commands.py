"""The command `jaxlfi mujoco fit`, whose arguments `jaxlfi.envs.mujoco.cli` parses."""

import argparse
import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import scipy.linalg
from rich.table import Table

import jaxlfi
from jaxlfi import plot
from jaxlfi.cli import tables
from jaxlfi.diagnostics import identifiability
from jaxlfi.envs.mujoco import config, least_squares, sysid_point
from jaxlfi.envs.mujoco.least_squares import Fit
from jaxlfi.envs.mujoco.simulator import simulator_of
from jaxlfi.envs.mujoco.sysid_point import SysidPoint
from jaxlfi.io import files
from jaxlfi.io.progress import RoundProgress
from jaxlfi.io.provenance import environment
from jaxlfi.registry import TASKS
from jaxlfi.runs.run import Run
from jaxlfi.tasks.task import Task

DRAWS = 1000
SYSID = "mujoco.sysid"
SHOWN = 6
"""Largest number of points in a pair plot, besides the posterior and the point of mujoco.sysid."""


def fit(arguments: argparse.Namespace) -> None:
    """Find least-squares points from draws of a run's posterior, or from draws of Phi.

    Raises:
        ValueError: for a run of another kind of task, and a folder that already exists.
        ImportError: if the point of `mujoco.sysid` is requested and that is not installed.
    """
    if arguments.sysid:
        sysid_point.require_sysid()
    out = arguments.out
    if out is not None and out.exists():
        raise ValueError(f"--out: expected a new folder, got {out}")
    run = jaxlfi.load(arguments.source) if Path(arguments.source).is_dir() else None
    task = task_named(arguments.source) if run is None else task_of(run)
    starts = _over_feasible(task, arguments.starts) if run is None else np.asarray(run.draws(arguments.starts))
    observation = None if run is None else np.asarray(run.observed)
    console = tables.console()

    def counted(rows: Sequence[int]) -> Iterator[int]:
        with RoundProgress(console, len(rows), 0, task.name, "point", "") as progress:
            for row in rows:
                yield row
                progress.advance()

    fits = least_squares.best_fits(task, starts, arguments.keep, observation=observation, counted=counted)
    for number, one in enumerate(fits):
        tables.show(_table(task, one, f"point {number + 1} of {len(fits)}"), console)
    other = sysid_point.sysid_point(task, observation) if arguments.sysid else None
    if other is not None:
        tables.show(_table(task, other, f"{SYSID}, from the middle of the first guess"), console)
    for line in said(task, fits):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    if out is not None:
        out.mkdir(parents=True)
        found = {"points": [_plain(task, one) for one in fits]} | ({SYSID: _plain(task, other)} if other else {})
        files.write_json(out / "fit.json", {**found, **environment()})
        draw(out / "pairs.png", task, fits, other, None if run is None else np.asarray(run.draws(DRAWS)))
        console.print(f"results: {out}", markup=False, highlight=False, soft_wrap=True)


def draw(
    path: Path, task: Task, fits: Sequence[Fit], other: SysidPoint | None = None, posterior: np.ndarray | None = None
) -> None:
    """A pair plot of the points that explain the recording as well as the best, with their intervals.

    Args:
        path: of the .png file.
        task: of a MuJoCo model.
        fits: the best first. Around each are draws of the normal distribution with its covariance.
        other: what `mujoco.sysid` finds.
        posterior: draws in natural units, shape [n, D].
    """
    several = least_squares.as_good(fits)[:SHOWN]
    called = {f"point {number + 1}, 90 %": one for number, one in enumerate(several)}
    sets = {label: _drawn(task, one) for label, one in called.items()}
    points = {label: (one.theta, one.interval) for label, one in called.items()}
    if posterior is not None:
        sets = {"posterior": posterior, **sets}
    if other is not None:
        points[f"{SYSID}, 90 %"] = other.theta, other.interval
    names = [name.replace("/", "/ ") for name in task.names]  # so that lines can break there
    log = [name for name, own in zip(names, task.space.log, strict=True) if own]
    truth = None if task.truth is None else np.asarray(task.truth)
    plot.pairs(sets, names=names, units=task.units, log=log, truth=truth, points=points, path=path, dpi=150)


def task_named(source: str) -> Task:
    """The task that a TOML file describes, or that a reference names as `jaxlfi infer` takes it.

    Raises:
        ValueError: if it is neither.
    """
    if Path(source).is_file():
        return config.read(Path(source))
    name = source.partition(",")[0]
    if name not in TASKS.names() and ":" not in name:
        raise ValueError(
            f"{source}: expected the folder of a run, a TOML file that describes a task, or a task such as "
            "mujoco,config=FILE.toml; got none of them"
        )
    return TASKS.load(source)


def task_of(run: Run) -> Task:
    """A run's task.

    Raises:
        ValueError: where it cannot be found.
    """
    if run.task is None:
        raise ValueError(
            f"run: cannot find its task, {run.origin.reference or 'which was made in Python'}: if paths are "
            "relative, change to the folder that the run was made in"
        )
    return run.task


def said(task: Task, fits: Sequence[Fit]) -> list[str]:
    """The findings in sentences, and lines for the task's file."""
    best = fits[0]
    lines = [best.doubt] if best.doubt else []
    if len(least_squares.as_good(fits)) > 1:
        lines.append(
            f"{len(least_squares.as_good(fits))} points explain the recording equally well: it does not determine "
            "which is right."
        )
    for name, bound in zip(task.names, best.at_bound, strict=True):
        if bound:
            lines.append(f"{name} ended on a bound of Phi: widen Phi if it can be.")
    lines += _not_informed(task, best)
    rows, names = (
        np.flatnonzero(best.informed),
        [name for name, one in zip(task.names, best.informed, strict=True) if one],
    )
    found = identifiability.trade_offs(names, np.asarray(task.space.to_natural(_normal_draws(task, best)))[:, rows])
    lines += [identifiability.trade_off_sentence(names, one) for one in found]
    integrator = (
        f"The integrator's error is {best.defect:.2f} times the noise, and is subtracted."
        if best.defect
        else "The integrator's error is not subtracted: a finer integrator does not fit better."
    )
    lines.append(
        f"Residuals are {best.misfit:.2f} times the noise; for a model without error they would be 1. {integrator}"
    )
    lines.append("What the model gets wrong, for the file of the task; the first line goes above its tables:\n")
    lines.append(f"unmodelled_force = {best.unmodelled_force:.2g}\n\n[discrepancy]")
    for name, one in zip(simulator_of(task).signals, best.discrepancies, strict=True):
        lines.append(f'"{name}" = {{ deviation = {one.deviation:.2g}, time = {one.time:.2g} }}')
    return lines


def _not_informed(task: Task, best: Fit) -> list[str]:
    """Parameters without an interval, and what the recording determines of their combinations."""
    box = task.inference.feasible
    widths = np.asarray(box.high, float) - np.asarray(box.low, float)
    noises = _noises(task)
    others = np.where(np.isin(task.names, noises)[:, None], 0.0, best.uninformed) / widths[:, None]
    others = scipy.linalg.orth(others) * widths[:, None]
    lines = identifiability.sentences(task.names, task.space.log, best.theta, others, widths)
    named = identifiability.untouched(best.uninformed.T / widths)
    lines += [
        identifiability.unconstrained(name, ": its interval is as wide as Phi")
        for name, known, along in zip(task.names, best.informed, named, strict=True)
        if along and not known
    ]
    return [*lines, *(f"{name} is not estimated by least squares: inference does." for name in noises)]


def _noises(task: Task) -> list[str]:
    """Parameters that are standard deviations of noise or of timing, which least squares does not estimate."""
    does = simulator_of(task).does
    jitter = [] if does.jitter is None else [does.jitter]
    return [task.names[d] for d in [*(d for _, d in does.deviations), *jitter]]


def _over_feasible(task: Task, count: int) -> np.ndarray:
    """Draws of Phi, uniform in inference space; in natural units, shape [count, D]."""
    low, high = np.asarray(task.inference.feasible.low), np.asarray(task.inference.feasible.high)
    return np.asarray(task.space.to_natural(np.random.default_rng(0).uniform(low, high, (count, len(low)))))


def _normal_draws(task: Task, one: Fit) -> np.ndarray:
    """Draws of the normal distribution with a point's covariance, in inference space."""
    centre = np.asarray(task.space.to_inference(one.theta), float)
    return np.random.default_rng(0).multivariate_normal(centre, one.covariance, DRAWS, method="eigh")


def _drawn(task: Task, one: Fit) -> np.ndarray:
    """The same within Phi, in natural units."""
    draws, feasible = _normal_draws(task, one), task.inference.feasible
    inside = np.asarray(feasible.contains(draws))
    if inside.sum() < plot.MIN_DRAWS:  # such as when the recording says hardly more than the box
        return np.asarray(task.space.to_natural(np.clip(draws, feasible.low, feasible.high)))
    return np.asarray(task.space.to_natural(draws[inside]))


def _plain(task: Task, one: Fit | SysidPoint) -> dict:
    found = dataclasses.asdict(one)
    return {"names": list(task.names)} | {
        key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in found.items()
    }


def _table(task: Task, one: Fit | SysidPoint, title: str) -> Table:
    table = Table(title=f"{title}: misfit {one.misfit:.3g}, {one.simulations} simulations in all")
    bounded = any(one.at_bound)
    for heading in ("parameter", "unit", "value", "90 % interval", *[""] * bounded):
        table.add_column(heading)
    units = task.units or [""] * task.dim
    for name, unit, value, (low, high), bound in zip(
        task.names, units, one.theta, one.interval, one.at_bound, strict=True
    ):
        none = "not estimated by least squares" if name in _noises(task) else "not constrained by this recording"
        interval = f"{low:.4g} to {high:.4g}" if np.isfinite([low, high]).all() else none
        notes = ["on a bound" if bound else ""] * bounded
        table.add_row(name, unit, f"{value:.4g}", interval, *notes)
    return table
