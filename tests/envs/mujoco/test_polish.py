"""Polish: a run's posterior by least squares, beside the exact one on a grid, and by what it leaves to simulations."""

import dataclasses
import re
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from envs_mujoco import ARM, recorded

from jaxlfi.envs.mujoco import least_squares
from jaxlfi.envs.mujoco import polish as polishing
from jaxlfi.envs.mujoco.least_squares import Fit
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


def test_it_is_the_exact_posterior_where_the_model_is_right(task):
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


@pytest.mark.slow
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
    monkeypatch.setattr(polishing.weighted, "BATCHES", 2)
    found = polish(task, np.asarray(task.observation), draws, task.feasible)
    assert found.mixture is None and "is not that of a Gaussian" in found.sentences[0]
    made = int(re.search(r"Of (\d+) simulations weighted by the likelihood, the effective ", found.sentences[0])[1])
    assert 256 < made <= 512 and found.simulations > fits[0].simulations + made  # none outside of Phi


def test_without_a_point_there_is_none(task, monkeypatch):
    draws = np.array([[0.08, 1.5]])
    (lost,) = least_squares.best_fits(task, draws, 1, stated=True)
    lost.covariance[:] = np.nan
    monkeypatch.setattr(polishing.least_squares, "best_fits", lambda *given, **more: [lost])
    found = polish(task, np.asarray(task.observation), draws, task.feasible)
    assert found.mixture is None and "No draw of it can be simulated" in found.sentences[0]


def made(task, **more):
    """A point at damping 0.08, a gear of 1.5."""
    covariance = np.diag((np.array([0.02, 0.05]) * np.asarray(task.inference.feasible.width, float)) ** 2)
    nothing = np.zeros(2, bool)
    point = Fit(np.array([0.08, 1.5]), 1.0, covariance, np.zeros((2, 2)), np.zeros((2, 0)), nothing, (), 0.0, 0.0, 1)
    return dataclasses.replace(point, **more)


def test_a_point_among_many_minima_leaves_the_posterior_as_it_is(task, monkeypatch):
    own = made(task, reached=1, followed=16)
    monkeypatch.setattr(polishing.least_squares, "best_fits", lambda *given, **more: [own])
    found = polish(task, np.asarray(task.observation), np.array([[0.08, 1.5]]), task.feasible)
    assert found.mixture is None and "Only 1 of 16 starts" in found.sentences[0]


def misjudging(task, monkeypatch, **more):
    """Derivatives at the point misjudge simulations by 2.1 standard deviations; else all is as it is."""
    (own,) = least_squares.best_fits(task, np.array([[0.08, 1.5]]), 1, stated=True)
    several = [own, dataclasses.replace(own, nonlinearity=2.1)]
    several = [dataclasses.replace(one, **more) for one in several]
    monkeypatch.setattr(polishing.least_squares, "best_fits", lambda *given, **more: several)


def test_where_derivatives_predict_nothing_it_is_the_exact_posterior_by_simulations(task, monkeypatch):
    misjudging(task, monkeypatch)
    draws = np.random.default_rng(1).normal([0.085, 1.45], [0.01, 0.12], (64, 2))
    found = polish(task, np.asarray(task.observation), draws, task.feasible)
    assert "polished by" in found.sentences[0] and "weighted by the recording's likelihood" in found.sentences[0]
    mean, covariance = (np.asarray(value, float) for value in (found.mixture.mean, found.mixture.covariance))
    reach = 5 * np.sqrt(np.diagonal(covariance))
    expected, spread = exact(task, mean - reach, mean + reach)
    deviations = np.sqrt(np.diagonal(spread))
    assert (np.abs(mean - expected) < 0.25 * deviations).all()  # five standard errors
    np.testing.assert_allclose(np.sqrt(np.diagonal(covariance)) / deviations, 1.0, atol=0.15)
    correlation = covariance[0, 1] / np.sqrt(np.prod(np.diagonal(covariance)))
    assert abs(correlation - spread[0, 1] / np.prod(deviations)) < 0.1


def test_where_derivatives_predict_nothing_and_noise_does_not_explain_residuals_it_stays_as_it_was(task, monkeypatch):
    misjudging(task, monkeypatch, misfit=1.5)
    found = polish(task, np.asarray(task.observation), np.array([[0.08, 1.5]]), task.feasible)
    assert found.mixture is None and "2.1 standard deviations off" in found.sentences[0]
    assert "residuals are 1.50 times what noise and stated errors amount to" in found.sentences[0]


def test_where_derivatives_predict_somewhat_it_is_polished_by_them(task, monkeypatch):
    misjudging(task, monkeypatch)
    monkeypatch.setattr(polishing, "FORETOLD", 2.2)
    found = polish(task, np.asarray(task.observation), np.array([[0.08, 1.5]]), task.feasible)
    assert found.mixture is not None and "Gauss-Newton steps" in found.sentences[0]


@pytest.mark.parametrize(
    ("effect", "low", "high"),
    [
        (lambda offset: offset, 0.0, 1e-6),
        (lambda offset: offset + 0.1 * offset**2, 0.1, 0.3),  # curved, by a sixth of a standard deviation
        (lambda offset: np.where(offset > 0.05, 4 * offset, offset), 1.0, 9.0),  # a kink beside the point
        (lambda offset: np.clip(offset, -0.01, 0.01), 0.9, 1.1),  # derivatives of a ripple
    ],
    ids=["linear", "curved", "kink", "ripple"],
)
def test_derivatives_that_do_not_reach_over_an_interval_are_found_out(effect, low, high):
    """A parameter in [-10, 10], and residuals that change by one with each unit, at the point."""
    row = np.ones(4) / 2
    point = SimpleNamespace(x=np.zeros(1), fun=np.full(4, 0.3), jac=row[:, None])
    residuals = lambda places: 0.3 + effect(places) * row
    found = least_squares._nonlinearity(
        residuals, point, np.eye(1), np.zeros((1, 0)), np.array([-10.0]), np.array([10.0])
    )
    assert low <= found < high


@pytest.mark.parametrize(
    ("ends", "followed", "doubted"),
    [
        ([1.0, 1.2, 1.0, 1.1], 4, False),
        ([1.2, 1.2, 1.2, 1.0, 1.2, 1.0], 6, False),  # 1.2 would have been taken for the best of the first three
        pytest.param(np.geomspace(3.0, 1.0, 16).tolist(), 16, True, marks=pytest.mark.slow),
    ],
    ids=["agree", "later", "never"],
)
def test_starts_are_followed_until_some_agree(task, monkeypatch, ends, followed, doubted):
    left = iter(ends)
    cost = lambda misfit: 0.5 * misfit**2 * np.asarray(task.observation).size
    ended = lambda *given: SimpleNamespace(x=np.zeros(2), misfit=(misfit := next(left)), cost=cost(misfit))
    monkeypatch.setattr(least_squares, "_solved", ended)
    monkeypatch.setattr(least_squares, "_corrected", lambda task, own, end, *box: made(task, misfit=end.misfit))
    starts = np.stack([np.linspace(0.05, 0.15, 16), np.linspace(1.0, 2.0, 16)], axis=1)
    best = least_squares.best_fits(task, starts)[0]
    assert best.misfit == min(ends[:followed]) and best.followed == followed
    assert bool(best.doubt) == doubted
