"""Components before the bounds truncated them, against SciPy's truncated normal and rejection in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxlfi.distributions import truncated_mixture
from jaxlfi.distributions import untruncated as module
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support

cavity, untruncated = jax.jit(module.cavity), jax.jit(module.untruncated)
weighted_points = jax.jit(truncated_mixture.weighted_points)


def gaussian(mean, covariance):
    factor = np.linalg.cholesky(np.atleast_2d(covariance))
    return GaussianMixture(np.zeros(1, np.float32), np.float32(mean)[None], np.float32(factor)[None])


def covariance_of(mixture):
    """The covariance of the first component."""
    factor = np.asarray(mixture.scale_tril, float)[0]
    return factor @ factor.T


def moments_inside(mixture, box):
    """Mean and covariance of the mixture truncated to the box."""
    points, log_weight = weighted_points(mixture, box)
    weight = np.exp(np.asarray(log_weight, float))
    mean = np.average(points, weights=weight, axis=0)
    return mean, np.cov(np.asarray(points).T, aweights=weight, ddof=0)


@pytest.mark.parametrize(
    ("low", "high"), [(-1.0, 20.0), (0.3, 20.0), (-20.0, 0.4), (-0.7, 1.2), (-0.3, 2.5), (-2.0, np.inf), (-np.inf, 1.0)]
)
def test_a_truncated_normal_is_found_again(low, high):
    """Accurate to what 30 steps reach: a fiftieth of a standard deviation, except where much is cut off."""
    mean, deviation = 3.0, 0.25
    inside = stats.truncnorm(low, high, loc=mean, scale=deviation)
    bounds = mean + deviation * np.array([low, high])
    found = cavity(*(jnp.asarray(value, jnp.float32) for value in (inside.mean(), inside.std(), *bounds)))
    of_found = stats.truncnorm(*(bounds - found[0]) / found[1], loc=float(found[0]), scale=float(found[1]))
    np.testing.assert_allclose(of_found.mean(), inside.mean(), atol=0.03 * inside.std())
    np.testing.assert_allclose(of_found.std(), inside.std(), rtol=0.02)
    if low <= -0.7 or low == -np.inf:
        np.testing.assert_allclose(found, (mean, deviation), atol=0.05 * deviation)


def test_what_is_uniform_stays_nearly_so():
    width = 12**0.5
    mean, deviation = cavity(*(jnp.asarray(value, jnp.float32) for value in (0.0, 1.0, -width / 2, width / 2)))
    assert float(stats.truncnorm(-width / 2 / deviation, width / 2 / deviation, scale=deviation).std()) > 0.95
    np.testing.assert_allclose(mean, 0.0, atol=1e-4)


@pytest.mark.parametrize("correlation", [-0.6, 0.0, 0.7])
@pytest.mark.parametrize("low", [(0.2, -9.0), (-0.5, -0.3)], ids=["one bound", "two bounds"])
def test_moments_inside_are_those_of_the_draws(low, correlation):
    """The mixture itself, truncated once more, would be up to a fifth too narrow."""
    covariance = np.array([[1.0, 0.5 * correlation], [0.5 * correlation, 0.25]])
    draws = np.random.default_rng(0).multivariate_normal([0.0, 0.0], covariance, 400_000)
    draws = draws[np.all(draws > low, axis=1)]
    fitted, box = gaussian(draws.mean(axis=0), np.cov(draws.T)), Support(list(low), [20.0, 20.0])
    found = untruncated(fitted, box)
    mean, spread = moments_inside(found, box)
    deviation = draws.std(axis=0)
    np.testing.assert_allclose((mean - draws.mean(axis=0)) / deviation, 0.0, atol=0.03)
    np.testing.assert_allclose(np.sqrt(np.diag(spread)) / deviation, 1.0, atol=0.035)
    assert np.sqrt(moments_inside(fitted, box)[1][0, 0]) / deviation[0] < 0.93
    if low[1] == -9.0:
        np.testing.assert_allclose(found.means[0], 0.0, atol=0.06)
        np.testing.assert_allclose(covariance_of(found), covariance, atol=0.07)


def test_weights_are_those_inside():
    """Each of two fitted components with equal weights, one at a bound, has half of the draws."""
    left = stats.halfnorm()
    places, deviations = np.float32([[left.mean()], [6.0]]), np.float32([[[left.std()]], [[0.5]]])
    mixture = GaussianMixture(np.log(np.float32([0.5, 0.5])), places, deviations)
    box = Support([0.0], [12.0])
    points, log_weight = weighted_points(untruncated(mixture, box), box)
    np.testing.assert_allclose(np.sum(np.exp(log_weight)[np.asarray(points)[:, 0] < 4]), 0.5, atol=0.01)


def test_far_from_bounds_and_outside_nothing_changes():
    mixture = GaussianMixture(
        np.log(np.float32([0.7, 0.3])),
        np.float32([[0.5, 1.0], [-9.0, 1.5]]),
        np.float32([[[0.4, 0.0], [0.1, 0.3]], [[0.3, 0.0], [0.0, 0.5]]]),
    )
    found = untruncated(mixture, Support([-6.0, -6.0], [6.0, 6.0]))
    np.testing.assert_allclose(found.means, mixture.means, atol=1e-4)
    np.testing.assert_allclose(found.scale_tril, mixture.scale_tril, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(found.logits, mixture.logits, atol=0.13)  # the stray component's does not matter inside
    np.testing.assert_allclose(found.logits[0], mixture.logits[0], atol=1e-4)


def test_it_commutes_with_scaling_shifting_and_reflecting():
    mixture, box = gaussian([0.7, 0.1], [[0.5, 0.2], [0.2, 0.3]]), Support([0.0, -0.4], [1.5, 7.0])
    found = untruncated(mixture, box)
    affine, low, high = jax.jit(GaussianMixture.affine), np.asarray(box.low), np.asarray(box.high)
    scale, shift = np.float32([3.0, 0.02]), np.float32([-1.0, 5.0])
    moved = untruncated(affine(mixture, scale, shift), Support(scale * low + shift, scale * high + shift))
    back = affine(moved, 1 / scale, -shift / scale)
    mirrored = untruncated(mixture.mirror(), Support(-high, -low)).mirror()
    for other in (back, mirrored):
        np.testing.assert_allclose(other.means, found.means, atol=2e-3)
        np.testing.assert_allclose(covariance_of(other), covariance_of(found), atol=2e-3)
        np.testing.assert_allclose(other.logits, found.logits, atol=2e-3)


def test_batches_are_the_same():
    mixture, box = gaussian([0.7, 0.1], [[0.5, 0.2], [0.2, 0.3]]), Support([0.0, -0.4], [1.5, 7.0])
    found = untruncated(mixture, box)
    boxes = jax.tree.map(lambda leaf: np.stack([leaf, np.asarray(leaf) + 0.2]), box)
    batch = jax.jit(jax.vmap(module.untruncated, in_axes=(None, 0)))(mixture, boxes)
    np.testing.assert_allclose(batch.means[0], found.means, atol=1e-4)
    other = untruncated(mixture, jax.tree.map(lambda leaf: leaf[1], boxes))
    np.testing.assert_allclose(batch.scale_tril[1], other.scale_tril, atol=1e-4)
