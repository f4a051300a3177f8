"""Polish: a run's posterior, sharpened by least squares from its draws.

A thousand simulations find the region. Gauss-Newton steps from the best draws find the points in it that fit best, and
around each, how far the recording determines it, with what the model gets wrong: by what the task's file says of that,
as in the simulations, or else as residuals show it (`least_squares`). That is a Gaussian for each point. Along what the
recording does not determine, and in what least squares does not estimate, the posterior is that of the simulations.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
import scipy.linalg

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.envs.mujoco import least_squares
from jaxlfi.envs.mujoco.least_squares import Fit
from jaxlfi.tasks.polish import Counted, Polished
from jaxlfi.tasks.task import Task

KEEP = 4
"""Draws that Gauss-Newton steps are followed from, at most."""
LEAST = 1e-7
"""Standard deviation of a Gaussian, at least, as a fraction of Phi's width."""
LACKS = 1.3
"""Residuals in units of the noise from which on the model is said to lack something."""


def polish(
    task: Task, observed: np.ndarray, draws: np.ndarray, box: Support, counted: Counted = iter
) -> Polished | None:
    """The posterior by least squares; None where no draw can be simulated, and none in it where it is in doubt.

    Args:
        task: of a MuJoCo model.
        observed: the recording.
        draws: of the posterior by simulations, in natural units, shape [N, D].
        box: that points stay in, in natural units.
        counted: goes through the draws that are followed.
    """
    fits = least_squares.best_fits(task, draws, KEEP, box, observed, counted, stated=True)
    good = least_squares.as_good(fits)
    if not good or not np.isfinite([one.covariance for one in good]).all():
        return None
    if doubts := list(dict.fromkeys(one.doubt for one in good if one.doubt)):
        return Polished(None, (f"The posterior was not polished. {doubts[0]}",), (), good[0].simulations)
    phi = task.inference.feasible
    low, width = np.asarray(phi.low, float), np.asarray(phi.high, float) - np.asarray(phi.low, float)
    places = (np.asarray(task.space.to_inference(draws), float) - low) / width
    parts = [_gaussian(task, one, places, low, width) for one in good]
    factors = np.stack([np.linalg.cholesky(covariance) for _, covariance in parts])
    mixture = GaussianMixture(
        # Of points that explain the recording as well: by how much of Phi does so around each (Laplace's method).
        jnp.asarray(np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1), jnp.float32),
        jnp.asarray(low + width * np.stack([mean for mean, _ in parts]), jnp.float32),
        jnp.asarray(width[:, None] * factors, jnp.float32),
    )
    return Polished(mixture, _sentences(task, good), _steps(good), good[0].simulations)


def _gaussian(
    task: Task, one: Fit, places: np.ndarray, low: np.ndarray, width: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of a point, in Phi's unit box; of the draws, along what it does not determine."""
    mean = (np.asarray(task.space.to_inference(one.theta), float) - low) / width
    others = scipy.linalg.orth(one.uninformed / width[:, None]) if one.uninformed.size else np.zeros((len(mean), 0))
    unknown = others @ others.T
    known = np.eye(len(mean)) - unknown
    covariance = known @ (one.covariance / np.outer(width, width)) @ known
    covariance += unknown @ np.atleast_2d(np.cov(places.T)) @ unknown
    return known @ mean + unknown @ places.mean(axis=0), covariance + LEAST**2 * np.eye(len(mean))


def _sentences(task: Task, good: Sequence[Fit]) -> tuple[str, ...]:
    where = (
        "to one point"
        if len(good) == 1
        else f"to {len(good)} points that explain the recording as well, with a mode of the posterior at each"
    )
    allowed = (
        "times what the file's noise and model errors amount to"
        if least_squares.says_errors(task)
        else "times the noise, and intervals allow for what the model gets wrong"
    )
    return (
        f"The posterior was polished: Gauss-Newton steps from its draws led {where}. Residuals are "
        f"{good[0].misfit:.2f} {allowed}.",
    )


def _steps(good: Sequence[Fit]) -> tuple[str, ...]:
    if good[0].misfit < LACKS:
        return ()
    return ("See what the model lacks, as lines for the task's file: `jaxlfi mujoco fit FOLDER`.",)
