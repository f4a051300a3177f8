"""Polish: a run's posterior, sharpened by least squares from its draws.

A thousand simulations find the region. Gauss-Newton steps from the best draws find the points in it that fit best, and
the uncertainty of each, which allows for the model's errors: those that the task's file states, as in the simulations,
or else those that residuals show (`least_squares`). This gives a Gaussian for each point. As simulations are not linear
in the parameters, further ones around the point correct its moments (`importance`). Along directions that the recording
does not determine, and for parameters that least squares does not estimate, the posterior is that of the simulations.

Where derivatives at the point do not predict simulations around it, or these do not confirm the Gaussian, as with
contacts or a cart that sticks and slips, the posterior is learnt from the likelihood of simulations alone, starting at
the draws (`weighted`), if noise and stated errors explain the residuals. Otherwise, or if too few simulations are
likely, it stays as it was.

If the model's errors are estimated from the residuals, the Gaussian is wider than the likelihood of independent
residuals. This likelihood is then evaluated nearer to the point, by a linear map that gives it the Gaussian's curvature
there (Chandler and Bate 2007).
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.untruncated import untruncated
from jaxlfi.envs.mujoco import forces, least_squares, weighted
from jaxlfi.envs.mujoco.importance import DRAWS, ENOUGH, Moments, moments
from jaxlfi.envs.mujoco.least_squares import Fit, Residuals
from jaxlfi.tasks.polish import Counted, Polished
from jaxlfi.tasks.task import Task

KEEP = 4
"""Draws that Gauss-Newton steps are followed from, unless these disagree, and points that are kept at most."""
LEAST = 1e-7
"""Smallest standard deviation of a Gaussian, as a fraction of Phi's width."""
TOGETHER = 64
"""Points that are simulated together, to limit the memory for long recordings."""
FORETOLD = 2.0
"""Error of derivatives at a point, in standard deviations (`Fit.nonlinearity`), above which a Gaussian's moments by a
few hundred simulations cannot be trusted either."""
LACKS = 1.3
"""Residuals in units of the noise above which the model is reported to lack something."""


def polish(task: Task, observed: np.ndarray, draws: np.ndarray, box: Support, counted: Counted = iter) -> Polished:
    """The posterior by least squares, or why it stays as it was.

    Args:
        task: of a MuJoCo model.
        observed: the recording.
        draws: of the posterior by simulations, in natural units, shape [N, D].
        box: that points stay in, in natural units.
        counted: iterates over the draws that are followed, and over the points that they lead to.
    """
    fits = least_squares.best_fits(task, draws, KEEP, box, observed, counted, stated=True)
    good = least_squares.as_good(fits)
    if not good or not np.isfinite([one.covariance for one in good]).all():
        return Polished(None, _refused("No draw of it can be simulated."), (), len(draws))
    if good[0].alone:
        return Polished(None, _refused(good[0].alone), (), good[0].simulations)
    inner = task.space.box_to_inference(box)
    if (off := max(one.nonlinearity for one in good)) > FORETOLD:
        why = (
            "Around the point of least squares, simulations are not what derivatives at the point predict: they are "
            f"{off:.1f} standard deviations off, as with contacts or dry friction."
        )
        return _by_simulations(task, observed, draws, good[0], inner, counted, why)
    places = np.asarray(task.space.to_inference(draws), float)
    rng, spent, parts = np.random.default_rng(0), good[0].simulations, []
    for i in counted(range(len(good))):
        one = good[i]
        own = _gaussian(task, one, places)
        if not own.known.size:
            return Polished(None, _refused("By least squares, the recording determines no parameter."), (), spent)
        density = _Density(task, observed, one, own, inner)
        found = moments(rng, density, len(own.mean))
        spent += density.residuals.simulations
        if found.counted < ENOUGH:
            why = (
                "Around the point of least squares, the recording's likelihood is not that of a Gaussian: the "
                f"effective sample size is {found.counted:.0%} of {DRAWS} draws. Contacts, for example, make it jagged."
            )
            return _by_simulations(
                task, observed, draws, dataclasses.replace(good[0], simulations=spent), inner, counted, why
            )
        parts.append((own, found))
    means, factors = zip(*(own.moved(found) for own, found in parts), strict=True)
    mixture = GaussianMixture(
        # Points that explain the recording equally well are weighted by how much of Phi does so around each.
        jnp.asarray([found.log_mass + own.log_volume for own, found in parts], jnp.float32),
        jnp.asarray(np.stack(means), jnp.float32),
        jnp.asarray(np.stack(factors), jnp.float32),
    )
    return Polished(untruncated(mixture, inner), _sentences(task, good), _steps(good), spent)


