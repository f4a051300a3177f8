"""GaussianMixture against SciPy in float64, against its own draws, and in corner cases."""

import chex
import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.optimize import brentq
from scipy.special import logsumexp, ndtr

from jaxlfi.distributions.mixture import FARTHEST, GaussianMixture, component_log_prob, systematic
from tests.strategies import floats, keys, mixtures, shapes, vectors

N = 20_000

EXAMPLE = GaussianMixture(
    logits=jnp.log(jnp.array([0.55, 0.1, 0.35])),
    means=jnp.array([[0.0, 2.0], [3.0, -1.0], [-2.0, 0.5]]),
    scale_tril=jnp.array([[[1.0, 0.0], [0.8, 0.5]], [[0.3, 0.0], [-0.1, 0.2]], [[0.5, 0.0], [0.0, 1.5]]]),
)
"""Three components of different weights, places, widths and correlations."""

# Methods, compiled once for each shape.
SAMPLE = jax.jit(GaussianMixture.sample, static_argnums=2)
LOW_VARIANCE_SAMPLE = jax.jit(GaussianMixture.low_variance_sample, static_argnums=2)
AFFINE = jax.jit(GaussianMixture.affine)
INFLATED = jax.jit(GaussianMixture.inflated)
PERMUTE = jax.jit(GaussianMixture.permute)
MOMENTS = jax.jit(lambda mixture: (mixture.mean, mixture.covariance))
LOG_PROB = jax.jit(GaussianMixture.log_prob)
INTERVAL_MASS = jax.jit(GaussianMixture.interval_mass)
MARGINAL_CDF = jax.jit(GaussianMixture.marginal_cdf)
MARGINAL_QUANTILE = jax.jit(GaussianMixture.marginal_quantile)


def reference(mixture: GaussianMixture):
    """Weights, means and covariances in float64."""
    logits = np.asarray(mixture.logits, np.float64)
    tril = np.asarray(mixture.scale_tril, np.float64)
    weights = np.exp(logits - logsumexp(logits))
    return weights, np.asarray(mixture.means, np.float64), tril @ np.swapaxes(tril, -1, -2)


def reference_log_prob(mixture: GaussianMixture, theta) -> np.ndarray:
    """Log-density by SciPy."""
    terms = [
        np.log(w) + stats.multivariate_normal(m, c, allow_singular=True).logpdf(np.asarray(theta, np.float64))
        for w, m, c in zip(*reference(mixture), strict=True)
        if w > 0
    ]
    return logsumexp(terms, axis=0)


def reference_mass(mixture: GaussianMixture, low, high) -> np.ndarray:
    """Marginal masses of [low, high], computed from the tail in which they are small."""
    weights, means, covariances = reference(mixture)
    scales = np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))
    a, b = (low - means) / scales, (high - means) / scales
    return weights @ np.where(a > 0, ndtr(-a) - ndtr(-b), ndtr(b) - ndtr(a))


@given(shapes().flatmap(lambda kd: st.tuples(mixtures(*kd), vectors(-5.0, 5.0, 6, kd[1]))))
def test_log_prob_is_scipys(drawn):
    mixture, theta = drawn
    np.testing.assert_allclose(LOG_PROB(mixture, theta), reference_log_prob(mixture, theta), rtol=1e-3, atol=1e-3)


@given(shapes().flatmap(lambda kd: st.tuples(mixtures(*kd), vectors(-5.0, 5.0, kd[1]))))
def test_component_log_prob_adds_up_to_log_prob(drawn):
    mixture, theta = drawn
    _, means, covariances = reference(mixture)
    each = jax.jit(component_log_prob)(mixture, jnp.asarray(theta))
    expected = [stats.multivariate_normal(m, c).logpdf(theta) for m, c in zip(means, covariances, strict=True)]
    np.testing.assert_allclose(each, expected, rtol=1e-3, atol=1e-3)


@jax.jit
def by_distrax(mixture, theta):
    """Log-densities of the distrax distribution."""
    return mixture.distribution().log_prob(theta)


@hypothesis.settings(max_examples=20)
@given(shapes().flatmap(lambda kd: st.tuples(mixtures(*kd), vectors(-5.0, 5.0, 6, kd[1]))))
def test_distrax_gives_the_same_densities(drawn):
    mixture, theta = drawn
    np.testing.assert_allclose(LOG_PROB(mixture, theta), by_distrax(mixture, theta), rtol=1e-4, atol=1e-3)


