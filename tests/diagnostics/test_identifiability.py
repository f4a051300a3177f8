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
