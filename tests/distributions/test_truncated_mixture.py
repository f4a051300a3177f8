"""Draws of a mixture truncated to a box that rejection cannot reach, against SciPy and against plain rejection."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncated_mixture import truncated_mixture_draws

N = 4000
DRAWS = jax.jit(truncated_mixture_draws, static_argnums=3)
CRITICAL = stats.kstwobign.isf(1e-3) / np.sqrt(N)
"""A Kolmogorov-Smirnov statistic that exact draws exceed once in a thousand."""
RESAMPLING_ERROR = 0.01
"""Of the distribution function, where 64 candidates are few: 0.03 were measured for 32 in the thin corner below."""


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
    """A mean inside, on a bound and up to a thousand standard deviations beyond it, on either side."""
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
    """No atoms: all but a few draws differ (two of them may round to one number), and next to none is a bound."""
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
    """A light component near the box and a heavy one far from it, on the other side: each by its own weight."""
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
    """The same law from either side; the mixture is skewed, so that a swapped side would show."""
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
    """Ten dimensions, half of the mass inside."""
    mixture = GaussianMixture(jnp.zeros(1), jnp.full((1, 10), 0.5), jnp.eye(10)[None])
    support = Support([-1.0] * 10, [3.0] * 10)
    draws = np.asarray(DRAWS(key, mixture, support, 2000))
    free = np.random.default_rng(0).normal(0.5, 1.0, (4 * N, 10))
    kept = free[((free >= -1.0) & (free <= 3.0)).all(1)]
    assert len(kept) > N
    for d in (0, 4, 9):
        assert stats.ks_2samp(draws[:, d], kept[:, d]).pvalue > 1e-3
    assert stats.ks_2samp(draws.sum(1), kept.sum(1)).pvalue > 1e-3
