"""Predictors without outliers, against SciPy and the exact posterior means of a line with heavy-tailed noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, stats

from jaxlfi.estimators.clipping import LARGEST, LEAST, clipping, no_clipping
from jaxlfi.estimators.regression import Regression, unfitted
from jaxlfi.estimators.ridge import ridge

PLACES = np.linspace(0, 3, 25)
fitted_limits = jax.jit(clipping)
clipped = jax.jit(lambda clip, z: clip(z))
residuals_of = jax.jit(lambda clip, z: clip.residuals(z))
fitted = jax.jit(Regression.fitted)
single = lambda values: jnp.asarray(values, jnp.float32)


def lines(n, seed, noise):
    """Lines whose level and slope are inferred, with a third parameter that has no effect."""
    rng = np.random.default_rng(seed)
    theta = rng.uniform(-1, 1, (n, 3))
    return theta, theta[:, :1] + theta[:, 1:2] * PLACES + noise.rvs((n, len(PLACES)), random_state=rng)


def huber(residual, limit):
    """Huber's loss: quadratic up to a limit, and linear beyond."""
    return np.where(np.abs(residual) < limit, 0.5 * residual**2, limit * (np.abs(residual) - 0.5 * limit))


def test_responses_are_hubers_regressions():
    theta, z = lines(400, 0, stats.t(2))
    counted = np.arange(400) < 300
    z[~counted] = np.nan
    found = fitted_limits(single(z), single(theta), jnp.asarray(counted))
    own = theta[counted]
    design = np.c_[(own - own.mean(0)) / own.std(0), np.ones(300)]
    for place in (0, 11):
        target = z[counted, place]
        usual = lambda coefficients, target=target: (
            np.median(np.abs(target - design @ coefficients)) / stats.norm.ppf(0.75)
        )
        start = np.linalg.lstsq(design, target, rcond=None)[0]
        bound = LARGEST * usual(start)
        loss = lambda b, target=target, bound=bound: huber(target - design @ b, bound).sum()
        best = optimize.minimize(loss, start, tol=1e-10).x
        np.testing.assert_allclose([*found.response[place], found.offset[place]], best, atol=2e-3)
        assert np.abs(start - best).max() > 0.03
        assert found.limit[place] == pytest.approx(LARGEST * usual(best), rel=2e-3)


def test_predictors_are_as_far_from_what_is_expected_as_is_usual_at_most():
    theta, z = lines(400, 0, stats.t(2))
    clip = fitted_limits(single(z), single(theta), jnp.ones(400, bool))
    response, offset, limit = (np.asarray(leaf, float) for leaf in (clip.response, clip.offset, clip.limit))
    rows = np.asarray(clipped(clip, single(z)))
    loss = lambda t, row: np.sum((LARGEST / limit) ** 2 * huber(row - offset - response @ t, limit)) + 0.5 * t @ t
    residuals = np.asarray(residuals_of(clip, single(z)))
    for row, found, left in zip(z[:5], rows, residuals, strict=False):
        expected = offset + response @ optimize.minimize(loss, np.zeros(3), row, tol=1e-10).x
        np.testing.assert_allclose(found, np.clip(row, expected - limit, expected + limit), atol=5e-3)
        np.testing.assert_allclose(left, LARGEST * (row - expected) / limit, atol=5e-3)
    assert 0.1 < np.mean(np.abs(rows - z) > 1e-3) < 0.35


@pytest.mark.parametrize(("noise", "gain"), [(stats.t(2), True), (stats.norm(), False)])
def test_outliers_are_clipped_and_other_noise_is_not(noise, gain):
    """Errors on new simulations, compared with those of a plain regression and of exact posterior means."""
    theta, x = lines(1200, 1, noise)
    every, new = jnp.ones(1000, bool), slice(1000, None)
    one = unfitted(3, len(PLACES), len(PLACES))  # a single record: no statistics
    regression, own = fitted(one, single(theta[:1000]), single(x[:1000]), every, every)
    features = {"own": np.asarray(own), "new": np.asarray(regression(single(x[new])))}
    wrong = {}
    for name, of in (("own", slice(0, 1000)), ("new", new)):
        design = np.c_[np.ones(len(theta[of])), features[name]]
        wrong[name] = np.std(theta[of] - design @ np.linalg.lstsq(design, theta[of], rcond=None)[0], axis=0)
    np.testing.assert_allclose(wrong["own"], wrong["new"], rtol=0.12)
    np.testing.assert_allclose(wrong["new"][2], np.std(theta[new, 2]), rtol=0.02)
    grid = np.linspace(-1, 1, 31)
    level, slope = (axis.ravel() for axis in np.meshgrid(grid, grid))
    residuals = x[new, None] - level[:, None] - slope[:, None] * PLACES
    log_density = noise.logpdf(residuals).sum(-1)
    weights = np.exp(log_density - log_density.max(1, keepdims=True))
    means = np.stack([weights @ level, weights @ slope], axis=1) / weights.sum(1, keepdims=True)
    exact = np.sqrt(np.mean((means - theta[new, :2]) ** 2, axis=0))
    assert np.all(wrong["new"][:2] < 1.15 * exact)
    from_clipped = np.asarray(regression.coefficients)[:, -len(PLACES) :]
    assert np.any(from_clipped[:2] != 0, axis=1).tolist() == [gain, gain]
    if gain:
        plain = np.asarray(ridge(single(x[:1000]), single(theta[:1000]), every)[0])
        design = np.c_[np.ones(200), x[new] @ plain.T]
        linear = np.std(theta[new] - design @ np.linalg.lstsq(design, theta[new], rcond=None)[0], axis=0)
        assert np.all(wrong["new"][:2] < 0.9 * linear[:2])


def test_what_does_not_vary_and_no_rows_leave_finite_limits():
    z = jnp.zeros((20, 4)).at[:, 0].set(jnp.arange(20.0))
    theta = jnp.arange(20.0)[:, None] / 10
    for counted in (jnp.ones(20, bool), jnp.zeros(20, bool)):
        found = fitted_limits(z, theta, counted)
        assert np.all(np.asarray(found.limit) >= LARGEST * LEAST)
        rows = clipped(found, z)
        assert np.isfinite(rows).all()
        np.testing.assert_allclose(rows[:, 1:], 0, atol=1e-6)
    np.testing.assert_allclose(clipped(found, z[:, 1:2].repeat(4, 1)), 0, atol=1e-6)
    np.testing.assert_allclose(no_clipping(1, 4)(0.5 * jnp.ones(4)), 0.5)