@given(shapes().flatmap(lambda kd: st.tuples(mixtures(*kd), vectors(-3.0, 3.0, kd[1]))), floats(1.0, 4.0))
def test_inflated_is_the_density_of_points_moved_away_from_the_mean(drawn, factor):
    mixture, theta = drawn
    mean, covariance = MOMENTS(mixture)
    factor = min(factor, 1 + 0.999 * FARTHEST / max(distances(mixture, mean).max(), 1e-6))  # so all components can move
    wide = INFLATED(mixture, factor)
    wide_mean, wide_covariance = MOMENTS(wide)
    scale = np.abs(np.asarray(covariance)).max()
    np.testing.assert_allclose(wide_mean, mean, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(wide_covariance, factor**2 * covariance, rtol=2e-3, atol=2e-4 * factor**2 * scale)
    mean = np.asarray(mean, np.float64)
    expected = reference_log_prob(mixture, theta) - len(mean) * np.log(factor)
    np.testing.assert_allclose(reference_log_prob(wide, mean + factor * (theta - mean)), expected, rtol=2e-3, atol=2e-2)


@given(shapes().flatmap(lambda kd: mixtures(*kd)), floats(1.0, 4.0))
def test_inflated_leaves_peaks_far_apart_where_they_are(mixture, factor):
    wide, (mean, _) = INFLATED(mixture, factor), MOMENTS(mixture)
    np.testing.assert_allclose(wide.scale_tril, factor * np.asarray(mixture.scale_tril), rtol=1e-6)
    wanted = np.minimum((factor - 1) * distances(mixture, mean), FARTHEST)
    moved = distances(mixture, mixture.means - (wide.means - mixture.means))
    np.testing.assert_allclose(moved, wanted, rtol=2e-2, atol=2e-3)


def distances(mixture, points):
    """Distance of each component's mean from a common or its own point, in its standard deviations."""
    offset = np.asarray(mixture.means, np.float64) - np.asarray(points, np.float64)
    whitened = np.linalg.solve(np.asarray(mixture.scale_tril, np.float64), offset[..., None])
    return np.linalg.norm(whitened, axis=(-2, -1))


@given(shapes().flatmap(lambda kd: mixtures(*kd)))
def test_inflated_by_one_changes_no_bit(mixture):
    chex.assert_trees_all_equal(INFLATED(mixture, 1.0), mixture)


@given(shapes().flatmap(lambda kd: st.tuples(mixtures(*kd), vectors(-6.0, 6.0, 2, kd[1]))))
def test_interval_mass_and_cdf_are_scipys(drawn):
    mixture, bounds = drawn
    low, high = np.sort(bounds, axis=0)
    np.testing.assert_allclose(INTERVAL_MASS(mixture, low, high), reference_mass(mixture, low, high), atol=3e-6)
    expected = reference_mass(mixture, np.full_like(low, -np.inf), high)
    np.testing.assert_allclose(MARGINAL_CDF(mixture, high), expected, atol=3e-6)


@given(floats(2.0, 11.0), floats(0.25, 2.0), floats(0.1, 3.0), st.booleans())
def test_far_tails_keep_their_relative_precision(z, length, scale, upper):
    mixture = GaussianMixture(jnp.zeros(1), jnp.array([[0.5, -0.5]]), scale * jnp.eye(2)[None])
    mean, scales = np.array([0.5, -0.5]), np.float64(np.float32(scale))
    near = (mean + (z if upper else -z) * scales).astype(np.float32)
    far = (mean + (z + length) * (1 if upper else -1) * scales).astype(np.float32)
    low, high = (near, far) if upper else (far, near)
    # A rounded bound moves the mass by about z times its error in scales.
    tolerance = 1e-4 * (1 + z / scale)
    np.testing.assert_allclose(INTERVAL_MASS(mixture, low, high), reference_mass(mixture, low, high), rtol=tolerance)
    infinite = np.full(2, np.inf, np.float32)
    low, high = (near, infinite) if upper else (-infinite, near)
    np.testing.assert_allclose(INTERVAL_MASS(mixture, low, high), reference_mass(mixture, low, high), rtol=tolerance)


def test_tail_masses_by_hand():
    """Masses such as Phi(-6) - Phi(-7), also where a plain difference of CDFs would be zero in float32."""
    mixture = GaussianMixture(jnp.log(jnp.array([0.75, 0.25])), jnp.array([[0.0], [100.0]]), jnp.ones((2, 1, 1)))
    for low, high, mass in (
        (6.0, 7.0, 0.75 * 9.853078e-10),
        (-7.0, -6.0, 0.75 * 9.853078e-10),
        (106.0, np.inf, 0.25 * 9.865876e-10),
        (-np.inf, np.inf, 1.0),
    ):
        bounds = np.array([[low], [high]], np.float32)
        np.testing.assert_allclose(INTERVAL_MASS(mixture, *bounds), [mass], rtol=1e-5)


def reference_quantile(mixture: GaussianMixture, level: float, d: int) -> float:
    """A root of the marginal CDF by SciPy."""
    weights, means, covariances = reference(mixture)
    cdf = lambda x: weights @ ndtr((x - means[:, d]) / np.sqrt(covariances[:, d, d]))
    return brentq(lambda x: cdf(x) - level, -1e3, 1e3, xtol=1e-13)


@pytest.mark.parametrize("level", [1e-12, 1e-5, 1e-3, 0.1, 0.4999, 0.9])
def test_marginal_quantiles_are_scipys_roots(level):
    expected = [reference_quantile(EXAMPLE, level, d) for d in range(2)]
    np.testing.assert_allclose(MARGINAL_QUANTILE(EXAMPLE, level), expected, rtol=2e-6)


@given(shapes().flatmap(lambda kd: mixtures(*kd)), floats(1e-6, 0.999))
def test_the_quantile_of_a_level_has_that_mass_below(mixture, level):
    """This also holds in a gap between components, where the quantile itself is not determined."""
    quantile = np.asarray(MARGINAL_QUANTILE(mixture, level))
    below = reference_mass(mixture, np.full_like(quantile, -np.inf), quantile)
    np.testing.assert_allclose(below, level, rtol=2e-5)


def test_quantiles_at_the_corners():
    levels = np.array([0.0, 1.0], np.float32)
    np.testing.assert_array_equal(MARGINAL_QUANTILE(EXAMPLE, levels), [-np.inf, np.inf])
    far = GaussianMixture(jnp.array([0.0, -jnp.inf]), jnp.array([[3.0], [1e30]]), jnp.array([[[2.0]], [[1e20]]]))
    for level in (1e-3, 0.5, 0.99):
        np.testing.assert_allclose(MARGINAL_QUANTILE(far, level), stats.norm(3, 2).ppf(level), rtol=2e-6)


def test_quantiles_from_above_are_those_of_the_mirrored_mixture():
    """In the upper tail, 1 - level is no longer representable in float32."""
    mirrored = GaussianMixture(EXAMPLE.logits, -EXAMPLE.means, EXAMPLE.scale_tril)
    chex.assert_trees_all_equal(EXAMPLE.mirror(), mirrored)
    expected = [reference_quantile(mirrored, 1e-9, d) for d in range(2)]
    np.testing.assert_allclose(MARGINAL_QUANTILE(EXAMPLE.mirror(), 1e-9), expected, rtol=2e-6)
    theta = np.array([[0.3, -2.0], [1.0, 1.0]], np.float32)
    np.testing.assert_allclose(LOG_PROB(EXAMPLE.mirror(), -theta), LOG_PROB(EXAMPLE, theta), rtol=1e-6)


def test_quantiles_of_vectors_and_batches_are_those_of_each_one():
    levels = np.array([[0.1, 0.2], [0.3, 0.01]], np.float32)
    together = jax.jit(jax.vmap(EXAMPLE.marginal_quantile))(levels)
    for i, d in np.ndindex(2, 2):
        np.testing.assert_allclose(together[i, d], MARGINAL_QUANTILE(EXAMPLE, levels[i, d])[d], rtol=1e-6)


def test_derivatives_of_quantiles_are_those_of_the_implicit_function():
    """Central differences of SciPy's roots, in a mean, a factor, a logit and the level."""
    one = jax.jit(jax.grad(lambda mixture, level: mixture.marginal_quantile(level)[1], argnums=(0, 1)))
    gradient, slope = one(EXAMPLE, 0.05)

    def difference(changed, step=1e-4):
        ends = [reference_quantile(*changed(sign * step), 1) for sign in (1, -1)]
        return (ends[0] - ends[1]) / (2 * step)

    def moved(field, place):
        old = np.asarray(getattr(EXAMPLE, field), np.float64)

        def changed(step):
            new = old.copy()
            new[place] += step
            return EXAMPLE.replace(**{field: new}), 0.05

        return changed

    np.testing.assert_allclose(slope, difference(lambda step: (EXAMPLE, 0.05 + step)), rtol=1e-3)
    for field, place in (("means", (1, 1)), ("scale_tril", (0, 1, 0)), ("logits", (2,))):
        expected = difference(moved(field, place))
        assert abs(expected) > 0.01
        np.testing.assert_allclose(getattr(gradient, field)[place], expected, rtol=1e-3)


def test_moments_are_those_of_its_draws(key):
    draws = np.asarray(SAMPLE(EXAMPLE, key, N), np.float64)
    mean, covariance = (np.asarray(moment) for moment in MOMENTS(EXAMPLE))
    centred = draws - mean
    np.testing.assert_array_less(np.abs(centred.mean(0)), 5 * draws.std(0) / np.sqrt(N))
    outer = centred[:, :, None] * centred[:, None, :]
    np.testing.assert_array_less(np.abs(outer.mean(0) - covariance), 5 * outer.std(0) / np.sqrt(N))


def test_moments_by_hand():
    mixture = GaussianMixture(
        jnp.log(jnp.array([3.0, 1.0])),
        jnp.array([[0.0, 1.0], [4.0, 1.0]]),
        jnp.array([[[1.0, 0.0], [2.0, 1.0]], [[3.0, 0.0], [0.0, 1.0]]]),
    )
    np.testing.assert_allclose(mixture.weights, [0.75, 0.25], rtol=1e-6)
    np.testing.assert_allclose(mixture.covariances[0], [[1.0, 2.0], [2.0, 5.0]], rtol=1e-6)
    np.testing.assert_allclose(mixture.marginal_scales, [[1.0, 5.0**0.5], [3.0, 1.0]], rtol=1e-6)
    np.testing.assert_allclose(mixture.mean, [1.0, 1.0], rtol=1e-6)
    np.testing.assert_allclose(mixture.covariance, [[6.0, 1.5], [1.5, 4.0]], rtol=1e-6)


@pytest.mark.parametrize("method", [SAMPLE, LOW_VARIANCE_SAMPLE], ids=["independent", "systematic"])
def test_marginals_of_draws_are_the_closed_form(method, key):
    draws = np.asarray(method(EXAMPLE, key, N))
    assert draws.shape == (N, 2)
    cdf = np.asarray(jax.jit(jax.vmap(EXAMPLE.marginal_cdf))(draws))
    for d in range(2):
        assert stats.kstest(cdf[:, d], "uniform").pvalue > 1e-3
    # The marginals do not depend on the correlations.
    first = draws[(draws[:, 0] > -1) & (draws[:, 0] < 2)]
    assert np.corrcoef(first.T)[0, 1] > 0.3


@pytest.mark.parametrize("n", [7, 1000])
@given(vectors(0.0, 1.0, 4), keys())
def test_systematic_counts_are_within_one_of_their_expectation(n, weights, key):
    hypothesis.assume(weights.sum() > 0.1)
    weights = weights / weights.sum()
    counts = np.bincount(jax.jit(systematic, static_argnums=2)(key, weights, n), minlength=4)
    assert counts.sum() == n
    assert (np.abs(counts - n * weights.astype(np.float64)) < 1.0 + 1e-5 * n).all()
    assert (counts[weights == 0] == 0).all()


def test_systematic_is_unbiased_over_its_offset(key):
    weights, n, offsets = jnp.array([0.05, 0.42, 0.0, 0.53]), 7, 4000
    drawn = jax.jit(jax.vmap(lambda k: systematic(k, weights, n)))(jax.random.split(key, offsets))
    counts = np.stack([np.asarray(drawn == k).sum(axis=1) for k in range(4)], axis=1)
    # A count takes one of two neighbouring values: its standard deviation is at most one half.
    np.testing.assert_array_less(np.abs(counts.mean(0) - n * np.asarray(weights)), 5 * 0.5 / np.sqrt(offsets))
    assert counts.std(0)[1] > 0.1


@pytest.mark.parametrize("offset", [0.0, 1.0 - 2.0**-24])
@pytest.mark.parametrize("n", [3, 4096])
def test_systematic_never_picks_an_absent_component(offset, n, monkeypatch, key):
    """With the largest offset the last point rounds up to the whole sum; with the smallest the first point is 0."""
    monkeypatch.setattr(jax.random, "uniform", lambda _: jnp.float32(offset))
    drawn = np.asarray(systematic(key, jnp.array([0.0, 0.3, 0.7, 0.0]), n))
    assert set(drawn.tolist()) <= {1, 2}


@given(keys())
def test_low_variance_draws_share_out_the_components(key):
    apart = GaussianMixture(
        jnp.log(jnp.array([0.15, 0.6, 0.25])), jnp.array([[0.0], [100.0], [200.0]]), jnp.ones((3, 1, 1))
    )
    draws = np.asarray(LOW_VARIANCE_SAMPLE(apart, key, 12))
    counts = np.bincount(np.rint(draws[:, 0] / 100.0).astype(int), minlength=3)
    assert (np.abs(counts - 12 * np.array([0.15, 0.6, 0.25])) < 1.0).all()


def test_low_variance_draws_come_in_random_order(key):
    apart = GaussianMixture(jnp.zeros(2), jnp.array([[0.0], [100.0]]), jnp.ones((2, 1, 1)))
    second = np.asarray(LOW_VARIANCE_SAMPLE(apart, key, 2000))[:, 0] > 50
    assert second.sum() == 1000
    assert abs(second[:1000].sum() - 500) < 5 * np.sqrt(2000) / 4


@given(shapes().flatmap(lambda kd: st.tuples(mixtures(*kd), vectors(0.1, 3.0, kd[1]), vectors(-3.0, 3.0, 2, kd[1]))))
def test_affine_changes_variables(drawn):
    mixture, scale, (shift, theta) = drawn
    moved = AFFINE(mixture, scale, shift)
    expected = np.asarray(LOG_PROB(mixture, theta)) - np.log(scale).sum()
    np.testing.assert_allclose(LOG_PROB(moved, scale * theta + shift), expected, rtol=2e-3, atol=2e-2)
    np.testing.assert_allclose(moved.means, scale * np.asarray(mixture.means) + shift, rtol=1e-5, atol=1e-5)


def test_affine_scales_rows_not_columns():
    moved = AFFINE(EXAMPLE, jnp.array([2.0, 10.0]), jnp.array([1.0, -1.0]))
    np.testing.assert_allclose(moved.means[0], [1.0, 19.0])
    np.testing.assert_allclose(moved.covariances[0], [[4.0, 16.0], [16.0, 89.0]], rtol=1e-6)


def test_permute_moves_whole_components():
    permuted = PERMUTE(EXAMPLE, jnp.array([2, 0, 1]))
    np.testing.assert_array_equal(permuted.logits, np.asarray(EXAMPLE.logits)[[2, 0, 1]])
    np.testing.assert_array_equal(permuted.means, np.asarray(EXAMPLE.means)[[2, 0, 1]])
    np.testing.assert_array_equal(permuted.scale_tril, np.asarray(EXAMPLE.scale_tril)[[2, 0, 1]])


@pytest.mark.parametrize("place", [0, 1, 3])
def test_an_absent_component_is_not_there(place, key):
    absent = GaussianMixture(
        logits=jnp.asarray(np.insert(EXAMPLE.logits, place, -np.inf)),
        means=jnp.asarray(np.insert(EXAMPLE.means, place, 50.0, axis=0)),
        scale_tril=jnp.asarray(np.insert(EXAMPLE.scale_tril, place, 7.0 * np.eye(2), axis=0)),
    )
    theta = np.array([[0.0, 1.0], [3.0, -1.0], [50.0, 50.0]], np.float32)
    np.testing.assert_allclose(LOG_PROB(absent, theta), LOG_PROB(EXAMPLE, theta), rtol=1e-6)
    chex.assert_trees_all_close(MOMENTS(absent), MOMENTS(EXAMPLE), rtol=1e-5)
    np.testing.assert_allclose(MARGINAL_CDF(absent, theta[0]), MARGINAL_CDF(EXAMPLE, theta[0]), rtol=1e-6)
    for low, high in ((theta[1], theta[2]), (np.full(2, -np.inf, np.float32), theta[0])):
        masses = INTERVAL_MASS(absent, low, high), INTERVAL_MASS(EXAMPLE, low, high)
        np.testing.assert_allclose(*masses, rtol=1e-5)
    key_independent, key_systematic = jax.random.split(key)
    for draws in (SAMPLE(absent, key_independent, 2000), LOW_VARIANCE_SAMPLE(absent, key_systematic, 2000)):
        assert np.max(draws) < 20.0
    gradient = jax.jit(jax.grad(GaussianMixture.log_prob))(absent, theta[0])
    chex.assert_tree_all_finite((gradient.means, gradient.scale_tril))


def test_properties_of_a_batch_are_those_of_its_members():
    def properties(mixture):
        return mixture.weights, mixture.covariances, mixture.marginal_scales, mixture.mean, mixture.covariance

    batch = GaussianMixture(
        *(np.stack([leaf, 0.5 * np.asarray(leaf)]) for leaf in (EXAMPLE.logits, EXAMPLE.means, EXAMPLE.scale_tril))
    )
    together = jax.jit(properties)(batch)
    for i in range(2):
        alone = jax.jit(properties)(jax.tree.map(lambda leaf, i=i: leaf[i], batch))
        chex.assert_trees_all_close(tuple(np.asarray(part)[i] for part in together), alone, rtol=1e-5, atol=1e-6)
