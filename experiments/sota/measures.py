"""Measures of a posterior, from its draws and, if it has one, its density."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from experiments.sota.cases import Case
from jaxlfi import diagnostics

DRAWS = 1000
"""Number of draws from each posterior."""
FLOOR = -30.0
"""Minimum log-density of a point: one outside of the posterior's support would make any mean minus infinity."""


@dataclasses.dataclass(frozen=True)
class Found:
    """The result of a method for a case.

    Attributes:
        draws: draws of the posterior, in inference space, shape [`DRAWS`, D].
        log_prob: log-density of the posterior, normalised on its support, at `points(case)`, shape [P]; None if the
            method has no normalised density.
        seconds: wall time of simulating, training and drawing, without compiling ahead.
        compile_seconds: time of compiling ahead, once for all seeds; 0 if a library compiles as it goes, or not at all.
        simulated: number of simulations used, failures included.
        failed: number of simulations that failed.
        note: deviation from the usual procedure.
    """

    draws: np.ndarray
    log_prob: np.ndarray | None
    seconds: float
    compile_seconds: float
    simulated: int
    failed: int
    note: str = ""


def points(case: Case) -> np.ndarray:
    """Points at which densities are evaluated, shape [P, D]: draws of the exact posterior, or else the truth.

    The mean log-density of draws of the exact posterior is, up to a constant of the case, minus the Kullback-Leibler
    divergence from it.
    """
    return case.truth[None] if case.reference is None else case.reference[:DRAWS]


def judged(case: Case, found: Found) -> dict[str, str]:
    """A row's measures as they are written; those that do not apply are empty.

    `c2st` compares with the exact posterior's draws; `error` is |draw - truth| summed over parameters and averaged over
    draws; `inside` counts the parameters whose central 90 % interval covers the truth; `ranks` are the numbers of draws
    below the truth, parameter by parameter; `log_prob` is the mean log-density at `points`.
    """
    row = dict.fromkeys(("c2st", "error", "inside", "ranks", "log_prob"), "")
    if case.reference is not None:
        row["c2st"] = f"{_accuracy(case.reference, found.draws):.4f}"
    if case.truth is not None:
        ranks = np.sum(found.draws < case.truth, axis=0)
        row["error"] = f"{np.abs(found.draws - case.truth).sum(axis=1).mean():.4f}"
        row["inside"] = str(inside(ranks, len(found.draws)))
        row["ranks"] = " ".join(map(str, ranks))
    if found.log_prob is not None:
        row["log_prob"] = f"{np.maximum(np.nan_to_num(found.log_prob, nan=FLOOR), FLOOR).mean():.4f}"
    return row


def inside(ranks: np.ndarray, draws: int) -> int:
    """The number of ranks [D] in the central 90 %: of 1,000 draws, 50 to 950 are below the truth."""
    return int(np.sum((ranks >= 0.05 * draws) & (ranks <= 0.95 * draws)))


def _accuracy(reference: np.ndarray, draws: np.ndarray) -> float:
    """Accuracy of a classifier of the posterior's draws and the reference's last ones; its first ones are `points`."""
    return float(_C2ST(jax.random.key(1), jnp.asarray(reference[-len(draws) :]), jnp.asarray(draws)))


_C2ST = jax.jit(diagnostics.c2st)
