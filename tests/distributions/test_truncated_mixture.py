"""Draws of a mixture truncated to a box that rejection cannot reach, against SciPy and against plain rejection."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncated_mixture import log_mass, rough_mass, truncated_mixture_draws

N = 4000
DRAWS = jax.jit(truncated_mixture_draws, static_argnums=3)
CRITICAL = stats.kstwobign.isf(1e-3) / np.sqrt(N)
"""A Kolmogorov-Smirnov statistic that exact draws exceed once in a thousand."""
RESAMPLING_ERROR = 0.01
"""Error of the distribution function if 64 candidates are few: for 32, 0.03 was measured in the thin corner below."""


def gaussian(mean: float, scale: float) -> GaussianMixture:
    """One component in one dimension."""
    return GaussianMixture(jnp.zeros(1), jnp.array([[mean]]), jnp.array([[[scale]]]))


def box(low: float, high: float) -> Support:
    """An interval."""
    return Support([low], [high])


@pytest.mark.parametrize("side", [1, -1], ids=["below", "above"])
@pytest.mark.parametrize("distance", [-1.5, 0.0, 3.0, 3.9, 4.1, 8.0, 30.0, 1000.0])
@pytest.mark.parametrize("width", [0.2, 5.0])
def test_one_dimension_is_scipys_truncated_normal(distance, side, width, key):
    """The mean is inside, on a bound, or up to a thousand standard deviations beyond either bound."""
    scale = 0.5
    ends = scale * np.array([distance, distance + width])
    low, high = ends if side > 0 else -ends[::-1]
    draws = np.asarray(DRAWS(key, gaussian(0.0, scale), box(low, high), N), np.float64)[:, 0]
    assert np.isfinite(draws).all() and ((draws >= np.float32(low)) & (draws <= np.float32(high))).all()
    near, far = side * draws.min() / scale if side > 0 else -draws.max() / scale, distance + width
    assert near >= distance - 1e-4 * max(1.0, abs(distance))
    if distance == 1000.0:  # the resolution of float32 there is a tenth of the tail's length
        assert np.median(side * draws / scale - distance) == pytest.approx(np.log(2) / 1000, rel=0.15)
        return
    expected = stats.truncnorm(distance, far)
    statistic = stats.kstest(side * draws / scale, expected.cdf).statistic
    assert statistic < CRITICAL


@pytest.mark.parametrize("distance", [0.0, 3.0, 8.0])
def test_no_draw_lies_on_a_bound(distance, key):
    """There are no atoms: nearly all draws differ (two may round to the same number), and hardly any equals a bound."""
    support = box(distance, distance + 2.0)
    draws = np.asarray(DRAWS(key, gaussian(0.0, 1.0), support, N))[:, 0]
    on_bound = (draws == np.asarray(support.low)[0]) | (draws == np.asarray(support.high)[0])
    assert on_bound.sum() <= 2
    assert len(np.unique(draws)) > 0.95 * N


def correlated(mean, correlation: float, scales) -> GaussianMixture:
    """One correlated component in two dimensions."""
    scales = np.asarray(scales)
    covariance = np.array([[1.0, correlation], [correlation, 1.0]]) * scales[:, None] * scales
    return GaussianMixture(
        jnp.zeros(1), jnp.asarray([mean], jnp.float32), jnp.asarray(np.linalg.cholesky(covariance)[None], jnp.float32)
    )


@pytest.mark.parametrize(
    ("correlation", "support"),
    [
        (0.8, Support([1.0, 1.5], [2.5, 3.0])),
        (-0.6, Support([0.5, 0.5], [3.0, 2.0])),
        (0.9, Support([0.0, -4.0], [3.0, -0.5])),  # against the correlation: a thin corner
    ],
)
def test_correlated_draws_are_those_of_rejection(correlation, support, key):
    mixture = correlated([0.0, 0.0], correlation, [1.0, 1.3])
    draws = np.asarray(DRAWS(key, mixture, support, N))
    covariance = np.asarray(mixture.covariances[0], float)
    free = np.random.default_rng(0).multivariate_normal([0, 0], covariance, 2_000_000)
    kept = free[((free >= np.asarray(support.low)) & (free <= np.asarray(support.high))).all(1)]
    assert len(kept) > 3000
    for direction in ([1, 0], [0, 1], [1, 1], [1, -1]):
        statistic = stats.ks_2samp(draws @ direction, kept[: 10 * N] @ direction).statistic
        assert statistic < 1.4 * CRITICAL + RESAMPLING_ERROR


def test_components_share_the_draws_by_their_mass_inside(key):
    """A light component lies near the box and a heavy one far beyond the other side: each counts with its weight."""
    mixture = GaussianMixture(jnp.log(jnp.array([0.1, 0.9])), jnp.array([[-1.0], [4.0]]), jnp.ones((2, 1, 1)))
    low, high = 0.0, 1.0
    mass = np.array([0.1, 0.9]) * (stats.norm.cdf([high + 1, high - 4]) - stats.norm.cdf([low + 1, low - 4]))
    share = mass / mass.sum()
    assert 0.1 < share[0] < 0.95
    laws = stats.truncnorm(1, 2, loc=-1), stats.truncnorm(-4, -3, loc=4)
    cdf = lambda x: share[0] * laws[0].cdf(x) + share[1] * laws[1].cdf(x)
    draws = np.asarray(DRAWS(key, mixture, box(low, high), N))[:, 0]
    assert stats.kstest(draws, cdf).pvalue > 1e-3


def test_an_absent_component_is_never_drawn(key):
    mixture = GaussianMixture(jnp.array([0.0, -jnp.inf]), jnp.array([[9.0], [0.5]]), jnp.array([[[1.0]], [[0.01]]]))
    draws = np.asarray(DRAWS(key, mixture, box(0.0, 1.0), N))[:, 0]
    assert stats.kstest(draws, stats.truncnorm(-9, -8, loc=9).cdf).statistic < CRITICAL


def test_the_mirrored_mixture_in_the_mirrored_box_is_mirrored(key):
    """Both sides have the same distribution; the mixture is skewed, so that swapped sides would be noticed."""
    mixture = GaussianMixture(
        jnp.log(jnp.array([0.7, 0.3])),
        jnp.array([[3.0, 0.0], [-5.0, 1.0]]),
        jnp.array([[[1.0, 0.0], [0.6, 0.5]], [[1.2, 0.0], [-0.3, 1.0]]]),
    )
    support = Support([-2.0, -0.5], [1.0, 2.0])
    here, there = jax.random.split(key)
    draws = np.asarray(DRAWS(here, mixture, support, N))
    mirrored = -np.asarray(DRAWS(there, mixture.mirror(), Support(-support.high, -support.low), N))
    for d in range(2):
        assert stats.ks_2samp(draws[:, d], mirrored[:, d]).pvalue > 1e-3
        centre = float(support.centre[d])
        assert stats.ks_2samp(draws[:, d], 2 * centre - draws[:, d]).pvalue < 1e-6


@pytest.mark.slow
def test_it_agrees_with_rejection_where_much_is_inside(key):
    """There are ten dimensions, with half of the mass inside."""
    mixture = GaussianMixture(jnp.zeros(1), jnp.full((1, 10), 0.5), jnp.eye(10)[None])
    support = Support([-1.0] * 10, [3.0] * 10)
    draws = np.asarray(DRAWS(key, mixture, support, 2000))
    free = np.random.default_rng(0).normal(0.5, 1.0, (4 * N, 10))
    kept = free[((free >= -1.0) & (free <= 3.0)).all(1)]
    assert len(kept) > N
    for d in (0, 4, 9):
        assert stats.ks_2samp(draws[:, d], kept[:, d]).pvalue > 1e-3
    assert stats.ks_2samp(draws.sum(1), kept.sum(1)).pvalue > 1e-3


# --------------------------------------------------------------------------------------------------------- masses


LOG_MASS = jax.jit(log_mass)


def log_interval(low: float, high: float) -> float:
    """Logarithm of a standard normal's mass in an interval above zero, by SciPy."""
    above, beyond = special.log_ndtr(-low), special.log_ndtr(-high)
    return above + np.log1p(-np.exp(beyond - above))


