"""CMA-ES finds optima that are known: of a sphere, of an ill-conditioned ellipsoid, and on the bounds of the cube."""

import numpy as np
import pytest

from jaxlfi.design.evolution import maximise


@pytest.mark.parametrize("seed", range(3))
def test_sphere(seed):
    centre = np.array([0.3, 0.6, 0.45, 0.7])
    found = maximise(
        np.random.default_rng(seed), lambda x: -np.sum((x - centre) ** 2, axis=1), np.full(4, 0.1), generations=100
    )
    np.testing.assert_allclose(found.point, centre, atol=2e-3)
    assert found.value == found.values.max() and found.points.shape == (len(found.values), 4)


@pytest.mark.parametrize("seed", range(3))
def test_rotated_ellipsoid_of_condition_ten_thousand(seed):
    """A search that does not learn the covariance is still far away after as many evaluations."""
    rotation = np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))[0]
    scales, centre = np.array([1.0, 10.0, 100.0]), np.array([0.4, 0.55, 0.5])
    objective = lambda x: -np.sum(((x - centre) @ rotation * scales) ** 2, axis=1)
    found = maximise(np.random.default_rng(seed), objective, np.full(3, 0.8), generations=150)
    assert np.abs(found.point - centre).max() < 0.01 and found.value > -1e-2


@pytest.mark.parametrize("seed", range(3))
def test_an_optimum_on_the_bounds(seed):
    """The linear part draws the search into the corner (1, .), the rest keeps the second coordinate inside."""
    objective = lambda x: 3 * x[:, 0] - (x[:, 1] - 0.25) ** 2
    found = maximise(np.random.default_rng(seed), objective, np.array([0.2, 0.9]), generations=60)
    np.testing.assert_allclose(found.point, [1.0, 0.25], atol=0.02)
    assert ((found.points >= 0) & (found.points <= 1)).all()


def test_what_is_not_finite_is_the_worst():
    objective = lambda x: np.where(x[:, 0] > 0.5, np.nan, x[:, 0])
    found = maximise(np.random.default_rng(0), objective, np.array([0.4, 0.5]), generations=40)
    assert 0.45 < found.point[0] <= 0.5 and np.isfinite(found.value)
