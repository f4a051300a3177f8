"""The local model: bounded least squares against SciPy, and models of simulators whose answer is known."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from jaxlfi.diagnostics.local_model import DIRECTIONS, bounded_least_squares, local_model
from jaxlfi.distributions.support import Support

BOX = Support([0.0, -5.0], [2.0, 5.0])
ONES = np.ones(2)


def test_bounded_least_squares_against_scipy():
    rng = np.random.default_rng(0)
    for case in range(200):
        dim, size = rng.integers(1, 8), rng.integers(1, 20)
        slopes = rng.normal(size=(size, dim)) @ (np.eye(dim) + rng.choice([0, 5]) * rng.normal(size=(dim, dim)))
        slopes[:, rng.integers(dim)] *= case % 5 > 0  # a parameter that does nothing
        residual, half = 10 * rng.normal(size=size), rng.choice([0.01, 1, 10], dim)
        centre = rng.normal(size=dim)
        found = bounded_least_squares(slopes, residual, centre - half, centre + half)
        assert np.all(found >= centre - half - 1e-9) and np.all(found <= centre + half + 1e-9)
        expected = lsq_linear(slopes, residual, (centre - half, centre + half), method="bvls", tol=1e-12).cost * 2
        np.testing.assert_allclose(np.sum((residual - slopes @ found) ** 2), expected, rtol=1e-6, atol=1e-8)


def simulated(rng, theta, noise=0.1, repeats=1):
    x = np.stack([theta[:, 0], theta[:, 0] + 0.2 * theta[:, 1], 3 * theta[:, 1]], axis=1)
    x = np.tile(x, (1, repeats))
    return x + noise * rng.normal(size=x.shape)


@pytest.mark.parametrize(("n", "repeats"), [(1000, 1), (1000, 40), (25, 1), (12, 1)])
def test_a_linear_simulator_is_found_again(n, repeats):
    """With few simulations or many summaries, it uses as many components as the model can describe."""
    rng = np.random.default_rng(1)
    theta = rng.uniform(BOX.low, BOX.high, (n, 2))
    truth = np.array([1.4, 3.0])
    observed = simulated(rng, truth[None], repeats=repeats)[0]
    model = local_model(theta, simulated(rng, theta, repeats=repeats), observed, BOX)
    assert model.residual.shape == (min(3 * repeats, DIRECTIONS),)
    found = 0.5 * (BOX.low + BOX.high) + 0.5 * (BOX.high - BOX.low) * model.nearest(-ONES, ONES)
    np.testing.assert_allclose(found, truth, atol=0.4)


def test_the_misfit_has_the_distribution_of_the_noise():
    """On right boxes it is chi-squared with as many degrees of freedom as summaries minus parameters: one here."""
    rng = np.random.default_rng(2)
    theta = rng.uniform(BOX.low, BOX.high, (800, 2))
    x, truths = simulated(rng, theta), rng.uniform([0.3, -4], [1.7, 4], (200, 2))
    misfits = [local_model(theta, x, one, BOX).misfit(-ONES, ONES) for one in simulated(rng, truths)]
    assert abs(np.mean(misfits) - 1) < 0.4


def test_units_and_offsets_of_summaries_do_not_matter():
    rng = np.random.default_rng(3)
    theta = rng.uniform(BOX.low, BOX.high, (500, 2))
    x, observed = simulated(rng, theta), np.array([3.0, 3.5, 1.0])
    expected = local_model(theta, x, observed, BOX).misfit(-ONES, ONES)
    unit, offset = np.array([1e-9, 50.0, 1e9]), np.array([1e-6, 1e3, -1e10])
    again = local_model(theta, x * unit + offset, observed * unit + offset, BOX).misfit(-ONES, ONES)
    np.testing.assert_allclose(again, expected, rtol=1e-4)


def test_simulations_that_exploded_are_left_out():
    """One simulation in twenty is 1e12 times too large or not finite; a count that is nearly always 0 is harmless."""
    rng = np.random.default_rng(5)
    theta = rng.uniform(BOX.low, BOX.high, (500, 2))
    x, observed = simulated(rng, theta), np.array([3.0, 3.5, 1.0, 0.0])
    x = np.concatenate([x, rng.poisson(0.05, (500, 1))], axis=1)
    expected = local_model(theta, x, observed, BOX).misfit(-ONES, ONES)
    broken = np.concatenate([x, x[:25] * 1e12, np.full((2, 4), np.inf)])
    again = local_model(np.concatenate([theta, theta[:25], theta[:2]]), broken, observed, BOX).misfit(-ONES, ONES)
    np.testing.assert_allclose(again, expected, rtol=1e-6)


def test_there_is_none_of_too_few_simulations_or_of_constants():
    theta = np.random.default_rng(4).uniform(BOX.low, BOX.high, (50, 2))
    for few in (0, 8):
        assert local_model(theta[:few], theta[:few], theta[0], BOX) is None
    assert local_model(theta, np.full((50, 3), 4.0), np.full(3, 4.0), BOX) is None