@pytest.mark.parametrize("low", [0.0, 2.0, 3.5, 5.0, 8.0, 37.0])
def test_a_mass_in_one_dimension_is_the_closed_form(low):
    """Masses go down to 1e-300, on either side, and for components on both sides of the box."""
    expected = log_interval(low, low + 2.0)
    for support in (box(low, low + 2.0), box(-low - 2.0, -low)):
        assert float(LOG_MASS(gaussian(0.0, 1.0), support)) == pytest.approx(expected, abs=1e-4, rel=1e-6)
    weights, means = np.array([0.9, 0.1]), np.array([0.0, 2 * low + 2.5])
    two = GaussianMixture(jnp.log(jnp.asarray(weights)), jnp.asarray(means)[:, None], jnp.ones((2, 1, 1)))
    parts = np.log(weights) + np.array([expected, log_interval(low + 0.5, low + 2.5)])
    assert float(LOG_MASS(two, box(low, low + 2.0))) == pytest.approx(special.logsumexp(parts), abs=1e-4, rel=1e-6)


def by_quadrature(correlation: float, low, high) -> float:
    """Log-mass of a standard normal pair in a box: a sum of closed forms over the first variable."""
    first, width = np.linspace(low[0], high[0], 200_001, retstep=True)
    deviation = np.sqrt(1 - correlation**2)
    ends = (np.array([low[1], high[1]])[:, None] - correlation * first) / deviation
    near, far = np.where(ends.sum(0) < 0, -ends[::-1], ends)
    above = special.log_ndtr(-near)
    inside = above + np.log1p(-np.exp(np.minimum(special.log_ndtr(-far) - above, -1e-12)))
    return special.logsumexp(stats.norm.logpdf(first) + inside) + np.log(width)


