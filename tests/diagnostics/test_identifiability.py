"""Combinations of parameters that hardly vary: what is put into words must be so, and must never fail."""

import numpy as np
import pytest

from jaxlfi.diagnostics.identifiability import trade_offs

COVARIANCE = np.array(
    [
        [0.0788, 0.1036, 0.0081, 0.0134],
        [0.1036, 0.1738, 0.1994, 0.0696],
        [0.0081, 0.1994, 4.2877, 0.9922],
        [0.0134, 0.0696, 0.9922, 0.3108],
    ]
)
"""All four are correlated, but the third drops out of what is known once it is written in simple numbers."""


def exactly(covariance, mean=0.0, n=200):
    """Draws of this very covariance."""
    z = np.random.default_rng(0).normal(size=(n, len(covariance)))
    z -= z.mean(axis=0)
    z = np.linalg.solve(np.linalg.cholesky(z.T @ z / n), z.T).T
    return mean + z @ np.linalg.cholesky(covariance).T


def test_a_parameter_that_drops_out_of_the_words_ends_nothing():
    assert trade_offs("abcd", exactly(COVARIANCE, -4.0)) == []


@pytest.mark.parametrize("seed", range(40))
def test_no_covariance_ends_it(seed):
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(4, 4)) * np.exp(rng.normal(0.0, 1.5, 4))
    for found in trade_offs("abcd", exactly(factor @ factor.T)):
        assert len(found.known) + len(found.unknown) == len(found.places)


@pytest.mark.parametrize("spread", [1e-3, 1e-5])
@pytest.mark.parametrize("weights", [(1.2345, 0.024567), (0.31, 17.77)])
def test_the_interval_is_of_the_combination_as_it_is_written(weights, spread):
    """Weights are rounded only as far as the combination stays known; the interval is that of the rounded ones."""
    rng = np.random.default_rng(3)
    others = rng.normal([0.3, 9.0], 0.02 / np.array(weights), (4000, 2))
    first = 2.9 - others @ weights + spread * rng.normal(size=4000)
    draws = np.column_stack([first, others])
    (found,) = trade_offs(("a", "b", "c"), draws)
    (text,), ((median, low, high),) = found.known, found.ranges
    written = eval(text, dict(zip("abc", draws.T, strict=True)))
    np.testing.assert_allclose((median, low, high), np.quantile(written, (0.5, 0.05, 0.95)), rtol=1e-9)
    weight = abs(eval(text, {"a": 1.0, "b": 0.0, "c": 0.0}))
    assert high - low < 1.25 * 2 * 1.645 * spread * weight


def test_weights_that_need_no_digits_have_few():
    """Two digits are enough for a combination that is known five times as well as its parameters."""
    rng = np.random.default_rng(4)
    b = rng.normal(5.0, 1.0, 4000)
    (found,) = trade_offs(("a", "b"), np.column_stack([-1.3791 * b + 0.3 * rng.normal(size=4000), b]))
    assert found.known == ("a + 1.4 * b",)
