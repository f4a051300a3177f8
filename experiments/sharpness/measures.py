"""Measures of a run's posterior against the exact one, and their summaries over many runs."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from experiments.sharpness.problem import Case
from experiments.sharpness.references import Reference
from jaxlfi import diagnostics

CLASSIFIED = 1000
"""Draws of either posterior that the classifier sees."""
LOST = 3.0
"""Distance of means, in the larger of both standard deviations, above which a run is lost."""
KEPT = 0.05
"""Fraction of a box's width that a bound may move by while the box counts as kept."""
LEVELS = (0.5, 0.9)

Rows = Mapping[str, np.ndarray]
"""Arrays by name, with a leading axis of one entry per run."""


def judged(
    case: Case, draws: np.ndarray, density_rank: float, end: tuple[np.ndarray, np.ndarray], exact: Reference | None
) -> dict[str, np.ndarray]:
    """The measures of a run that are kept.

    Args:
        case: its truth.
        draws: of its posterior, in inference space, shape [N, D].
        density_rank: the share of its draws whose density is higher than the truth's.
        end: the support that it ended with.
        exact: the exact posterior on that support; None where there is none.

    Returns:
        `truth`, `end_low`, `end_high`, `mean`, `sd`, `exact_mean`, `exact_sd`, `rank` and `exact_rank` (the share of
        draws below the truth), shape [D]; `density_rank`, `exact_density_rank`, `c2st` and `size`, the exact
        posterior's effective size, shape [].
    """
    unknown, nothing = np.full(case.problem.dim, np.nan), np.float64(np.nan)
    found = {
        "truth": case.truth,
        "end_low": np.asarray(end[0], float),
        "end_high": np.asarray(end[1], float),
        "mean": draws.mean(axis=0),
        "sd": draws.std(axis=0),
        "rank": np.mean(draws < case.truth, axis=0),
        "density_rank": np.float64(density_rank),
    }
    if exact is None:
        vectors = dict.fromkeys(("exact_mean", "exact_sd", "exact_rank"), unknown)
        return found | vectors | dict.fromkeys(("exact_density_rank", "c2st", "size"), nothing)
    # Estimated densities of draws, which were picked by them, cannot be compared with the truth's.
    exact_density_rank = nothing if case.problem.estimated else np.mean(exact.log_density > exact.truth_log_density)
    return found | {
        "exact_mean": exact.draws.mean(axis=0),
        "exact_sd": exact.draws.std(axis=0),
        "exact_rank": np.mean(exact.draws < case.truth, axis=0),
        "exact_density_rank": np.float64(exact_density_rank),
        "c2st": _accuracy(exact.draws, draws) if case.problem.shaped and case.kind == "own" else nothing,
        "size": np.float64(exact.size),
    }


def _accuracy(exact: np.ndarray, draws: np.ndarray) -> np.float64:
    count = min(CLASSIFIED, len(exact), len(draws))
    if count < CLASSIFIED or not np.isfinite(draws).all():
        return np.float64(np.nan)
    first, second = (jnp.asarray(sample[:count], jnp.float32) for sample in (exact, draws))
    return np.float64(diagnostics.c2st(jax.random.key(1), first, second))


def ellipsoid_rank(draws: np.ndarray, truth: np.ndarray) -> float:
    """The share of draws nearer to their mean than a truth is, in Mahalanobis distance.

    It replaces `density_rank` where a method's density is not available.
    """
    mean, covariance = draws.mean(axis=0), np.atleast_2d(np.cov(draws, rowvar=False))
    inverse = np.linalg.pinv(covariance)
    distance = lambda theta: np.einsum("...d,de,...e->...", theta - mean, inverse, theta - mean)
    return float(np.mean(distance(draws) < distance(truth)))


def ratios(rows: Rows) -> np.ndarray:
    """Standard deviations divided by the exact ones, shape [N, D]."""
    return rows["sd"] / rows["exact_sd"]


def geometric_mean(values: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Geometric mean of the known numbers."""
    with np.errstate(divide="ignore"):
        logs = np.log(values)
    known = np.isfinite(logs)
    count = known.sum(axis=axis)
    return np.where(count, np.exp(np.where(known, logs, 0.0).sum(axis=axis) / np.maximum(count, 1)), np.nan)


def worst(rows: Rows) -> float:
    """The ratio of the parameter whose geometric mean over runs is farthest from 1, as a factor."""
    each = geometric_mean(ratios(rows), axis=0)
    return float(each[np.argmax(np.nan_to_num(np.abs(np.log(each)), nan=-1.0))])


def distances(rows: Rows) -> np.ndarray:
    """Distances of means from the exact ones, in exact standard deviations, shape [N, D]."""
    return np.abs(rows["mean"] - rows["exact_mean"]) / rows["exact_sd"]


def lost(rows: Rows) -> np.ndarray:
    """Runs whose last support excludes the truth, or whose mean is far from the exact one, shape [N]."""
    excluded = ~holds_truth(rows)
    gap = np.abs(rows["mean"] - rows["exact_mean"]) / np.maximum(rows["sd"], rows["exact_sd"])
    return excluded | np.any(np.nan_to_num(gap, nan=0.0) > LOST, axis=1)


def holds_truth(rows: Rows) -> np.ndarray:
    """Runs whose last support holds the truth, shape [N]."""
    return np.all((rows["truth"] >= rows["end_low"]) & (rows["truth"] <= rows["end_high"]), axis=1)


def kept(rows: Rows) -> np.ndarray:
    """Runs none of whose bounds moved by more than `KEPT` of the box's width, shape [N]."""
    width = rows["high"] - rows["low"]
    moved = [np.abs(rows[f"end_{side}"] - rows[side]) / width for side in ("low", "high")]
    return np.all(np.maximum(*moved) <= KEPT, axis=1)


def covered(density_rank: np.ndarray, level: float) -> float:
    """The share of truths inside highest-density regions."""
    known = density_rank[np.isfinite(density_rank)]
    return float(np.mean(known < level)) if len(known) else np.nan


def covered_each(rank: np.ndarray, level: float) -> float:
    """The share of truths inside central credible intervals, over runs and parameters."""
    known = rank[np.isfinite(rank)]
    return float(np.mean(np.abs(known - 0.5) < 0.5 * level)) if len(known) else np.nan
