"""Ornstein-Uhlenbeck discrepancies: their draws, and what residuals reveal about them."""

import numpy as np
import pytest

pytest.importorskip("mujoco")

import jax

from jaxlfi.envs.mujoco.discrepancy import Discrepancy, _autocovariances, estimated

PROCESS = Discrepancy(0.3, 0.25)
TIMES = np.cumsum(np.random.default_rng(3).uniform(0.01, 0.2, 40))
"""At unequal intervals."""


def test_draws_have_the_covariance_of_the_process():
    draws = PROCESS.draws(np.random.default_rng(0), 40_000, TIMES)
    assert draws.shape == (40_000, 40)
    np.testing.assert_allclose(np.cov(draws.T), PROCESS.covariance(TIMES), atol=5 * 0.3**2 * np.sqrt(2 / 40_000))
    closed_form = [[0.09, 0.09 * np.exp(-(TIMES[7] - TIMES[2]) / 0.25)]]
    np.testing.assert_allclose(PROCESS.covariance(TIMES)[2:3, [2, 7]], closed_form)


def test_forms_are_those_of_the_covariance():
    """Times are at unequal intervals or single, and the process is longer or shorter than the intervals."""
    rows = np.random.default_rng(5).standard_normal((40, 3))
    for process in (PROCESS, Discrepancy(0.3, 100.0), Discrepancy(2.0, 1e-3), Discrepancy(0.0, 1.0)):
        expected = rows.T @ process.covariance(TIMES) @ rows
        np.testing.assert_allclose(process.form(TIMES, rows), expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(PROCESS.form(TIMES[:1], rows[:1]), 0.09 * rows[:1].T @ rows[:1])
    assert (PROCESS.form(TIMES[:0], rows[:0]) == np.zeros((3, 3))).all()


def test_draws_inside_of_compiled_programs_have_it_too():
    keys = jax.random.split(jax.random.key(0), 40_000)
    draws = jax.jit(jax.vmap(lambda key: PROCESS.draw(key, TIMES)))(keys)
    np.testing.assert_allclose(np.cov(draws.T), PROCESS.covariance(TIMES), atol=5 * 0.3**2 * np.sqrt(2 / 40_000))


def test_the_process_is_read_off_residuals():
    """Three long episodes with white noise, fourteen correlation times each: an error of a fifth is three sigma."""
    rng, times = np.random.default_rng(1), 0.01 * np.arange(1000)
    residuals = PROCESS.draws(rng, 9, times) + 0.1 * rng.standard_normal((9, 1000))
    found = estimated(list(residuals), [times] * 9, 0.1)
    assert found.deviation == pytest.approx(0.3, rel=0.2) and found.time == pytest.approx(0.25, rel=0.3)


def test_missing_samples_are_left_out():
    rng, times = np.random.default_rng(2), 0.01 * np.arange(3000)
    residuals = PROCESS.draws(rng, 4, times)
    holes = np.where(rng.random(residuals.shape) < 0.3, np.nan, residuals)
    whole, some = (estimated(list(rows), [times] * 4, 0.0) for rows in (residuals, holes))
    assert some.deviation == pytest.approx(whole.deviation, rel=0.1) and some.time == pytest.approx(whole.time, rel=0.2)


def test_autocovariances_are_means_of_products():
    """Compared with a loop over lags, for episodes of different lengths with missing samples."""
    rng = np.random.default_rng(6)
    episodes = [np.where(rng.random(count) < 0.2, np.nan, rng.standard_normal(count)) for count in (50, 31, 1)]
    expected = []
    for lag in range(25):
        products = np.concatenate([own[lag:] * own[: len(own) - lag] for own in episodes if len(own) > lag])
        expected.append(np.nanmean(products))
    np.testing.assert_allclose(_autocovariances(episodes), expected, atol=1e-12)
    assert _autocovariances([]).tolist() == [0.0]


def test_a_signal_has_a_clock_of_its_own():
    """Rows of other signals between a signal's samples change nothing."""
    rng, times = np.random.default_rng(7), 0.01 * np.arange(500)
    residuals = PROCESS.draws(rng, 1, times)[0]
    between = np.sort(np.concatenate([times, times + 1e-6]))
    others = np.full(1000, np.nan)
    others[::2] = residuals
    assert estimated([others], [between], 0.1) == estimated([residuals], [times], 0.1)
    assert estimated([np.full(3, np.nan)], [times[:3]], 0.1).deviation == 0


def test_white_noise_is_no_discrepancy():
    noise = 0.1 * np.random.default_rng(4).standard_normal(5000)
    assert estimated([noise], [0.01 * np.arange(5000)], 0.1).deviation < 0.03


@pytest.mark.parametrize(("deviation", "time"), [(-1.0, 1.0), (1.0, 0.0), (np.nan, 1.0), (1.0, np.inf)])
def test_what_is_no_process(deviation, time):
    with pytest.raises(ValueError, match="expected a standard deviation of at least 0 and a correlation time above 0"):
        Discrepancy(deviation, time)


def test_what_is_left_of_values_is_independent():
    """Whitening is by the inverse Cholesky factor of the covariance, for several series at times with gaps."""
    rng = np.random.default_rng(3)
    times = np.sort(rng.uniform(0.0, 4.0, 60))
    process, values = Discrepancy(0.4, 0.3), rng.standard_normal((2, 3, 60))
    factor = np.linalg.cholesky(process.covariance(times) + 0.2**2 * np.eye(60))
    expected = np.linalg.solve(factor, values.reshape(-1, 60).T).T.reshape(2, 3, 60)
    np.testing.assert_allclose(process.whitened(times, values, 0.2), expected, atol=1e-9)
    np.testing.assert_allclose(Discrepancy(0.0, 1.0).whitened(times, values, 0.2), values / 0.2)
