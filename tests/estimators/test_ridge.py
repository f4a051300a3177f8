"""Ridge regression against NumPy's normal equations, and its penalty against the hat matrix."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.estimators.ridge import FOLDS, PENALTIES, least_squares, linear_gaussian, ridge, scaled_gaussian

RIDGE = jax.jit(lambda x, y, valid: ridge(x, y, valid)[:2])
RIDGE_OTHERS = jax.jit(lambda x, y, valid: ridge(x, y, valid)[2])


def problem(rows, obs, noise, seed=0):
    """x [N, S], y [N, 2] with intercepts, and the coefficients [2, S] of y."""
    generator = np.random.default_rng(seed)
    x = generator.normal(3.0, 1.0, (rows, obs))
    coefficients = generator.normal(0.0, 1.0, (2, obs)) * np.array([[1.0], [0.1]])
    y = x @ coefficients.T + [2.0, -7.0] + noise * generator.normal(size=(rows, 2))
    return x.astype(np.float32), y.astype(np.float32), coefficients


def by_normal_equations(x, y):
    """The same from centred normal equations in double precision; the penalty from the trace of the hat matrix."""
    x, y = x.astype(np.float64), y.astype(np.float64)
    a, b = x - x.mean(0), y - y.mean(0)
    rows, best = len(a), []
    for d in range(y.shape[1]):
        found = []
        for penalty in PENALTIES.astype(np.float64):
            inverse = np.linalg.inv(a.T @ a + penalty * np.eye(a.shape[1]))
            residual = b[:, d] - a @ inverse @ a.T @ b[:, d]
            free = rows - 1 - np.trace(a @ inverse @ a.T)
            found.append((np.sum(residual**2) / free**2, tuple(inverse @ a.T @ b[:, d])))
        best.append(min(found)[1])
    coefficients = np.array(best)
    return coefficients, y.mean(0) - coefficients @ x.mean(0)


@pytest.mark.parametrize(("rows", "obs", "noise"), [(60, 4, 0.3), (40, 30, 2.0), (25, 60, 0.5)])
def test_against_normal_equations(rows, obs, noise):
    x, y, _ = problem(rows, obs, noise)
    coefficients, intercept = RIDGE(x, y, jnp.ones(rows, bool))
    expected, constant = by_normal_equations(x, y)
    np.testing.assert_allclose(coefficients, expected, atol=2e-4)
    np.testing.assert_allclose(intercept, constant, atol=5e-3)


def test_rows_that_do_not_count_change_nothing():
    x, y, _ = problem(50, 5, 0.2)
    valid = np.arange(50) < 30
    alone = RIDGE(x[:30], y[:30], jnp.ones(30, bool))
    x[30:], y[30:] = np.nan, np.inf
    for found, expected in zip(RIDGE(x, y, valid), alone, strict=True):
        np.testing.assert_allclose(found, expected, atol=2e-5)


def test_few_predictors_against_least_squares_of_each_fold():
    x, y, _ = problem(62, 4, 0.3)
    valid = np.arange(62) < 55
    x[55:], y[55:] = np.nan, np.inf
    coefficients, by_others = jax.jit(least_squares)(x, y, valid)

    def penalised(rows):  # a row of weight one for each coefficient
        a, b = (
            np.concatenate([v[rows] - v[rows].mean(0), extra]) for v, extra in ((x, np.eye(4)), (y, np.zeros((4, 2))))
        )
        return np.linalg.lstsq(a.astype(float), b.astype(float), rcond=None)[0]

    np.testing.assert_allclose(coefficients, penalised(valid).T, atol=1e-4)
    for fold in range(FOLDS):
        own = valid & (np.arange(62) % FOLDS == fold)
        others = valid & ~own
        expected = y[others].mean(0) + (x[own] - x[others].mean(0)) @ penalised(others)
        intercept = y[valid].mean(0) - coefficients @ x[valid].mean(0)
        np.testing.assert_allclose(by_others[own] + intercept, expected, atol=1e-3)


def test_a_linear_relation_is_found():
    x, y, coefficients = problem(400, 6, 0.05)
    found, intercept = RIDGE(x, y, jnp.ones(400, bool))
    np.testing.assert_allclose(found, coefficients, atol=0.02)
    np.testing.assert_allclose(intercept, [2.0, -7.0], atol=0.15)


def test_noise_is_not_interpolated_by_more_predictors_than_rows():
    generator = np.random.default_rng(3)
    x, y = generator.normal(size=(60, 112)).astype(np.float32), generator.normal(size=(60, 2)).astype(np.float32)
    coefficients, _ = RIDGE(x, y, jnp.ones(60, bool))
    interpolating = np.linalg.lstsq(x - x.mean(0), y - y.mean(0), rcond=None)[0].T
    assert np.linalg.norm(coefficients) < 0.2 * np.linalg.norm(interpolating)


def test_nothing_is_predicted_without_rows():
    for values in RIDGE(jnp.full((4, 3), jnp.nan), jnp.full((4, 2), jnp.nan), jnp.zeros(4, bool)):
        np.testing.assert_array_equal(values, 0)


def test_a_linear_gaussian_has_the_covariance_that_is_left():
    x, y, _ = problem(4000, 6, 0.0)
    factor = np.array([[0.3, 0.0], [0.25, 0.1]])  # correlated, and of unequal size
    y = y + np.random.default_rng(1).normal(size=(4000, 2)) @ factor.T
    _, _, whitening = jax.jit(linear_gaussian)(x, y.astype(np.float32), jnp.ones(4000, bool))
    covariance = np.linalg.inv(np.float64(whitening.T @ whitening))
    np.testing.assert_allclose(covariance, factor @ factor.T, rtol=0.06)
    assert whitening[0, 1] == 0


def test_a_linear_gaussian_of_few_rows_is_as_wide_as_what_other_folds_get_wrong():
    rows, dim = 12, 20
    generator = np.random.default_rng(2)
    x, y = (generator.normal(size=(rows, n)).astype(np.float32) for n in (5, dim))
    coefficients, intercept, whitening = jax.jit(linear_gaussian)(x, y, jnp.ones(rows, bool))
    variances = np.diagonal(np.linalg.inv(np.float64(whitening.T @ whitening)))
    others = RIDGE_OTHERS(x, y, jnp.ones(rows, bool))
    expected = np.mean((y - intercept - others) ** 2, axis=0)
    np.testing.assert_allclose(variances, expected, rtol=1e-2)
    assert rows > FOLDS and np.isfinite(coefficients).all()


def test_a_scaled_gaussian_is_as_wide_as_each_row_says():
    """Standard deviations are exp(V x) times those of correlated errors; rows that do not count are far off."""
    rows, by_x = 4000, np.array([[0.5, 0.0, -0.2], [0.0, 0.3, 0.0]])
    x, y, coefficients = problem(rows, 3, 0.0)
    factor = np.array([[0.3, 0.0], [0.25, 0.1]])
    errors = np.random.default_rng(1).normal(size=(rows, 2)) @ factor.T
    y = (y + np.exp(x @ by_x.T) * errors).astype(np.float32)
    counted = np.arange(rows) < rows - 10
    y[~counted] = 1e4
    found, _, spread, offset, whitening = jax.jit(scaled_gaussian)(x, y, counted)
    np.testing.assert_allclose(spread, by_x, atol=0.06)
    np.testing.assert_allclose(spread @ x[counted].mean(0) + offset, 0, atol=1e-4)
    covariance = np.linalg.inv(np.float64(whitening.T @ whitening))
    mean_scale = np.exp(by_x @ x[counted].mean(0))
    np.testing.assert_allclose(covariance, (factor @ factor.T) * np.outer(mean_scale, mean_scale), rtol=0.15)
    np.testing.assert_allclose(found, coefficients, atol=0.05)


def test_few_or_no_rows_leave_a_scaled_gaussian_finite():
    generator = np.random.default_rng(2)
    x, y = (generator.normal(size=(12, n)).astype(np.float32) for n in (5, 20))
    for counted in (np.ones(12, bool), np.arange(12) < 2, np.zeros(12, bool)):
        assert all(np.isfinite(values).all() for values in jax.jit(scaled_gaussian)(x, y, counted))
