"""Belief: the ways to keep draws in the box, and the belief before any data."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from scipy import optimize, stats

from jaxlfi.distributions.belief import OUTSIDE, RESTRICTIONS, Belief, uninformed
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncation import TRIES
from tests.strategies import keys, problems

CLIPPED = jax.jit(RESTRICTIONS["clip"], static_argnames="n")
REJECTED = jax.jit(RESTRICTIONS["reject"], static_argnames="n")
MIXED = jax.jit(RESTRICTIONS["mixed"], static_argnames="n")
FROM_PRIOR = jax.jit(RESTRICTIONS["prior"], static_argnames=("n", "log_weight"))

N = 20_000
MEAN, SCALE = np.array([0.4, 5.0]), np.array([1.5, 0.7])
GAUSSIAN = Belief(
    GaussianMixture(jnp.zeros(1), jnp.asarray(MEAN)[None].astype(jnp.float32), jnp.diag(jnp.asarray(SCALE))[None]),
    Support([0.0, 3.0], [2.0, 5.5]),
    jnp.asarray(True),
)
"""An axis-aligned Gaussian, a third to a half of which lies in its box."""


def truncated(d: int):
    """The marginal of GAUSSIAN truncated to its box."""
    low, high = float(GAUSSIAN.support.low[d]), float(GAUSSIAN.support.high[d])
    return stats.truncnorm((low - MEAN[d]) / SCALE[d], (high - MEAN[d]) / SCALE[d], MEAN[d], SCALE[d])


def test_all_ways_are_tested():
    assert set(RESTRICTIONS) == {"clip", "reject", "mixed", "prior"}


@pytest.mark.parametrize("restriction", [CLIPPED, REJECTED, MIXED, FROM_PRIOR], ids=RESTRICTIONS)
@given(problems(), keys())
def test_draws_stay_in_the_box(restriction, problem, key):
    belief, _, _ = problem
    draws, box = jax.device_get((restriction(key, belief, n=50), belief.support))
    assert draws.shape == (50, box.dim)
    assert ((draws >= box.low) & (draws <= box.high)).all()


def test_clipping_puts_the_outside_mass_on_the_bounds(key):
    draws = np.asarray(CLIPPED(key, GAUSSIAN, n=N))
    for d in range(2):
        low, high = float(GAUSSIAN.support.low[d]), float(GAUSSIAN.support.high[d])
        normal = stats.norm(MEAN[d], SCALE[d])
        for atom, mass in ((low, normal.cdf(low)), (high, normal.sf(high))):
            assert abs((draws[:, d] == atom).mean() - mass) < 5 * np.sqrt(mass * (1 - mass) / N) + 1e-9
        inside = draws[(draws[:, d] > low) & (draws[:, d] < high), d]
        assert stats.kstest(inside, truncated(d).cdf).pvalue > 1e-3


def test_rejection_draws_the_truncated_density(key):
    draws = np.asarray(REJECTED(key, GAUSSIAN, n=N))
    for d in range(2):
        assert stats.kstest(draws[:, d], truncated(d).cdf).pvalue > 1e-3
    assert abs(np.corrcoef(draws.T)[0, 1]) < 5 / np.sqrt(N)


def test_mixed_draws_have_the_posteriors_own_mass_on_the_bounds_and_are_wide_inside(key):
    draws, box = np.asarray(MIXED(key, GAUSSIAN, n=N, inflation=2.0)), GAUSSIAN.support
    clear = ((draws > np.asarray(box.low)) & (draws < np.asarray(box.high))).all(axis=1)
    marginals = [stats.norm(MEAN[d], SCALE[d]) for d in range(2)]
    mass = np.prod([one.cdf(box.high[d]) - one.cdf(box.low[d]) for d, one in enumerate(marginals)])
    assert abs(clear.mean() - mass) < 5 * np.sqrt(mass * (1 - mass) / N)
    for d in range(2):
        ends = (np.array([box.low[d], box.high[d]]) - MEAN[d]) / (2 * SCALE[d])
        assert stats.kstest(draws[clear, d], stats.truncnorm(*ends, MEAN[d], 2 * SCALE[d]).cdf).pvalue > 1e-3


def test_mixed_draws_of_a_posterior_inside_leave_the_bounds_free(key):
    inside = GAUSSIAN.replace(support=Support([-20.0, -5.0], [10.0, 12.0]))
    draws = np.asarray(MIXED(key, inside, n=N, inflation=3.0))
    assert ((draws > np.asarray(inside.support.low)) & (draws < np.asarray(inside.support.high))).all()
    assert draws[:, 1].std() > 2 * SCALE[1]


def test_mixed_draws_lie_on_bounds_that_have_just_moved_alone(key):
    """The lower bound of the first parameter was moved down, the upper one of the second up; the others stay."""
    box = GAUSSIAN.support
    before = Support([0.5, 3.0], [2.0, 5.0])
    draws = np.asarray(MIXED(key, GAUSSIAN, n=N, inflation=2.0, before=before))
    low, high = draws == np.asarray(box.low), draws == np.asarray(box.high)
    assert not low[:, 1].any() and not high[:, 0].any()
    first, second = (stats.norm(MEAN[d], SCALE[d]) for d in range(2))
    # A draw is moved onto a bound if it is not beyond a bound that stays.
    inside = [first.cdf(2.0) - first.cdf(0.0), second.cdf(5.5) - second.cdf(3.0)]
    for found, mass in (
        (low[:, 0], first.cdf(0.0) * (inside[1] + second.sf(5.5))),
        (high[:, 1], second.sf(5.5) * (inside[0] + first.cdf(0.0))),
    ):
        assert abs(found.mean() - mass) < 5 * np.sqrt(mass * (1 - mass) / N)


def test_mixed_draws_of_a_support_that_stays_are_those_of_rejection(key):
    draws = np.asarray(MIXED(key, GAUSSIAN, n=N, before=GAUSSIAN.support))
    for d in range(2):
        assert stats.kstest(draws[:, d], truncated(d).cdf).pvalue > 1e-3


def test_rejection_far_outside_falls_back_to_uniform_draws(key):
    far = Belief(
        GaussianMixture(jnp.zeros(2), jnp.full((2, 2), 1e3), jnp.tile(jnp.eye(2), (2, 1, 1))),
        GAUSSIAN.support,
        jnp.asarray(True),
    )
    draws = np.asarray(REJECTED(key, far, n=5000))
    for d in range(2):
        box = stats.uniform(float(far.support.low[d]), float(far.support.width[d]))
        assert stats.kstest(draws[:, d], box.cdf).pvalue > 1e-3


def test_rejection_falls_back_only_where_no_candidate_is_inside(key):
    """A narrow component has a fiftieth of the mass; the rest lies far outside: 0.98^32 of the draws are uniform."""
    split = Belief(
        GaussianMixture(jnp.log(jnp.array([0.02, 0.98])), jnp.array([[0.5], [100.0]]), jnp.full((2, 1, 1), 1e-3)),
        Support([0.0], [1.0]),
        jnp.asarray(True),
    )
    narrow = np.abs(np.asarray(REJECTED(key, split, n=4000)) - 0.5) < 5e-3
    uniform = 0.98**TRIES
    assert abs(narrow.mean() - (1 - 0.99 * uniform)) < 5 * 0.5 / np.sqrt(4000)


@pytest.mark.parametrize("dim", [1, 2, 12])
def test_the_truncated_prior_is_uniform_over_the_ellipsoid_that_holds_the_mass(dim, key):
    """Tested in the mixture's coordinates: squared radii relative to the chi-squared quantile, to the power D / 2."""
    factor = np.tril(np.random.default_rng(dim).normal(size=(dim, dim)), -1) + np.diag(1.0 + np.arange(dim))
    mean = np.arange(1.0, dim + 1)
    mixture = GaussianMixture(np.zeros(1, np.float32), np.float32([mean]), np.float32([factor]))
    belief = Belief(mixture, Support(np.full(dim, -1e3), np.full(dim, 1e3)), jnp.asarray(True))
    draws = np.asarray(FROM_PRIOR(key, belief, n=2000), float)
    z = np.linalg.solve(factor, (draws - mean).T).T
    share = (np.sum(z**2, axis=1) / stats.chi2.isf(OUTSIDE, dim)) ** (dim / 2)
    # The level is estimated from a few of 8,192 draws: the border may lie a little further in or out.
    assert share.max() == pytest.approx(1, abs=0.03 * dim)
    assert stats.kstest(share / share.max(), "uniform").pvalue > 1e-3
    assert np.abs(z.mean(axis=0)).max() < 5 * z.std() / np.sqrt(2000)


