"""Robust estimates, against SciPy's minima of the same losses and exact posterior means, and with false readings."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, stats

from jaxlfi.estimators.clipping import LARGEST, clipping
from jaxlfi.estimators.regression import Regression, unfitted
from jaxlfi.estimators.robust_estimates import FARTHEST, RobustEstimates, no_robust_estimates, robust_estimates

PLACES = np.linspace(0, 3, 30)
fit = jax.jit(robust_estimates)
estimated = jax.jit(lambda model, z: model(z))
left_of = jax.jit(lambda model, z: model.residuals(z))
single = lambda values: jnp.asarray(values, jnp.float32)


def swings(n, seed, false=0.0, noise=0.05):
    """Oscillations whose frequency and amplitude are inferred; a fraction `false` of the readings is arbitrary."""
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=(n, 2)) * [0.1, 0.2] + [1.5, 1.0]
    x = theta[:, 1:] * np.cos(theta[:, :1] * PLACES) + noise * rng.normal(size=(n, len(PLACES)))
    return theta, np.where(rng.uniform(size=x.shape) < false, rng.uniform(-3, 3, x.shape), x)


def tukey(residual):
    """Tukey's loss: quadratic at zero, and flat from `FARTHEST` on."""
    return FARTHEST**2 / 6 * (1 - np.maximum(1 - (residual / FARTHEST) ** 2, 0) ** 3)


def huber(residual):
    """Huber's loss: quadratic up to `LARGEST`, and linear beyond."""
    size = np.abs(residual)
    return np.where(size < LARGEST, 0.5 * size**2, LARGEST * (size - 0.5 * LARGEST))


@pytest.mark.parametrize("noise", [0.05, 0.2])
def test_an_estimate_is_the_best_by_tukeys_loss(noise):
    """Residuals are in units of the row's own deviation about Huber's estimate, if that is larger than usual."""
    theta, z = swings(400, 0, false=0.1)
    found, *_ = fit(single(z), single(theta), jnp.ones(400, bool))
    _, rows = swings(6, 5, false=0.1, noise=noise)
    model, scale = np.asarray(found.model, float), np.asarray(found.scale, float)
    units = []
    for row, estimate in zip(rows, np.asarray(estimated(found, single(rows))), strict=True):
        left = lambda t, row=row: (row - np.r_[1, t, t[0] ** 2, t[0] * t[1], t[1] ** 2] @ model) / scale
        first = optimize.minimize(lambda t, left=left: huber(left(t)).sum() + 0.5 * t @ t, np.zeros(2), tol=1e-10).x
        unit = max(1.0, np.sqrt(30 / 28) * np.median(np.abs(left(first))) / stats.norm.ppf(0.75))
        best = optimize.minimize(
            lambda t, left=left, unit=unit: tukey(left(t) / unit).sum() + 0.5 * t @ t, first, tol=1e-10
        ).x
        np.testing.assert_allclose(estimate, best, atol=5e-3)
        units.append(unit)
    assert (np.mean(units) > 2) == (noise > 0.1)


def test_the_model_is_the_best_by_tukeys_loss():
    theta, z = swings(600, 1, false=0.1)
    counted = np.arange(600) < 500
    z[~counted] = np.nan
    found, *_ = fit(single(z), single(theta), jnp.asarray(counted))
    own = theta[counted]
    t = (own - own.mean(0)) / own.std(0)
    design = np.c_[np.ones(500), t, t[:, 0] ** 2, t[:, 0] * t[:, 1], t[:, 1] ** 2]
    for place in (0, 13, 29):
        target, scale = z[counted, place], float(found.scale[place])
        loss = lambda b, target=target, scale=scale: tukey((target - design @ b) / scale).sum()
        best = optimize.minimize(loss, np.asarray(found.model[:, place], float), tol=1e-10).x
        np.testing.assert_allclose(found.model[:, place], best, atol=0.05 * scale)
        usual = np.median(np.abs(target - design @ np.asarray(found.model[:, place]))) / stats.norm.ppf(0.75)
        assert scale == pytest.approx(usual, rel=1e-3)
        assert 0.8 < scale / 0.05 < 1.5  # relative to the noise: false readings do not count


