"""Mixtures fitted to samples: closed forms, known mixtures, and changes that must not matter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from jaxlfi.distributions.mixture_fit import fit_mixture

FIT = jax.jit(fit_mixture, static_argnames=("components", "iterations", "restarts"))
SETTINGS = {"components": 3, "iterations": 15, "restarts": 2}
"""Settings of most tests, which share one compiled program."""

WEIGHTS = np.array([0.6, 0.3, 0.1])
MEANS = np.array([[4.0, -1.0], [-3.0, 2.0], [0.5, 9.0]])
FACTORS = np.array([[[1.0, 0.0], [0.4, 0.3]], [[0.5, 0.0], [-0.4, 0.8]], [[0.2, 0.0], [0.1, 0.7]]])
COVARIANCES = FACTORS @ FACTORS.transpose(0, 2, 1)


@pytest.fixture(scope="module")
def separated():
    """Samples of three distant Gaussians, and the Gaussian of each."""
    draw = np.random.default_rng(0)
    label = draw.choice(3, 1200, p=WEIGHTS)
    theta = MEANS[label] + np.einsum("nij,nj->ni", FACTORS[label], draw.normal(size=(1200, 2)))
    return theta.astype(np.float32), label


@pytest.fixture(scope="module")
def skewed():
    """Weighted samples that no mixture of three describes well, so that the maximisation takes long."""
    draw = np.random.default_rng(1)
    theta = np.stack([draw.gamma(1.5, 1.0, 1200), draw.standard_t(4, 1200)], axis=1)
    theta[:, 1] += theta[:, 0] ** 2
    return theta.astype(np.float32), draw.exponential(size=1200).astype(np.float32)


def by_weight(mixture):
    """Weights, means and covariances, heaviest component first."""
    order = np.argsort(-np.asarray(mixture.weights))
    return [np.asarray(part)[order] for part in (mixture.weights, mixture.means, mixture.covariances)]


def test_one_component_has_the_samples_moments(skewed):
    theta, weights = skewed
    mixture, history = FIT(jax.random.key(0), theta, weights, components=1, iterations=2, restarts=1)
    np.testing.assert_allclose(mixture.weights, [1.0])
    mean = np.average(theta, axis=0, weights=weights)
    covariance = np.cov(theta.T, aweights=weights, ddof=0)
    np.testing.assert_allclose(mixture.means[0], mean, rtol=1e-4)
    np.testing.assert_allclose(mixture.covariances[0], covariance, rtol=1e-3)
    log_prob = stats.multivariate_normal(mean, covariance).logpdf(theta)
    np.testing.assert_allclose(history[-1], np.average(log_prob, weights=weights), rtol=1e-4)


@pytest.mark.parametrize("seed", range(3))
def test_recovers_components_far_apart(separated, seed):
    """Maximum likelihood finds the moments of each group by itself if groups do not overlap."""
    theta, label = separated
    mixture, _ = FIT(jax.random.key(seed), theta, jnp.ones(1200), **SETTINGS)
    weights, means, covariances = by_weight(mixture)
    np.testing.assert_allclose(weights, np.bincount(label) / 1200, atol=1e-3)
    for k in range(3):
        np.testing.assert_allclose(means[k], theta[label == k].mean(0), atol=5e-3)
        np.testing.assert_allclose(covariances[k], np.cov(theta[label == k].T, ddof=0), atol=1e-2)
    assert (np.triu(np.asarray(mixture.scale_tril), 1) == 0).all()


@pytest.mark.parametrize("seed", range(4))
def test_the_likelihood_never_decreases_and_is_that_of_the_mixture(skewed, seed):
    theta, weights = skewed
    mixture, history = FIT(jax.random.key(seed), theta, weights, floor=0.2, **SETTINGS)
    assert history.shape == (16,)
    assert np.diff(history).min() > -2e-6 * np.abs(history).max()
    assert history[-1] > history[0] + 0.1
    parts = zip(np.asarray(mixture.means), np.asarray(mixture.covariances, np.float64), strict=True)
    each = np.stack([stats.multivariate_normal(mean, covariance).logpdf(theta) for mean, covariance in parts], axis=1)
    expected = np.average(special.logsumexp(each, b=np.asarray(mixture.weights), axis=1), weights=weights)
    np.testing.assert_allclose(history[-1], expected, atol=2e-3)


def test_more_restarts_are_no_less_likely(skewed):
    theta, weights = skewed
    _, few = FIT(jax.random.key(7), theta, weights, components=3, iterations=15, restarts=1)
    each = [FIT(k, theta, weights, components=3, iterations=15, restarts=1)[1][-1] for k in _keys(6)]
    _, many = FIT(jax.random.key(8), theta, weights, components=3, iterations=15, restarts=6)
    assert np.std([*each, few[-1]]) > 1e-4
    assert many[-1] >= np.median([*each, few[-1]]) - 1e-5


def _keys(n):
    return [jax.random.key(100 + i) for i in range(n)]


def test_shifts_and_scales_carry_over(skewed):
    theta, weights = skewed
    scale, shift = np.array([32.0, 0.25], np.float32), np.array([-64.0, 5.0], np.float32)
    plain, history = FIT(jax.random.key(2), theta, weights, **SETTINGS)
    moved, moved_history = FIT(jax.random.key(2), theta * scale + shift, 3 * weights, **SETTINGS)
    expected = plain.affine(jnp.asarray(scale), jnp.asarray(shift))
    np.testing.assert_allclose(moved.weights, expected.weights, atol=1e-3)
    np.testing.assert_allclose(moved.means / scale, expected.means / scale, atol=5e-3)
    np.testing.assert_allclose(moved.scale_tril, expected.scale_tril, rtol=2e-2, atol=2e-2)
    np.testing.assert_allclose(moved_history, history - np.log(scale).sum(), atol=1e-3)


def test_the_order_of_the_samples_is_nothing(separated):
    theta, _ = separated
    order = np.random.default_rng(3).permutation(1200)
    one, _ = FIT(jax.random.key(1), theta, jnp.ones(1200), **SETTINGS)
    other, _ = FIT(jax.random.key(1), theta[order], jnp.ones(1200), **SETTINGS)
    for part, expected in zip(by_weight(other), by_weight(one), strict=True):
        np.testing.assert_allclose(part, expected, atol=2e-3)


def test_a_weight_is_so_many_samples_and_none_is_no_sample(separated):
    theta, _ = separated
    times = np.random.default_rng(4).permutation(np.arange(1200) % 3)  # 1200 in all
    dirty = np.where(times[:, None] > 0, theta, np.nan)
    repeated = np.repeat(theta, times, axis=0)
    weighted, _ = FIT(jax.random.key(1), dirty, jnp.asarray(times, jnp.float32), **SETTINGS)
    plain, _ = FIT(jax.random.key(1), repeated, jnp.ones(len(repeated)), **SETTINGS)
    for part, expected in zip(by_weight(weighted), by_weight(plain), strict=True):
        np.testing.assert_allclose(part, expected, atol=2e-3)


@pytest.mark.parametrize("value", [0.0, 3.3, -1e4])
def test_equal_samples_give_a_finite_narrow_mixture_there(value):
    mixture, history = FIT(jax.random.key(0), jnp.full((1200, 2), value), jnp.ones(1200), **SETTINGS)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(mixture.covariances)) and np.isfinite(history).all()
    np.testing.assert_allclose(mixture.means, value, rtol=1e-5)
    scales = np.asarray(mixture.marginal_scales)
    assert (scales > 0).all() and (scales <= 1e-5 * max(1.0, abs(value))).all()
    width = 1e-3 * max(1.0, abs(value))
    inside = mixture.interval_mass(jnp.full(2, value - width), jnp.full(2, value + width))
    np.testing.assert_allclose(inside, 1, rtol=1e-5)


def test_components_keep_the_floor_where_samples_lie_on_a_line_or_repeat():
    draw = np.random.default_rng(5)
    along = np.concatenate([draw.normal(size=600), np.repeat(draw.normal(size=3), 200)])
    theta = np.stack([along, -2 * along], axis=1).astype(np.float32)
    mixture, history = FIT(jax.random.key(0), theta, jnp.ones(1200), floor=1e-3, **SETTINGS)
    spread = theta.std(0)
    least = np.linalg.eigvalsh(np.asarray(mixture.covariances) / np.outer(spread, spread))[:, 0]
    np.testing.assert_allclose(least, 1e-3, rtol=2e-2)
    assert np.isfinite(history).all()


def test_maps_over_batches(separated, skewed):
    both = jnp.stack([separated[0], skewed[0]])
    weights = jnp.stack([jnp.ones(1200), skewed[1]])
    mapped = jax.vmap(lambda theta, weights: FIT(jax.random.key(3), theta, weights, **SETTINGS)[1])(both, weights)
    for row in (0, 1):
        _, history = FIT(jax.random.key(3), both[row], weights[row], **SETTINGS)
        np.testing.assert_allclose(mapped[row], history, atol=2e-3)


@pytest.mark.parametrize("name", ["components", "iterations", "restarts"])
def test_refuses_counts_below_one(name):
    with pytest.raises(ValueError, match=f"{name}: expected at least 1, got 0"):
        fit_mixture(jax.random.key(0), jnp.zeros((4, 2)), jnp.ones(4), **{**SETTINGS, name: 0})