def _by_simulations(
    task: Task,
    observed: np.ndarray,
    draws: Float[np.ndarray, "n dim"],
    best: Fit,
    inner: Support,
    counted: Counted,
    why: str,
) -> Polished:
    """The posterior from simulations weighted by the recording's likelihood, in place of a Gaussian.

    Args:
        task: of a MuJoCo model.
        observed: the recording.
        draws: of the posterior by simulations, in natural units.
        best: the point of least squares.
        inner: the box that draws stay in, in inference space.
        counted: iterates over the batches of simulations.
        why: sentences that say why a Gaussian is not adequate.
    """
    residuals = Residuals(task, observed, stated=True)
    if forces.beyond_noise(best.misfit**2 * residuals.measurements, residuals.measurements - int(best.informed.sum())):
        beyond = f"And residuals are {best.misfit:.2f} times what noise and stated errors amount to."
        return Polished(None, _refused(f"{why} {beyond}"), (), best.simulations)
    places = np.asarray(task.space.to_inference(draws), float)
    mean, deviations = places.mean(axis=0), np.maximum(places.std(axis=0), LEAST * np.asarray(inner.width, float))
    residuals.correct(np.asarray(task.space.to_inference(best.theta), float), integrator=best.defect > 0)

    def log_density(y: Float[np.ndarray, "n dim"]) -> Float[np.ndarray, " n"]:
        return _log_posterior(task, residuals, inner, mean + deviations * y)

    correlation = np.cov(((places - mean) / deviations).T, ddof=0).reshape(2 * mean.shape) + LEAST * np.eye(len(mean))
    before = residuals.simulations
    found = weighted.learnt(np.random.default_rng(0), log_density, correlation, counted)
    made, spent = residuals.simulations - before, best.simulations + residuals.simulations
    if found.size < weighted.ENOUGH:
        few = f"Of {made:,} simulations weighted by the likelihood, the effective sample size is {found.size:.0f}."
        return Polished(None, _refused(f"{why} {few}"), (), spent)
    mixture = found.mixture.affine(jnp.asarray(deviations, jnp.float32), jnp.asarray(mean, jnp.float32))
    sentences = (
        f"The posterior was polished by {made:,} simulations, weighted by the recording's likelihood (effective "
        f"sample size {found.size:.0f}), as simulations around the point of least squares are not what derivatives "
        f"there predict. Residuals at the point are {best.misfit:.2f} times what noise and stated errors amount to.",
    )
    return Polished(untruncated(mixture, inner), sentences, _steps([best]), spent)


def _log_posterior(
    task: Task, residuals: Residuals, inner: Support, places: Float[np.ndarray, "n dim"]
) -> Float[np.ndarray, " n"]:
    """The log-posterior by the likelihood of independent residuals, up to a constant; -inf outside the box."""
    log = np.full(len(places), -np.inf)
    inside = _within(inner, places)
    log[inside] = _log_likelihood(residuals, places[inside])
    if (prior := task.inference.prior) is not None:
        log += np.asarray(prior.log_prob(jnp.asarray(places, jnp.float32)), float)
    return log


def _within(box: Support, places: Float[np.ndarray, "n dim"]) -> Bool[np.ndarray, " n"]:
    inside = (places >= np.asarray(box.low, float)) & (places <= np.asarray(box.high, float))
    return np.all(inside, axis=1)


def _log_likelihood(residuals: Residuals, places: Float[np.ndarray, "n dim"]) -> Float[np.ndarray, " n"]:
    parts = [residuals(places[first : first + TOGETHER]) for first in range(0, len(places), TOGETHER)]
    return np.concatenate([-0.5 * np.sum(part**2, axis=1) for part in parts]) if parts else np.zeros(0)