@pytest.mark.parametrize("correlation", [0.0, 0.6, 0.95, -0.9])
def test_a_mass_of_correlated_pairs_is_that_of_a_quadrature(correlation):
    """This also holds if only the second dimension is truncated, which determines where the first one is."""
    factor = np.linalg.cholesky([[1.0, correlation], [correlation, 1.0]])
    pair = GaussianMixture(jnp.zeros(1), jnp.zeros((1, 2)), jnp.asarray(factor[None], jnp.float32))
    for low, high in (
        ([-1.0, -1.0], [1.0, 2.0]), ([-10.0, 5.0], [10.0, 7.0]), ([5.0, -10.0], [7.0, 10.0]), ([5.0, 5.0], [7.0, 7.0]),
        ([5.0, -7.0], [7.0, -5.0]), ([1.0, -1.0], [1.2, 3.0]),
    ):  # fmt: skip
        expected = by_quadrature(correlation, low, high)
        assert float(LOG_MASS(pair, Support(low, high))) == pytest.approx(expected, abs=5e-3, rel=1e-4)


def test_a_mass_in_ten_dimensions_is_scipys():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(10, 10))
    covariance, mean = root @ root.T / 10 + 0.3 * np.eye(10), 0.3 * rng.normal(size=10)
    law = stats.multivariate_normal(mean, covariance, abseps=1e-14, releps=1e-4, maxpts=200_000)
    one = GaussianMixture(
        jnp.zeros(1),
        jnp.asarray(mean, jnp.float32)[None],
        jnp.asarray(np.linalg.cholesky(covariance)[None], jnp.float32),
    )
    for shift in (0.0, 1.0):
        low = mean + (0.8 * shift - 0.5) * np.sqrt(np.diag(covariance))
        high = low + 2.5 * np.sqrt(np.diag(covariance))
        expected = np.log(law.cdf(high, lower_limit=low))
        got = float(LOG_MASS(one, Support(jnp.asarray(low, jnp.float32), jnp.asarray(high, jnp.float32))))
        assert got == pytest.approx(expected, abs=0.05)


def test_a_rough_mass_is_right_to_a_hundredth():
    """Against SciPy, for correlated components of unequal weights at different places of a lopsided box."""
    factors = np.array([[[1.0, 0, 0], [0.8, 0.6, 0], [-0.5, 0.3, 0.7]], [[0.4, 0, 0], [0, 2.0, 0], [0.3, -0.9, 0.2]]])
    means, weights = np.array([[0.3, -0.2, 0.5], [1.4, 0.0, -1.0]]), np.array([0.7, 0.3])
    low, high = np.array([-0.4, -2.0, -0.9]), np.array([1.5, 0.6, 1.1])
    mixture = GaussianMixture(*(jnp.asarray(value, jnp.float32) for value in (np.log(weights), means, factors)))
    exact = sum(
        weight * stats.multivariate_normal(mean, factor @ factor.T).cdf(high, lower_limit=low)
        for weight, mean, factor in zip(weights, means, factors, strict=True)
    )
    assert float(rough_mass(mixture, Support(low, high))) == pytest.approx(exact, abs=0.01)


def test_draws_follow_the_dimension_that_is_truncated(key):
    """Only the second dimension is truncated, far out, and shifts the first; sampled in their order it would not."""
    factor = np.linalg.cholesky([[1.0, 0.95], [0.95, 1.0]])
    pair = GaussianMixture(jnp.zeros(1), jnp.zeros((1, 2)), jnp.asarray(factor[None], jnp.float32))
    draws = np.asarray(DRAWS(key, pair, Support([-10.0, 5.0], [10.0, 7.0]), N), np.float64)
    assert stats.kstest(draws[:, 1], stats.truncnorm(5, 7).cdf).statistic < CRITICAL
    left = (draws[:, 0] - 0.95 * draws[:, 1]) / np.sqrt(1 - 0.95**2)
    assert stats.kstest(left, stats.norm.cdf).statistic < CRITICAL