def test_the_truncated_prior_gives_modes_the_areas_above_one_density(key):
    """A wide mode has little mass and a narrow one, far away, has most; the level determines their areas."""
    weight, scale = np.array([0.3, 0.7]), np.array([2.0, 0.5])
    mixture = GaussianMixture(
        jnp.log(jnp.asarray(weight)),
        jnp.array([[-20.0, 0.0], [20.0, 5.0]]),
        jnp.asarray(scale)[:, None, None] * jnp.eye(2),
    )
    belief = Belief(mixture, Support([-100.0, -100.0], [100.0, 100.0]), jnp.asarray(True))
    draws = np.asarray(FROM_PRIOR(key, belief, n=4000))
    height = weight / (2 * np.pi * scale**2)
    area = lambda level: 2 * np.pi * scale**2 * np.log(height / level)
    # All but c / height of a mode's mass lies above a density c.
    level = optimize.brentq(lambda c: np.sum(weight * c / height) - OUTSIDE, 1e-12, height.min())
    expected = area(level)[0] / area(level).sum()
    # The level is accurate to a third, as eight of 8,192 draws are below it.
    tolerance = np.abs(area(level * 1.5)[0] / area(level * 1.5).sum() - expected) + 5 * 0.5 / np.sqrt(4000)
    assert abs((draws[:, 0] < 0).mean() - expected) < tolerance < 0.05