class _Gaussian(NamedTuple):
    """Around a point: mean + known y + unknown y', with y and y' independent standard normals, in inference space."""

    mean: Float[np.ndarray, " dim"]
    known: Float[np.ndarray, "dim k"]
    unknown: Float[np.ndarray, "dim rest"]

    @property
    def factor(self) -> Float[np.ndarray, "dim dim"]:
        """Both factors side by side."""
        return np.concatenate([self.known, self.unknown], axis=1)

    @property
    def log_volume(self) -> float:
        """Logarithm of the volume in inference space of a unit volume of the standard normals."""
        return float(np.linalg.slogdet(self.factor)[1])

    def moved(self, found: Moments) -> tuple[np.ndarray, np.ndarray]:
        """Mean and Cholesky factor, given moments of the normals."""
        covariance = self.factor @ found.covariance @ self.factor.T
        return self.mean + self.factor @ found.mean, np.linalg.cholesky(covariance)


def _gaussian(task: Task, one: Fit, places: Float[np.ndarray, "n dim"]) -> _Gaussian:
    """A point's Gaussian along what it determines, and the draws' along the rest."""
    phi = task.inference.feasible
    width = np.asarray(phi.high, float) - np.asarray(phi.low, float)
    mean = np.asarray(task.space.to_inference(one.theta), float) / width
    others = scipy.linalg.orth(one.uninformed / width[:, None]) if one.uninformed.size else np.zeros((len(mean), 0))
    own = scipy.linalg.null_space(others.T) if others.size else np.eye(len(mean))
    draws = places / width
    root = lambda covariance: np.linalg.cholesky(covariance + LEAST**2 * np.eye(len(covariance)))
    known = own @ root(own.T @ (one.covariance / np.outer(width, width)) @ own)
    unknown = others @ root(np.atleast_2d(np.cov((draws @ others).T))) if others.size else others
    mean = own @ own.T @ mean + others @ others.T @ draws.mean(axis=0)
    return _Gaussian(width * mean, width[:, None] * known, width[:, None] * unknown)


class _Density:
    """The logarithm of the posterior near a point, relative to that there, as a function of a Gaussian's normals."""

    def __init__(self, task: Task, observed: np.ndarray, one: Fit, gaussian: _Gaussian, box: Support):
        """Simulate what the likelihood near the point needs, and its curvature there."""
        self._gaussian, self._box, self._prior = gaussian, box, task.inference.prior
        self._count, phi = gaussian.known.shape[1], task.inference.feasible
        self.residuals = Residuals(task, observed, stated=True)
        self.residuals.correct(np.asarray(task.space.to_inference(one.theta), float), integrator=one.defect > 0)
        jacobian = self.residuals.jacobian(gaussian.mean, np.asarray(phi.low, float), np.asarray(phi.high, float))
        # The curvature for independent residuals differs from the Gaussian's, which is 1.
        _, sizes, axes = np.linalg.svd(jacobian @ gaussian.known, full_matrices=False)
        self._nearer = axes.T / np.maximum(sizes, LEAST) @ axes
        self._there = _log_likelihood(self.residuals, gaussian.mean[None])[0]

    def __call__(self, y: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
        known, rest = np.split(y, [self._count], axis=1)
        beside = rest @ self._gaussian.unknown.T
        theta = self._gaussian.mean + known @ self._gaussian.known.T + beside
        log = np.full(len(y), -np.inf)
        inside = _within(self._box, theta)
        nearer = self._gaussian.mean + known @ self._nearer @ self._gaussian.known.T + beside
        log[inside] = (
            _log_likelihood(self.residuals, nearer[inside]) - self._there - 0.5 * np.sum(rest[inside] ** 2, axis=1)
        )
        if self._prior is not None:
            log += np.asarray(self._prior.log_prob(jnp.asarray(theta, jnp.float32)), float)
        return log


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


def _refused(why: str) -> tuple[str, ...]:
    return (f"The posterior was not polished. {why}",)


def _steps(good: Sequence[Fit]) -> tuple[str, ...]:
    if good[0].misfit < LACKS:
        return ()
    return ("See what the model lacks, as lines for the task's file: `jaxlfi mujoco fit FOLDER`.",)