@pytest.mark.parametrize("false", [0.0, 0.15])
def test_false_readings_hardly_move_them(false):
    """Errors, compared with exact ones of a linear model without false readings and with those of clipped numbers."""
    theta, z = swings(2000, 2, false)
    every = jnp.ones(1000, bool)
    own, new = single(z[:1000]), single(z[1000:])
    model, by_others, residuals = fit(own, single(theta[:1000]), every)
    left = lambda values, of: np.sqrt(np.mean((theta[of] - _linear(values, theta[of])) ** 2, axis=0)) / [0.1, 0.2]
    fresh = left(np.asarray(estimated(model, new)), slice(1000, None))
    np.testing.assert_allclose(left(np.asarray(by_others), slice(0, 1000)), fresh, rtol=0.1)  # as large as on new rows
    spread = np.median(np.abs(left_of(model, new))) / stats.norm.ppf(0.75)
    assert np.median(np.abs(residuals)) / stats.norm.ppf(0.75) == pytest.approx(spread, rel=0.04)
    assert spread == pytest.approx(1, abs=0.1)
    slopes = np.stack([-PLACES * np.sin(1.5 * PLACES), np.cos(1.5 * PLACES)]) * [[0.1], [0.2]]
    exact = np.sqrt(np.diag(np.linalg.inv(slopes @ slopes.T * (1 - false) / 0.05**2 + np.eye(2))))
    assert np.all(fresh < 1.25 * exact)
    clipped = np.asarray(jax.jit(clipping)(own, single(theta[:1000]), every)(new))
    assert np.all(left(clipped, slice(1000, None)) > (1.3 if false else 0.9) * fresh)


def test_rows_noisier_than_most_are_estimated_as_well_as_their_noise_allows():
    theta, z = swings(1000, 6)
    model, *_ = fit(single(z), single(theta), jnp.ones(1000, bool))
    truth, noisy = swings(1000, 7, noise=0.25)
    estimates = np.asarray(estimated(model, single(noisy)))
    left = np.std((truth - _linear(estimates, truth)) / [0.1, 0.2], axis=0)
    slopes = np.stack([-PLACES * np.sin(1.5 * PLACES), np.cos(1.5 * PLACES)]) * [[0.1], [0.2]]
    exact = np.sqrt(np.diag(np.linalg.inv(slopes @ slopes.T / 0.25**2 + np.eye(2))))
    assert np.all(left < 1.25 * exact), (left, exact)


def _linear(values, target):
    design = np.c_[np.ones(len(values)), values]
    return design @ np.linalg.lstsq(design, target, rcond=None)[0]


def test_regressions_use_them_where_they_help():
    for false, helps in ((0.0, False), (0.15, True)):
        theta, z = swings(1200, 3, false)
        x, every = single(z[:1000]), jnp.ones(1000, bool)
        regression, _ = jax.jit(Regression.fitted)(unfitted(2, 30, 30), single(theta[:1000]), x, every, every)
        used = np.abs(np.asarray(regression.coefficients)[:, -2:]).sum(axis=1) > 0
        assert used.all() == helps


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("alike", [0.0, 1e-5, 1e-3])
def test_parameters_that_act_alike_leave_everything_finite(alike, noise):
    """For example two stiffnesses of which only the sum matters, in a simulator without noise."""
    rng = np.random.default_rng(4)
    theta, responses = rng.normal(size=(500, 3)), rng.normal(size=(3, 60)) / 2
    responses[1] = responses[0] + alike * responses[1]
    z = single(theta @ responses + noise * rng.normal(size=(500, 60)))
    every = jnp.ones(500, bool)
    clip = jax.jit(clipping)(z, single(theta), every)
    assert np.isfinite(jax.jit(lambda clip, z: clip(z))(clip, z)).all()
    found, by_others, _ = fit(z, single(theta), every)
    for estimates in (by_others, estimated(found, z)):
        assert np.isfinite(estimates).all()
        third = (theta[:, 2] - theta[:, 2].mean()) / theta[:, 2].std()
        assert np.median(np.abs(estimates[:, 2] - third)) < 0.02
        total = theta[:, 0] + theta[:, 1]
        assert np.median(np.abs(_linear(np.asarray(estimates[:, :2]), total) - total)) < 0.02


def test_before_there_are_simulations_they_are_zero():
    none = no_robust_estimates(3, 12)
    assert isinstance(none, RobustEstimates)
    np.testing.assert_array_equal(none(jnp.ones((4, 12))), np.zeros((4, 3)))
