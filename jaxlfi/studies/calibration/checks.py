"""Checks of a run with truths, posterior draws and simulations: statistics and verdicts."""

import csv
import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi import diagnostics
from jaxlfi.diagnostics.predictive import MIN_SIMULATIONS
from jaxlfi.estimators.normaliser import fit_normaliser
from jaxlfi.io import files
from jaxlfi.runs.run import Run
from jaxlfi.studies.calibration.plan import AGAINST, CLASSIFIER, MIN_COUNT, PREDICTIVE, TIES, CalibrationPlan
from jaxlfi.tasks.simulation import simulate_batch
from jaxlfi.tasks.task import Task

PREDICTIVE_DRAWS = 200
"""Number of posterior draws whose simulations are compared with the run's own observation."""
MAX_ROWS = 10_000
"""Largest number of rows that a classifier gets of a sample; the field's reference posteriors have as many."""
LEVEL = 0.9
"""Level of the credible region whose coverage is reported, besides the level where coverage is worst."""


@dataclasses.dataclass(frozen=True)
class Check:
    """One line of the result.

    Attributes:
        name: name of the check.
        statistic: value of the statistic, in words.
        expected: value for a calibrated posterior, in words.
        p_value: p-value; NaN for a check that has none.
        verdict: "ok", or what is wrong; "" for a check that is only reported.
        numbers: numbers for diagnostics.json.
    """

    name: str
    statistic: str
    expected: str
    p_value: float
    verdict: str
    numbers: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def calibration(
    run: Run, plan: CalibrationPlan, truths: Mapping[str, np.ndarray], found: Mapping[str, np.ndarray]
) -> tuple[list[Check], dict[str, np.ndarray]]:
    """Compare truths with draws from their posteriors: ranks, coverage, TARP, and a classifier.

    Returns:
        The checks, and the arrays from which their figures are drawn.
    """
    theta, draws, dim = truths["theta"], found["draws"], run.task.dim
    box = run.task.support(plan.reference)
    log_prob = found["truth_log_prob"], found["log_prob"]
    rank, density, distance = jax.device_get(_all_ranks(plan.key(TIES), theta, draws, *log_prob, box.low, box.high))
    by_parameter = [diagnostics.uniformity(rank[:, d], plan.draws, dim) for d in range(dim)]
    coverage, tarp = (diagnostics.uniformity(r, plan.draws) for r in (density, distance))
    bars = [diagnostics.histogram(rank[:, d], plan.draws) for d in range(dim)]
    lines = [
        _support_check(theta, found),
        *(_rank_check(name, rank[:, d], by_parameter[d], plan.draws) for d, name in enumerate(run.task.names)),
        _curve_check("coverage of densest regions", coverage, diagnostics.coverage_verdict(coverage)),
        _curve_check("coverage from random points (TARP)", tarp, diagnostics.distance_verdict(tarp)),
        _classifier_check(run, plan, truths, draws),
    ]
    arrays = {
        "ranks": rank,
        "density_ranks": density,
        "distance_ranks": distance,
        **{name: getattr(coverage, name) for name in ("level", "pointwise", "simultaneous")},
        "ranks_simultaneous": by_parameter[0].simultaneous,
        "ranks_fraction": np.stack([result.fraction for result in by_parameter]),
        "coverage_fraction": coverage.fraction,
        "distance_fraction": tarp.fraction,
        **{f"bin_{name}": getattr(bars[0], name) for name in ("edges", "expected", "band")},
        "bin_count": np.stack([bar.count for bar in bars]),
    }
    return lines, arrays


def _all_ranks(key, theta, draws, truth_log_prob, log_prob, low, high):
    key_ranks, key_density, key_distance = jax.random.split(key, 3)
    return (
        diagnostics.ranks(key_ranks, theta, draws),
        diagnostics.density_ranks(key_density, truth_log_prob, log_prob),
        diagnostics.distance_ranks(key_distance, theta, draws, low, high),
    )


