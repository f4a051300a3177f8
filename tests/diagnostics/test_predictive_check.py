"""Posterior predictive check: tails by hand, p-values that are uniform, and observations that do not fit."""

import numpy as np
import pytest
from scipy import stats

from jaxlfi.diagnostics import predictive_check
from jaxlfi.diagnostics.predictive import MIN_SIMULATIONS


def simulations(rng, n: int = 100, size: int = 3) -> np.ndarray:
    """Correlated summaries in unlike units; the last is the exponential of a wide Gaussian, as counts may be."""
    z = rng.normal(size=(n, size)) @ np.array([[1.0, 0.9, 0.0], [0.0, 0.44, 0.0], [0.0, 0.0, 3.0]])
    return np.stack([1e4 * z[:, 0], z[:, 1] - 5, np.exp(z[:, 2])], axis=1)


def test_tails_by_hand():
    simulated = np.stack([np.arange(20.0), -np.arange(20.0), np.ones(20)], axis=1)
    result = predictive_check(simulated, np.array([17.5, 3.0, 1.0]))
    # Two above; none above; all are equal to it.
    np.testing.assert_allclose(result.tails, [2 * 3 / 21, 2 * 1 / 21, 1.0])


def test_the_p_value_of_an_observation_like_the_simulations_is_uniform():
    rng = np.random.default_rng(0)
    checks = [predictive_check(rows[1:], rows[0]) for rows in (simulations(rng, 60) for _ in range(400))]
    p_values = np.array([check.p_value for check in checks])
    assert stats.kstest(p_values - rng.uniform(size=400) / 60, "uniform").pvalue > 1e-3
    first = np.array([check.tails[0] for check in checks])
    assert np.mean(first <= 0.1) == pytest.approx(0.1, abs=0.05)
    assert 0.8 < np.median([check.distance for check in checks]) < 1.2


def test_more_summaries_than_simulations_are_no_trouble():
    rng = np.random.default_rng(1)
    p_values = [predictive_check(rows[1:], rows[0]).p_value for rows in rng.normal(size=(200, 31, 60))]
    assert stats.kstest(p_values - rng.uniform(size=200) / 31, "uniform").pvalue > 1e-3


def test_each_summary_may_fit_where_all_together_do_not():
    """Two summaries that always move together, observed apart (of 100 seeds: tails of 0.068, p-values of 0.014)."""
    rng = np.random.default_rng(2)
    rows = simulations(rng, 1000)
    odd = np.array([1.6e4, -6.6, 1.0])
    result = predictive_check(rows, odd)
    assert result.tails.min() > 0.05 and result.p_value < 0.02
    # Units do not matter.
    units = np.array([1e-6, 30.0, 1.0])
    other = predictive_check(rows * units, odd * units)
    np.testing.assert_allclose(other.distances, result.distances, rtol=1e-6)


def test_wild_simulations_do_not_hide_a_misfit():
    rng = np.random.default_rng(3)
    rows = rng.normal(size=(200, 2))
    rows[:5] = 1e8
    assert predictive_check(rows, np.array([8.0, 8.0])).p_value < 0.05
    assert predictive_check(rows, np.array([0.5, -0.5])).p_value > 0.3


def test_failures_are_left_out_and_counted():
    rng = np.random.default_rng(4)
    rows = rng.normal(size=(50, 2))
    whole = predictive_check(rows, np.zeros(2))
    broken = np.concatenate([rows, [[np.nan, 0.0], [0.0, np.inf]]])
    result = predictive_check(broken, np.zeros(2))
    assert result.failed == 2 and whole.failed == 0 and len(result.distances) == 50
    assert result.p_value == whole.p_value
    np.testing.assert_array_equal(result.tails, whole.tails)


def test_a_summary_that_never_varies():
    rng = np.random.default_rng(5)
    rows = np.stack([rng.normal(size=100), np.full(100, 3.0)], axis=1)
    assert predictive_check(rows, np.array([0.1, 3.0])).p_value > 0.1
    assert predictive_check(rows, np.array([0.1, 3.1])).p_value == 1 / 101


@pytest.mark.parametrize(
    ("simulated", "observed", "message"),
    [
        (np.zeros((30, 2)), np.zeros(3), "expected shapes"),
        (np.zeros((30, 2)), np.array([0.0, np.nan]), "a finite observation"),
        (np.ones((30, 2)), np.ones(2), "expected summaries that vary"),
        (np.full((30, 2), np.nan), np.zeros(2), f"at least {MIN_SIMULATIONS} finite rows, got 0 of 30"),
    ],
)
def test_what_cannot_be_compared_is_refused(simulated, observed, message):
    with pytest.raises(Exception, match=f"{message}|obs"):
        predictive_check(simulated, observed)
