"""Regression features, statistics of series and stacking, against NumPy, SciPy and refits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from jaxlfi.bayessim.presets import QUICK
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.estimators.axes import LARGEST_SCORE, principal_axes
from jaxlfi.estimators.base import untrained
from jaxlfi.estimators.dataset import Dataset
from jaxlfi.estimators.mixture_network import MixtureNetwork
from jaxlfi.estimators.regression import Regression, features_size, unfitted
from jaxlfi.estimators.ridge import FOLDS, PENALTIES, ridge
from jaxlfi.estimators.stacking import stacked
from jaxlfi.estimators.statistics import (
    FARTHEST,
    LAGS,
    QUANTILES,
    RESIDUAL_SIZES,
    SMALLEST,
    STEPS,
    first_statistics,
    residual_sizes,
    statistics,
    statistics_size,
)
from jaxlfi.estimators.training import fit

SERIES = np.random.default_rng(0).gamma(2.0, [1.0, 3.0], (63, 2)).cumsum(0)[::3]
SCALES = 5 + len(STEPS)
"""Index of the skewness, after the mean and the logarithms of scales."""
statistics_of, ridge_of, fitted = jax.jit(statistics), jax.jit(ridge), jax.jit(Regression.fitted)
features_of = jax.jit(lambda regression, x: regression(x))
"""Compiled as a whole: one by one, its operations would be hundreds of programs."""


def test_statistics_against_numpy():
    found = np.asarray(statistics_of(jnp.asarray(SERIES, jnp.float32)))
    assert found.shape == (statistics_size(21, 2),)
    z = (SERIES - SERIES.mean(0)) / SERIES.std(0)
    squares = (z**2 - 1) / (z**2).std(0)
    expected = [
        SERIES.mean(0),
        np.log(SERIES.std(0)),
        *(0.5 * np.log(np.mean((SERIES[lag:] - SERIES[:-lag]) ** 2, axis=0)) for lag in STEPS),
        0.5 * np.log(np.mean(np.diff(SERIES, 2, axis=0) ** 2, axis=0)),
        2 * np.log(np.mean(np.sqrt(abs(SERIES - np.median(SERIES, axis=0))), axis=0)),
        2 * np.log(np.mean(np.sqrt(abs(np.diff(SERIES, axis=0))), axis=0)),
        stats.skew(SERIES),
        stats.kurtosis(SERIES) + 3,
        *(np.mean(z[lag:] * z[:-lag], axis=0) for lag in LAGS),
        *(np.mean(squares[lag:] * squares[:-lag], axis=0) for lag in LAGS),
        *np.quantile(SERIES, np.round(np.array(QUANTILES) * 20) / 20, axis=0),
        [np.corrcoef(SERIES.T)[0, 1]],
    ]
    np.testing.assert_allclose(found, np.concatenate(expected), rtol=2e-4, atol=2e-4)


@given(power=st.integers(-18, 18), sign=st.sampled_from([-1, 1]))
def test_a_unit_moves_logarithms_and_scales_the_rest(power, sign):
    count = 2 * (SCALES + 2 + 2 * len(LAGS) + len(QUANTILES))
    ordered = SCALES + 2 + 2 * len(LAGS)
    plain = np.asarray(statistics_of(jnp.asarray(SERIES, jnp.float32)))[:count].reshape(-1, 2)
    other = np.asarray(statistics_of(jnp.asarray(sign * 10.0**power * SERIES, jnp.float32)))[:count].reshape(-1, 2)
    np.testing.assert_allclose(other[1:SCALES] - plain[1:SCALES], power * np.log(10), atol=1e-3)
    np.testing.assert_allclose(other[SCALES], sign * plain[SCALES], atol=1e-3)
    np.testing.assert_allclose(other[SCALES + 1 : ordered], plain[SCALES + 1 : ordered], atol=1e-3)
    quantiles = other[ordered:] if sign > 0 else other[: ordered - 1 : -1]
    np.testing.assert_allclose(quantiles / 10.0**power, sign * plain[ordered:], rtol=1e-4)


@pytest.mark.parametrize("value", [0.0, 1e-30, -7.0, 3e30])
def test_a_constant_series_has_finite_statistics(value):
    found = np.asarray(statistics_of(jnp.full((12, 1), value, jnp.float32)))
    assert np.isfinite(found).all()
    assert (found[SCALES : SCALES + 2 + 2 * len(LAGS)] == 0).all()


def test_squares_tell_a_varying_spread_from_noise():
    """Returns of varying spread have autocorrelated squares, but no autocorrelation; independent ones have neither."""
    noise, rng = np.random.default_rng(1).normal(size=4000), np.random.default_rng(2)
    spread = np.repeat(rng.choice([0.5, 2.0], 400), 10)
    found, plain = (np.asarray(statistics_of(jnp.asarray(v[:, None], jnp.float32))) for v in (spread * noise, noise))
    first, squared = SCALES + 2, SCALES + 2 + len(LAGS)
    assert abs(found[first]) < 0.06 and found[squared] > 0.1
    assert abs(plain[first]) < 0.06 and abs(plain[squared]) < 0.06


@pytest.mark.parametrize("value", [[0.0, 1.0], [3.0, 3.0 + 1e-6]])
def test_a_series_of_two_values_has_finite_statistics(value):
    found = np.asarray(statistics_of(jnp.asarray(np.tile(value, 10)[:, None], jnp.float32)))
    assert np.isfinite(found).all() and (np.abs(found[SCALES + 2 + len(LAGS) : SCALES + 2 + 2 * len(LAGS)]) < 0.1).all()


def test_sizes_of_residuals_against_numpy():
    residuals = np.random.default_rng(4).standard_t(2, (3, 20, 2))
    found = np.asarray(jax.jit(residual_sizes)(jnp.asarray(residuals, jnp.float32)))
    assert found.shape == (3, 2 * RESIDUAL_SIZES)
    lagged = [residuals[:, lag:] - residuals[:, :-lag] for lag in STEPS]
    expected = [np.log(np.median(np.abs(away), axis=1) + SMALLEST) for away in (residuals, lagged[0])]
    for away in (residuals, *lagged, np.diff(residuals, 2, axis=1)):
        expected.append(0.5 * np.log(np.mean(np.clip(away, -FARTHEST, FARTHEST) ** 2, axis=1) + SMALLEST**2))
    np.testing.assert_allclose(found, np.concatenate(expected, axis=1), rtol=1e-4, atol=1e-4)
    assert (np.abs(residuals) > FARTHEST).any()
    assert np.isfinite(jax.jit(residual_sizes)(jnp.zeros((20, 2)))).all()


def noisy_waves(rows, rng):
    """Waves of unknown amplitudes and noise; the waves are far larger than the noise, and as fast."""
    time = np.arange(40)
    waves = np.stack([np.sin(2.2 * time), np.cos(2.2 * time)])
    amplitudes, log_noise = rng.uniform(-10, 10, (rows, 2)), rng.uniform(-1, 1, rows)
    x = amplitudes @ waves + np.exp(log_noise)[:, None] * rng.normal(size=(rows, 40))
    return waves, np.column_stack([amplitudes / 6, log_noise / 0.6]), x


def test_the_noise_of_a_faster_signal_is_read_off_what_a_model_of_the_numbers_leaves():
    """Its errors are hardly larger than those of the exact posterior mean; without residuals, they are nearly twice."""
    waves, theta, x = noisy_waves(1000, np.random.default_rng(6))
    _, truth, new = noisy_waves(2000, np.random.default_rng(7))
    every, single = jnp.ones(1000, bool), lambda values: jnp.asarray(values, jnp.float32)
    today = unfitted(3, 40, 1)
    without = today.of_earlier_versions(40)[1]
    before = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), without)
    grid = np.linspace(-1, 1, 401)
    left = new - new @ np.linalg.pinv(waves) @ waves
    # Given the noise s and a flat prior of the amplitudes, sum(left**2) / s**2 has 38 degrees of freedom.
    log_posterior = -38 * grid - 0.5 * np.sum(left**2, axis=1)[:, None] * np.exp(-2 * grid)
    weights = np.exp(log_posterior - log_posterior.max(1, keepdims=True))
    exact = np.std(truth[:, 2] - weights @ grid / weights.sum(1) / 0.6)
    errors = []
    for regression in (today, before):
        found, own = fitted(regression, single(theta), single(x), every, every)
        of_statistics = np.asarray(features_of(found, single(new)))[:, 5]
        slope, intercept = np.polyfit(np.asarray(own)[:, 5], theta[:, 2], 1)
        errors.append(np.std(truth[:, 2] - intercept - slope * of_statistics))
    assert errors[0] < 1.15 * exact and errors[1] > 1.6 * exact, (errors, exact)


def test_what_is_short_is_no_series():
    assert statistics_size(9, 1) == 0 and statistics_size(10, 1) == 28
    assert features_size(3, 9, 1) == 3 and features_size(3, 20, 2) == 6


def test_predictions_by_the_other_folds_are_those_of_fits_to_them():
    rng = np.random.default_rng(1)
    x = rng.normal(5.0, 2.0, (83, 4))
    y = x @ rng.normal(size=(4, 2)) + rng.normal(0.0, 1.0, (83, 2))
    x[80:], y[80:] = np.nan, np.inf  # empty rows
    single = lambda values: jnp.asarray(values, jnp.float32)
    coefficients, intercept, by_others = map(np.asarray, ridge_of(single(x), single(y), jnp.arange(83) < 80))
    inner, outer = x[:80] - x[:80].mean(0), y[:80] - y[:80].mean(0)
    fits = [np.linalg.solve(inner.T @ inner + penalty * np.eye(4), inner.T @ outer) for penalty in PENALTIES]
    chosen = [PENALTIES[np.argmin([np.abs(fit[:, d] - coefficients[d]).max() for fit in fits])] for d in range(2)]
    for fold in range(FOLDS):
        own = np.arange(80) % FOLDS == fold
        for d, penalty in enumerate(chosen):
            a, b = x[:80][~own], y[:80, d][~own]
            a_mean, b_mean = a.mean(0), b.mean()
            fitted = np.linalg.solve((a - a_mean).T @ (a - a_mean) + penalty * np.eye(4), (a - a_mean).T @ (b - b_mean))
            expected = b_mean + (x[:80][own] - a_mean) @ fitted
            np.testing.assert_allclose(by_others[:80][own, d] + intercept[d], expected, atol=2e-3)


@pytest.mark.parametrize("seen", ["feature alone", "feature and predictors"])
def test_features_do_not_tell_a_parameter_that_the_summary_does_not(seen):
    """Predictions that leave one row out are linear in its own value: their correlation with it is -1."""
    rng = np.random.default_rng(5)
    x, theta = rng.normal(size=(500, 12)), rng.uniform(-1.7, 1.7, (500, 3))
    *_, by_others = ridge_of(jnp.asarray(x, jnp.float32), jnp.asarray(theta, jnp.float32), jnp.ones(500, bool))
    for d in range(3):
        feature = np.asarray(by_others)[:, d : d + 1]
        feature = (feature - feature.mean()) / feature.std()
        seen_by_network = feature if seen == "feature alone" else np.concatenate([feature, x], axis=1)
        design = np.concatenate([np.ones((500, 1)), seen_by_network], axis=1)
        residual = theta[:, d] - design @ np.linalg.lstsq(design, theta[:, d], rcond=None)[0]
        assert np.var(residual) / np.var(theta[:, d]) > 0.9


def simulated(n, seed, dim=2, obs=30):
    """A series whose level and slope depend on the first parameter, and whose spread depends on the second."""
    rng = np.random.default_rng(seed)
    theta = rng.uniform(-1.5, 1.5, (n, dim))
    noise = np.exp(theta[:, 1:]) * rng.normal(size=(n, obs))
    return theta.astype(np.float32), (theta[:, :1] * np.linspace(0.5, 2, obs) + noise).astype(np.float32)


def test_features_tell_level_and_spread_of_simulations_that_were_not_seen():
    theta, x = simulated(600, 0)
    every = jnp.ones(600, bool)
    regression, features = fitted(unfitted(2, 30, 1), jnp.asarray(theta), jnp.asarray(x), every, jnp.arange(600) >= 200)
    assert features.shape == (600, 4)
    np.testing.assert_allclose(features.mean(0), 0, atol=1e-3)
    np.testing.assert_allclose(features.std(0), 1, rtol=1e-3)
    new, seen = simulated(400, 1)
    found = np.asarray(features_of(regression, jnp.asarray(seen)))
    assert np.corrcoef(found[:, 0], new[:, 0])[0, 1] > 0.8  # from the raw numbers
    assert abs(np.corrcoef(found[:, 1], new[:, 1])[0, 1]) < 0.7  # their squares say little about the spread
    assert np.corrcoef(found[:, 3], new[:, 1])[0, 1] > 0.95  # from the statistics


def test_axes_are_the_principal_ones_and_products_those_of_bounded_scores():
    rng = np.random.default_rng(6)
    z = rng.normal(size=(400, 3)) @ rng.normal(size=(3, 7)) + 0.1 * rng.normal(size=(400, 7)) + 2
    counted = np.arange(400) < 300
    mean = z[counted].mean(0)
    values, vectors = np.linalg.eigh(np.cov((z[counted] - mean).T, bias=True))
    scores = (z - mean) @ vectors[:, ::-1][:, :4] / np.sqrt(values[::-1][:4])
    scores = np.clip(scores, -LARGEST_SCORE, LARGEST_SCORE)
    assert np.abs(scores).max() == LARGEST_SCORE
    along = jax.jit(principal_axes, static_argnums=2)(jnp.asarray(z, jnp.float32), jnp.asarray(counted), 4)
    found = np.asarray(along.beside(jnp.asarray(z, jnp.float32)))
    assert found.shape == (400, 7 + 10) and along.size == 17
    np.testing.assert_allclose(found[:, :7], z, rtol=1e-6)
    expected = np.stack([scores[:, i] * scores[:, j] for i in range(4) for j in range(i, 4)], axis=1)
    np.testing.assert_allclose(np.abs(found[:, 7:]), np.abs(expected), atol=2e-3)  # the sign of an axis is arbitrary
    np.testing.assert_allclose(found[:, [7, 11, 14, 16]], scores**2, atol=2e-3)


def test_predictors_that_do_not_vary_and_few_rows_leave_axes_without_scores():
    z = jnp.zeros((3, 6)).at[:, 0].set(jnp.array([0.0, 1.0, 2.0]))
    along = principal_axes(z, jnp.ones(3, bool), 4)
    found = np.asarray(along.beside(z))
    assert along.directions.shape == (6, 4) and np.isfinite(found).all()
    np.testing.assert_allclose(found[:, 6], [1.5, 0.0, 1.5], atol=1e-5)
    np.testing.assert_array_equal(found[:, 7:], 0)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e5])
def test_features_follow_a_curve_whatever_the_unit(scale):
    """For waves that are far from linear in both parameters, they leave a quarter of what linear features leave."""
    rng = np.random.default_rng(7)
    times = np.linspace(0, 6, 40)
    theta = rng.uniform(-1, 1, (900, 2)).astype(np.float32)
    waves = np.cos((1 + 0.4 * theta[:, :1]) * times) + np.exp(-0.2 * (1 + theta[:, 1:]) * times)
    x = (scale * (waves + 0.05 * rng.normal(size=waves.shape)) + 3 * scale).astype(np.float32)
    every = jnp.ones(600, bool)
    regression, own = fitted(unfitted(2, 40, 1), jnp.asarray(theta[:600]), jnp.asarray(x[:600]), every, every)
    unexplained = lambda features, of: [1 - np.corrcoef(features[:, d], of[:, d])[0, 1] ** 2 for d in range(2)]
    new = unexplained(np.asarray(features_of(regression, jnp.asarray(x[600:]))), theta[600:])
    design, target = (np.c_[np.ones(len(rows)), rows] for rows in (x / scale, theta))
    linear = design[600:] @ np.linalg.lstsq(design[:600], target[:600, 1:], rcond=None)[0]
    assert np.all(np.array(new) < 0.25 * np.array(unexplained(linear, theta[600:])))
    np.testing.assert_allclose(unexplained(np.asarray(own), theta[:600]), new, rtol=0.5)


def test_products_are_kept_for_the_parameters_that_need_them():
    rng = np.random.default_rng(8)
    x = rng.normal(size=(500, 3))
    theta = np.stack([x[:, 0] - x[:, 1] + rng.normal(size=500), x[:, 1] * x[:, 2] + rng.normal(size=500)], axis=1)
    every, both = jnp.ones(500, bool), (jnp.asarray(v, jnp.float32) for v in (theta, x))
    regression, features = fitted(unfitted(2, 3, 3), *both, every, every)
    assert np.all(regression.coefficients[0, 3:] == 0) and np.any(regression.coefficients[0, :3] != 0)
    assert np.any(regression.coefficients[1, 3:] != 0)
    assert np.all([np.corrcoef(features[:, d], theta[:, d])[0, 1] > 0.5 for d in range(2)])


def test_a_network_learns_from_residuals_as_large_as_those_of_a_new_simulation():
    """With 60 predictors and 200 rows, predictions of fitted rows correlate more than those of new ones."""
    rng = np.random.default_rng(2)
    theta = rng.normal(size=(600, 1)).astype(np.float32)
    x = (theta + rng.normal(0.0, 4.0, (600, 60))).astype(np.float32)
    every = jnp.ones(200, bool)
    one = unfitted(1, 60, 60)  # a single record of 60 channels: no series
    regression, features = fitted(one, jnp.asarray(theta[:200]), jnp.asarray(x[:200]), every, every)
    new = np.asarray(features_of(regression, jnp.asarray(x[200:])))
    correlation = lambda a, b: np.corrcoef(a[:, 0], b[:, 0])[0, 1]
    own, others = correlation(np.asarray(features), theta[:200]), correlation(new, theta[200:])
    again = correlation(np.asarray(features_of(regression, jnp.asarray(x[:200]))), theta[:200])
    assert abs(own - others) < 0.02 and again - others > 0.04


def test_a_series_that_comes_as_a_difference_has_the_statistics_of_the_sum():
    theta, x = simulated(600, 3)
    origin = np.linspace(-3, 3, 30).astype(np.float32)
    every = jnp.ones(600, bool)
    plain, _ = fitted(unfitted(2, 30, 1), jnp.asarray(theta), jnp.asarray(x), every, every)
    counted = unfitted(2, 30, 1).replace(origin=jnp.asarray(origin))
    other, _ = fitted(counted, jnp.asarray(theta), jnp.asarray(x - origin), every, every)
    moved, same = features_of(other, jnp.asarray(x[:400] - origin)), features_of(plain, jnp.asarray(x[:400]))
    np.testing.assert_allclose(moved, same, atol=2e-2)


@pytest.mark.parametrize("reduction", ["half", "most"])
@pytest.mark.parametrize(("obs", "features"), [(4, 3), (9, 3), (10, 6), (40, 6)])
def test_networks_of_features_see_the_numbers_of_short_summaries_too(reduction, obs, features):
    """The first networks see the summary alone: with "most" one of them, if it has more than 9 numbers."""
    without = 1 if reduction == "most" and obs > 9 else 3
    some = MixtureNetwork(reduction=reduction, short_summary=9, ensemble_size=5, warm_start=False)
    views = some.views(3, obs)
    assert views.shape == (5, some.inputs(3, obs)) == (5, obs + features)
    assert ((views[:without] > 0) == (np.arange(obs + features) < obs)).all()
    assert (views[without:, :obs] > 0).all() == (obs <= 9) and (views[without:, obs:] > 0).all()
    np.testing.assert_allclose((views**2).sum(axis=1), obs + features, rtol=1e-5)
    alone = some.replace(reduction="regression")
    assert alone.inputs(3, obs) == (obs + features if obs <= 9 else features) and alone.views(3, obs) is None


@pytest.mark.parametrize(("reduction", "sees"), [("none", 0), ("half", 0), ("most", 1), ("regression", 1)])
def test_what_a_single_network_sees(reduction, sees):
    estimator = MixtureNetwork(reduction=reduction, ensemble_size=1, warm_start=False)
    assert estimator.uses_features(40).tolist() == [bool(sees)]


def test_the_stacked_mixture_has_the_highest_log_score_of_all_weights():
    rng = np.random.default_rng(4)
    rows = np.concatenate([rng.normal(-1.0, 0.5, 700), rng.normal(2.0, 1.0, 300)])
    members = [stats.norm(-1.0, 0.5), stats.norm(2.0, 1.0), stats.norm(0.0, 4.0)]
    scores = np.stack([member.logpdf(rows) for member in members])
    found = np.exp(np.asarray(stacked(jnp.asarray(scores, jnp.float32), jnp.ones(1000))))
    np.testing.assert_allclose(found, [0.7, 0.3, 0.0], atol=0.03)


def test_with_nothing_to_judge_by_members_are_equal():
    scores = jnp.array([[0.0, jnp.nan, -3.0], [-9.0, 0.0, -jnp.inf]])
    for counts in ([0.0, 0.0, 0.0], [0.0, 1.0, 0.0]):
        np.testing.assert_allclose(jnp.exp(stacked(scores, jnp.array(counts))), 0.5)
    assert stacked(scores, jnp.array([1.0, 1.0, 1.0]))[0] > -0.4


@pytest.mark.slow  # test_fitting.py recovers an exact conditional of two parameters
def test_many_parameters_are_learnt_from_few_simulations(key):
    """A linear Gaussian model of ten parameters, which networks with a random start do not learn."""
    dim, rows, noise = 10, 600, 0.4
    generator = np.random.default_rng(4)
    design = generator.normal(size=(24, dim))
    theta = generator.uniform(-1, 1, (rows, dim)).astype(np.float32)
    x = (theta @ design.T + noise * generator.normal(size=(rows, 24))).astype(np.float32)
    dataset = Dataset(theta, x, jnp.zeros(rows, jnp.int32), jnp.ones(rows), jnp.asarray(rows))
    box = Support(-jnp.ones(dim), jnp.ones(dim))
    space = Space(tuple(f"p{d}" for d in range(dim)), (False,) * dim)
    estimator = QUICK.estimator.replace(ensemble_size=2, epochs=20)
    before = jax.jit(lambda key: untrained(key, estimator, 24, box, space))(jax.random.key(0))
    network, _ = jax.jit(fit)(key, before, dataset, jnp.ones(rows), rows)
    inside = generator.uniform(-0.5, 0.5, (20, dim))
    observed = (inside @ design.T + noise * generator.normal(size=(20, 24))).astype(np.float32)
    weighted = lambda x: estimator.weighted(network, estimator.density(network, x))
    moments = lambda x: (weighted(x).mean, weighted(x).covariance)
    means, covariances = jax.jit(jax.vmap(moments))(observed)
    exact = np.linalg.inv(design.T @ design) * noise**2
    ratio = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2) / np.diagonal(exact))
    off = (means - observed @ np.linalg.pinv(design).T) / np.sqrt(np.diagonal(exact))
    assert 0.9 < np.exp(np.mean(np.log(ratio))) < 1.2
    assert np.sqrt(np.mean(off**2)) < 0.5


def test_networks_of_earlier_versions_see_the_statistics_that_they_were_given():
    """A regression saved with seventeen statistics of a channel finds them, in their order, among today's."""
    found = np.asarray(statistics_of(jnp.asarray(SERIES, jnp.float32)))[first_statistics(2)]
    z = (SERIES - SERIES.mean(0)) / SERIES.std(0)
    expected = [
        SERIES.mean(0),
        np.log(SERIES.std(0)),
        0.5 * np.log(np.mean(np.diff(SERIES, axis=0) ** 2, axis=0)),
        stats.skew(SERIES),
        stats.kurtosis(SERIES) + 3,
        *(np.mean(z[lag:] * z[:-lag], axis=0) for lag in LAGS),
        *np.quantile(SERIES, np.round(np.array(QUANTILES) * 20) / 20, axis=0),
        [np.corrcoef(SERIES.T)[0, 1]],
    ]
    np.testing.assert_allclose(found, np.concatenate(expected), rtol=2e-4, atol=2e-4)
    obs, dim = SERIES.size, 3
    today = unfitted(dim, obs, 2)
    without_robust, without_residuals, without_clipping, without_axes, shapes = today.of_earlier_versions(obs)
    assert shapes.coefficients.shape == (2 * dim, obs + 35) and without_axes.coefficients.shape[1] == obs + 57
    assert without_clipping.coefficients.shape[1] == obs + 57 + 2 * 10  # of four axes each
    assert without_residuals.coefficients.shape[1] == 2 * (obs + 57) + 2 * 10
    assert without_robust.coefficients.shape[1] == 2 * (obs + 57 + 2 * RESIDUAL_SIZES) + 2 * 10
    assert today.coefficients.shape[1] == 2 * (obs + 57 + 2 * RESIDUAL_SIZES) + 2 * 10 + dim
    assert without_robust.robust is None and today.robust is not None
    rng = np.random.default_rng(3)
    earlier = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(2.0, 0.1, leaf.shape), jnp.float32), shapes)
    x = jnp.asarray(SERIES.ravel(), jnp.float32)
    given = jnp.concatenate([x, jnp.asarray(found)])
    earlier = earlier.replace(origin=jnp.zeros(obs))
    np.testing.assert_allclose(
        features_of(earlier, x), earlier.output(earlier.predictors(given) @ earlier.coefficients.T), rtol=1e-4
    )