def test_the_truncated_prior_is_in_proportion_to_the_prior(key):
    """In a box in the middle of the region, draws follow the prior: an exponential along the second axis."""
    belief = GAUSSIAN.replace(support=Support([-1.0, 4.0], [2.0, 6.0]))
    # 300 of some 6,000 candidates without replacement: nearly independent
    draws = np.asarray(FROM_PRIOR(key, belief, n=300, log_weight=_rising))
    assert stats.kstest(draws[:, 0], stats.uniform(-1.0, 3.0).cdf).pvalue > 1e-3
    assert stats.kstest(6.0 - draws[:, 1], stats.truncexpon(b=2.0).cdf).pvalue > 1e-3
    assert stats.kstest(draws[:, 1] - 4.0, stats.truncexpon(b=2.0).cdf).pvalue < 1e-6


def _rising(theta):
    return theta[:, 1]


def test_the_uninformed_belief_covers_its_box():
    box = Support([-1.0, 10.0], [3.0, 30.0])
    belief = uninformed(box, 3)
    assert not bool(belief.informed) and belief.informed.dtype == bool
    assert belief.support is box
    np.testing.assert_allclose(belief.mixture.weights, np.full(3, 1 / 3), rtol=1e-6)
    np.testing.assert_allclose(belief.mixture.means, [[1.0, 20.0]] * 3)
    np.testing.assert_allclose(belief.mixture.marginal_scales, [[2.0, 10.0]] * 3)
    np.testing.assert_allclose(belief.mixture.covariance, np.diag([4.0, 100.0]), atol=1e-5)
    assert jax.tree.structure(belief) == jax.tree.structure(GAUSSIAN)
