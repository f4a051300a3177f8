"""Estimates from more predictors than simulations, against the exact posterior means of a linear model."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.estimators.inverse_regression import MANY, inverse_regression
from jaxlfi.estimators.regression import Regression, unfitted
from jaxlfi.estimators.ridge import ridge

fitted_inverse = jax.jit(inverse_regression)
fitted = jax.jit(Regression.fitted)
single = lambda values: jnp.asarray(values, jnp.float32)


def pictures(n, seed, size=256):
    """Numbers that respond to two parameters, each with its own noise level, and not to a third parameter."""
    rng = np.random.default_rng(seed)
    response, noise = np.random.default_rng(1).normal(size=(2, size)) * 3 / np.sqrt(size), np.linspace(0.5, 2, size)
    theta = rng.normal(size=(n, 3)) * [1.0, 0.2, 5.0] + [3.0, 0.0, -2.0]
    standard = (theta[:, :2] - [3.0, 0.0]) / [1.0, 0.2]
    return theta, standard @ response + noise * rng.normal(size=(n, size)), response, noise


def test_estimates_are_posterior_means():
    theta, z, response, noise = pictures(6000, 0, size=40)
    found, _ = fitted_inverse(single(z), single(theta), jnp.ones(6000, bool))
    exact = z @ (response / noise**2).T @ np.linalg.inv((response / noise**2) @ response.T + np.eye(2))
    estimates = np.asarray(found(single(z)))
    assert estimates.shape == (6000, 3 + 6) and found.size == 9
    np.testing.assert_allclose(estimates[:, :2], exact / exact.std(axis=0), atol=0.15)
    np.testing.assert_allclose(estimates[:, :3].std(axis=0), 1, rtol=1e-3)
    bounded = np.clip(estimates[:, :3], -2.5, 2.5)
    np.testing.assert_allclose(estimates[:, 3:5], bounded[:, :1] * bounded[:, :2], rtol=1e-4, atol=1e-5)


def test_a_simulation_s_own_parameters_are_not_in_its_estimates():
    theta, z, _, _ = pictures(100, 2, size=1000)
    counted = jnp.arange(100) < 90
    z[90:] = np.nan
    found, by_others = fitted_inverse(single(z), single(theta), counted)
    of = lambda estimates: [abs(np.corrcoef(theta[:90, d], np.asarray(estimates)[:90, d])[0, 1]) for d in range(3)]
    assert of(found(single(z)))[2] > 0.5  # the numbers do not depend on it
    assert of(by_others)[2] < 0.25 and min(of(by_others)[:2]) > 0.6


def test_features_of_pictures_are_better_than_a_regression_on_pixels():
    theta, z, _, _ = pictures(2100, 3)
    every, new = jnp.ones(100, bool), slice(100, None)
    regression, own = fitted(unfitted(3, 256, 256), single(theta[:100]), single(z[:100]), every, every)
    coefficients, intercept, _ = ridge(single(z[:100]), single(theta[:100]), every)
    wrong = np.std(theta[new] - np.asarray(intercept + single(z[new]) @ coefficients.T), axis=0)
    errors = []
    for rows, features in ((slice(0, 100), own), (new, regression(single(z[new])))):
        design = np.c_[np.ones(len(theta[rows])), np.asarray(features)]
        errors.append(np.std(theta[rows] - design @ np.linalg.lstsq(design, theta[rows], rcond=None)[0], axis=0))
    assert np.all(errors[1][:2] < 0.97 * wrong[:2])
    np.testing.assert_allclose(errors[0], errors[1], rtol=0.25)  # a network learns from errors as large as on new rows


def test_what_does_not_vary_and_no_rows_leave_finite_estimates():
    z, theta = jnp.zeros((20, MANY)).at[:, 0].set(jnp.arange(20.0)), jnp.arange(20.0)[:, None] / 10
    for counted in (jnp.ones(20, bool), jnp.zeros(20, bool)):
        found, by_others = fitted_inverse(z, theta, counted)
        assert np.isfinite(by_others).all() and np.isfinite(found(z)).all()