def _support_check(theta: np.ndarray, found: Mapping[str, np.ndarray]) -> Check:
    """How many truths lie in the final support of their posterior; those outside are misses in all checks."""
    held = np.all((theta >= found["support_low"]) & (theta <= found["support_high"]), axis=1)
    log_prob = float(np.mean(found["truth_log_prob"][held])) if held.any() else math.nan
    numbers = {"truths_inside": int(held.sum()), "log_prob_of_truths_inside": log_prob}
    return Check("final support", f"contains {held.sum()} of {len(held)} truths", "all", math.nan, "", numbers)


def _rank_check(name: str, rank: np.ndarray, result: diagnostics.Uniformity, draws: int) -> Check:
    place = (rank + 0.5) / (draws + 1)
    mean, deviation = float(np.mean(place)), float(np.std(place) * math.sqrt(12))
    numbers = {"mean": mean, "sd": deviation, "shift_z": result.shift, "dispersion_z": result.dispersion}
    statistic = f"mean {mean:.2f}, sd {deviation:.2f}"
    return Check(f"rank of {name}", statistic, "0.5 and 1", result.p_value, diagnostics.ranks_verdict(result), numbers)


def _curve_check(name: str, result: diagnostics.Uniformity, verdict: str) -> Check:
    levels = [result.worst, LEVEL]
    fractions = [result.fraction_at(level) for level in levels]
    bands = [[float(np.interp(level, result.level, side)) for side in result.simultaneous] for level in levels]
    numbers = {
        "levels": levels,
        "fractions": fractions,
        "bands": bands,
        "shift_z": result.shift,
        "dispersion_z": result.dispersion,
    }
    statistic = ", ".join(f"{level:.0%}: {fraction:.2f}" for level, fraction in zip(levels, fractions, strict=True))
    expected = ", ".join(f"{low:.2f} to {high:.2f}" for low, high in bands)
    return Check(name, statistic, expected, result.p_value, verdict, numbers)


def _classifier_check(run: Run, plan: CalibrationPlan, truths: Mapping[str, np.ndarray], draws: np.ndarray) -> Check:
    """Whether a classifier that sees the simulations can tell truths from posterior draws."""
    x = jnp.asarray(run.counted(truths["x"]))
    x = np.asarray(fit_normaliser(run.settings.estimator.normaliser, x, jnp.ones(len(x), bool))(x))
    rows = [np.concatenate([theta, x], axis=1) for theta in (truths["theta"], draws[:, 0])]
    accuracy = _accuracy(plan.key(CLASSIFIER), *rows)
    # Held-out rows are nearly independent if there is nothing to learn.
    deviation = 0.5 / math.sqrt(2 * plan.truths)
    p_value = 0.5 * math.erfc((accuracy - 0.5) / deviation / math.sqrt(2))
    verdict = (
        diagnostics.OK
        if p_value > diagnostics.SIGNIFICANCE
        else "miscalibrated: a classifier separates draws from truths"
    )
    expected = f"at most {0.5 + 2.33 * deviation:.2f}"
    return Check("classifier, draws or truths", f"{accuracy:.2f}", expected, p_value, verdict, {"accuracy": accuracy})


def _accuracy(key: jax.Array, first: np.ndarray, second: np.ndarray) -> float:
    return float(diagnostics.c2st(key, first, second))


def predictive(run: Run, plan: CalibrationPlan) -> tuple[Check, dict[str, np.ndarray]]:
    """Compare the run's own observation with simulations from its own posterior.

    Returns:
        The check, and the arrays from which its figure is drawn; no arrays if too many simulations failed.
    """
    name = "posterior predictive"
    key_draw, key_simulate = jax.random.split(plan.key(PREDICTIVE))
    theta = _draws(run, key_draw, PREDICTIVE_DRAWS)
    _, x, failure = simulate_batch(key_simulate, run.task, theta, run.observed.shape)
    failed = int(np.sum(failure != 0))
    if PREDICTIVE_DRAWS - failed < MIN_SIMULATIONS:
        statistic = f"{failed} of {PREDICTIVE_DRAWS} simulations failed"
        return Check(name, statistic, "", math.nan, "misfit: too few simulations succeed", {"failed": failed}), {}
    simulated = np.where(failure[:, None] == 0, x, np.nan)
    result = diagnostics.predictive_check(simulated, run.x)
    misfit = "misfit: the observation is unlike the posterior's simulations"
    check = Check(
        name,
        f"distance {result.distance:.2f}",
        f"at most {np.quantile(result.distances, 1 - diagnostics.SIGNIFICANCE):.2f}",
        result.p_value,
        diagnostics.OK if result.p_value > diagnostics.SIGNIFICANCE else misfit,
        {"distance": result.distance, "tails": result.tails.tolist(), "failed": failed},
    )
    arrays = {
        "predictive_x": simulated,
        "observed_x": np.asarray(run.x),
        "predictive_tails": result.tails,
        "predictive_distances": result.distances,
        "observed_distance": np.asarray(result.distance),
        "predictive_p_value": np.asarray(result.p_value),
    }
    return check, arrays


