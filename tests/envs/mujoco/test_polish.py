"""Polish: a run's posterior by least squares, beside the exact one on a grid, and by what it leaves to simulations."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

from envs_mujoco import ARM, recorded

from jaxlfi.envs.mujoco import least_squares
from jaxlfi.envs.mujoco import polish as polishing
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.model_task import mujoco_task
from jaxlfi.envs.mujoco.parameters import Parameter
from jaxlfi.envs.mujoco.polish import polish
from jaxlfi.envs.mujoco.simulator import simulator_of

NOISE = 0.02
DAMPING = Parameter("joint/shoulder/damping", (0.01, 0.5), unit="N m s/rad", log=True)
GEAR = Parameter("actuator/motor/gear[0]", (0.5, 3.0))


@pytest.fixture(scope="module")
def task():
    """An arm's recording with noise: damping 0.08 N m s/rad, a gear of 1.5."""
    log = recorded()
    angle = log.signals["angle"] + NOISE * np.random.default_rng(0).standard_normal(len(log.times))
    return mujoco_task(ARM, [DAMPING, GEAR], Log(log.times, {"motor": log.signals["motor"], "angle": angle}),
                       noises={"angle": NOISE})  # fmt: skip


def exact(task, low, high, points=14):
    """Mean and covariance over (ln damping, gear) by the likelihood of white noise on a grid.

    Sums over a grid of less than a standard deviation are a Gaussian's integrals to many digits.
    """
    axes = [np.linspace(a, b, points) for a, b in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    clean, _ = simulator_of(task).clean(np.stack([np.exp(places[:, 0]), places[:, 1]], axis=1))
    misfit = 0.5 * np.sum((clean - np.asarray(task.observation)) ** 2, axis=(1, 2)) / NOISE**2
    weights = np.exp(misfit.min() - misfit)
    weights /= weights.sum()
    mean = weights @ places
    return mean, (places - mean).T @ (weights[:, None] * (places - mean))


def test_it_is_the_exact_posterior_where_the_model_is_right(task, monkeypatch):
    # The recording was made by the model's own integrator.
    monkeypatch.setattr(least_squares.Residuals, "correct", lambda residuals, point: None)
    draws = np.stack([np.random.default_rng(1).uniform(0.04, 0.2, 8), np.linspace(1.0, 2.2, 8)], axis=1)
    found = polish(task, np.asarray(task.observation), draws, task.feasible)
    assert len(found.mixture.logits) == 1 and found.simulations > 8
    mean, covariance = (np.asarray(value, float) for value in (found.mixture.mean, found.mixture.covariance))
    reach = 5 * np.sqrt(np.diagonal(covariance))
    expected, spread = exact(task, mean - reach, mean + reach)
    deviations = np.sqrt(np.diagonal(spread))
    assert (np.abs(mean - expected) < 0.2 * deviations).all()
    # It allows for errors of the model, which white noise may look like: it may be wider, and hardly narrower.
    assert (np.sqrt(np.diagonal(covariance)) / deviations > 0.8).all()
    assert (np.sqrt(np.diagonal(covariance)) / deviations < 1.6).all()
    correlation = covariance[0, 1] / np.sqrt(np.prod(np.diagonal(covariance)))
    assert abs(correlation - spread[0, 1] / np.prod(deviations)) < 0.25


def test_what_a_recording_does_not_determine_is_left_to_the_simulations(task):
    sliding = Parameter("geom/rod/friction[0]", (0.2, 2.0))  # nothing touches the rod
    log = recorded()
    log = Log(log.times, {name: log.signals[name] for name in ("motor", "angle")})
    own = mujoco_task(ARM, [DAMPING, sliding], log, noises={"angle": NOISE})
    low, width = (np.asarray(end, float) for end in (own.inference.feasible.low, own.inference.feasible.width))
    places = np.random.default_rng(2).normal([0.7, 0.6], [0.05, 0.1], (64, 2))
    found = polish(
        own, np.asarray(own.observation), np.asarray(own.space.to_natural(low + width * places)), own.feasible
    )
    mean = (np.asarray(found.mixture.mean, float) - low) / width
    deviations = np.sqrt(np.diagonal(np.asarray(found.mixture.covariance, float))) / width
    assert abs(mean[1] - places[:, 1].mean()) < 0.03 and abs(deviations[1] / places[:, 1].std() - 1) < 0.25
    assert abs(low[0] + width[0] * mean[0] - np.log(0.08)) < 0.05 and deviations[0] < 0.02


def test_a_likelihood_that_is_no_gaussian_leaves_the_posterior_as_it_was(task, monkeypatch):
    jagged = np.random.default_rng(3)
    clean = simulator_of(task).clean

    def rough(theta, *given, **more):
        """What is simulated, and an offset that no two points have in common."""
        rows, outcome = clean(theta, *given, **more)
        return rows + NOISE * jagged.standard_normal((len(rows), 1, 1)), outcome

    draws = np.stack([np.full(8, 0.08), np.linspace(1.4, 1.6, 8)], axis=1)
    fits = least_squares.best_fits(task, draws, 1, stated=True)
    monkeypatch.setattr(polishing.least_squares, "best_fits", lambda *given, **more: fits)
    monkeypatch.setattr(simulator_of(task), "clean", rough)
    found = polish(task, np.asarray(task.observation), draws, task.feasible)
    assert found.mixture is None and "is not that of a Gaussian" in found.sentences[0]
    assert found.simulations > fits[0].simulations


def test_without_a_point_there_is_none(task, monkeypatch):
    draws = np.array([[0.08, 1.5]])
    (lost,) = least_squares.best_fits(task, draws, 1, stated=True)
    lost.covariance[:] = np.nan
    monkeypatch.setattr(polishing.least_squares, "best_fits", lambda *given, **more: [lost])
    found = polish(task, np.asarray(task.observation), draws, task.feasible)
    assert found.mixture is None and "no draw of it can be simulated" in found.sentences[0]