def _draws(run: Run, key: jax.Array, n: int) -> jax.Array:
    """Draws from the run's own posterior, in inference space."""
    return run.posterior.sample(key, n, space="inference")


def against(run: Run, plan: CalibrationPlan, name: str, reference: np.ndarray) -> Check:
    """How well a classifier separates the run's posterior from reference samples [n, D] in inference space."""
    n = min(len(reference), MAX_ROWS)
    draws = _draws(run, jax.random.fold_in(plan.key(AGAINST), 0), n)
    accuracy = _accuracy(jax.random.fold_in(plan.key(AGAINST), 1), reference[:n], draws)
    numbers = {"accuracy": accuracy, "rows": n}
    return Check(f"classifier, {name}", f"{accuracy:.2f}", "0.5 is best", math.nan, "", numbers)


def read_reference(path: Path, task: Task) -> np.ndarray:
    """Reference samples in inference space, shape [n, D].

    Args:
        path: a .csv with a header row of the parameters' names in any order, or an .npz with an array "theta" [n, D]
            in the parameters' order; in natural units.
        task: the task, for the parameters' names and which of them are inferred as logarithms.

    Raises:
        ValueError: for a file that cannot be read or has other columns, fewer than `MIN_COUNT` rows, or numbers that
            are not finite or, for a parameter inferred as its logarithm, not positive.
    """
    try:
        theta = (_read_npz if path.suffix == ".npz" else _read_csv)(path, task)
    except Exception as error:  # zipfile, csv, numpy and the operating system each have their own
        text = files.first_line(error)
        raise ValueError(f"against: expected a readable file, got {str(path)!r}: {text}") from error
    positive = np.all(theta[:, [name in task.log for name in task.names]] > 0)
    if len(theta) < MIN_COUNT or not np.isfinite(theta).all() or not positive:
        raise ValueError(
            f"against: expected at least {MIN_COUNT} rows of finite numbers in {str(path)!r}, positive ones of "
            f"{', '.join(task.log) or 'no parameter'}, got {len(theta)} rows or others"
        )
    return np.asarray(task.space.to_inference(jnp.asarray(theta, jnp.float32)))


def _read_csv(path: Path, task: Task) -> np.ndarray:
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = [row for row in csv.reader(file) if row]
    heading = [cell.strip() for cell in rows[0]] if rows else []
    if sorted(heading) != sorted(task.names):
        raise ValueError(f"expected the columns {', '.join(task.names)}, got {', '.join(heading) or 'none'}")
    if ragged := next((number for number, row in enumerate(rows, start=1) if len(row) != len(heading)), None):
        raise ValueError(f"expected {len(heading)} numbers in row {ragged}, got {len(rows[ragged - 1])}")
    table = np.array([[float(cell) for cell in row] for row in rows[1:]]).reshape(-1, len(heading))
    return table[:, [heading.index(name) for name in task.names]]


def _read_npz(path: Path, task: Task) -> np.ndarray:
    theta = files.read_arrays(path).get("theta", np.zeros(0))
    if theta.ndim != 2 or theta.shape[1] != task.dim or theta.dtype.kind not in "biuf":
        raise ValueError(f"expected numbers 'theta' of shape [n, {task.dim}], got {theta.dtype} {list(theta.shape)}")
    return theta.astype(np.float64)
