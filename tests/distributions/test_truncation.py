"""Truncation to a box: rejection with its fallback, the mass inside, and the truncated density."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxlfi.distributions import truncation
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support
from jaxlfi.distributions.truncation import (
    MASS_DRAWS,
    TRIES,
    mass_inside,
    rejection_sample,
    truncated_log_prob,
    weighted_sample,
)

BOX = Support([0.5, -1.0], [2.0, 1.5])
LOW, HIGH = np.array([0.5, -1.0]), np.array([2.0, 1.5])
MASS = float(np.prod(stats.norm.cdf(HIGH) - stats.norm.cdf(LOW)))


def normal(key, n):
    """Standard normal draws."""
    return jax.random.normal(key, (n, 2))


def nowhere(key, n):
    """Draws that no box contains."""
    return jnp.inf * jax.random.uniform(key, (n, 2), minval=1.0, maxval=2.0)


def assert_truncated_normal(draws) -> None:
    """Draws are strictly inside and distinct, and each dimension is a truncated normal."""
    draws = np.asarray(draws)
    assert ((draws > LOW) & (draws < HIGH)).all()
    assert len(np.unique(draws, axis=0)) == len(draws)
    for d in range(2):
        assert stats.kstest(draws[:, d], stats.truncnorm(LOW[d], HIGH[d]).cdf).pvalue > 1e-3
    assert abs(np.corrcoef(draws.T)[0, 1]) < 5 / np.sqrt(len(draws))


def test_draws_have_the_truncated_density_and_none_lies_on_a_bound(key):
    assert_truncated_normal(jax.jit(lambda key: rejection_sample(key, normal, BOX, 4000))(key))


def test_many_draws_are_made_in_blocks_that_differ(key, monkeypatch):
    """Blocks have 500 draws; the number requested is not a multiple of that, and no block repeats another."""
    monkeypatch.setattr(truncation, "BLOCK", 500)
    draws = jax.jit(lambda key: rejection_sample(key, normal, BOX, 4100))(key)
    assert draws.shape == (4100, 2)
    assert_truncated_normal(draws)


def test_the_fallback_is_used_where_nothing_is_inside(key):
    there = jnp.array([1.25, 0.5])
    fallback = lambda key, n: jnp.broadcast_to(there, (n, 2))
    draws = jax.jit(lambda key: rejection_sample(key, nowhere, BOX, 20, fallback))(key)
    np.testing.assert_array_equal(draws, np.broadcast_to(there, (20, 2)))


def test_without_a_fallback_of_its_own_it_is_uniform(key):
    draws = np.asarray(jax.jit(lambda key: rejection_sample(key, nowhere, BOX, 4000))(key))
    for d in range(2):
        assert stats.kstest(draws[:, d], stats.uniform(LOW[d], HIGH[d] - LOW[d]).cdf).pvalue > 1e-3


def test_the_fallback_is_drawn_as_often_as_no_candidate_is_inside(key):
    """The sampler hits the box with a probability of 3 %: (1 - 0.03)^32 of the draws are the fallback's."""

    def rare(key, n):
        return jnp.where(jax.random.uniform(key, (n, 1)) < 0.03, jnp.array([1.0, 0.0]), 9.0)

    marked = lambda key, n: jnp.broadcast_to(jnp.array([1.5, 1.0]), (n, 2))
    draws = np.asarray(jax.jit(lambda key: rejection_sample(key, rare, BOX, 4000, marked))(key))
    fallen = (draws[:, 0] == 1.5).mean()
    expected = 0.97**TRIES
    assert abs(fallen - expected) < 5 * np.sqrt(expected * (1 - expected) / 4000)
    np.testing.assert_array_equal(draws[draws[:, 0] != 1.5], np.tile([1.0, 0.0], ((draws[:, 0] != 1.5).sum(), 1)))


def test_reflected_candidates_in_a_reflected_box_give_reflected_draws(key):
    plain = jax.jit(lambda key: rejection_sample(key, normal, BOX, 200))
    mirrored = jax.jit(
        lambda key: rejection_sample(key, lambda key, n: -normal(key, n), Support(-BOX.high, -BOX.low), 200)
    )
    np.testing.assert_array_equal(mirrored(jax.random.clone(key)), -plain(key))


def test_draws_in_several_boxes_can_be_mapped(key):
    """One box holds nearly all the mass, and another none."""
    low = jnp.array([[-9.0, -9.0], [20.0, 20.0]])
    one = lambda key, low: rejection_sample(key, normal, Support(low, low + 18), 500)
    draws = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(key), low))
    assert stats.kstest(draws[0, :, 0], stats.norm.cdf).pvalue > 1e-3
    assert stats.kstest(draws[1, :, 0], stats.uniform(20, 18).cdf).pvalue > 1e-3


def test_mass_inside_is_scipys():
    covariance = np.array([[1.0, 0.6], [0.6, 0.8]])
    factor = np.linalg.cholesky(covariance)
    mixture = GaussianMixture(jnp.zeros(1), jnp.array([[0.3, -0.2]]), jnp.asarray(factor[None], jnp.float32))
    law = stats.multivariate_normal([0.3, -0.2], covariance)
    expected = law.cdf(HIGH, lower_limit=LOW)
    mass = jax.jit(lambda mixture: mass_inside(mixture.sample, BOX))
    got = float(mass(mixture))
    assert abs(got - expected) < 5 * np.sqrt(expected * (1 - expected) / MASS_DRAWS)
    assert got == float(mass(mixture))
    assert float(jax.jit(lambda: mass_inside(nowhere, BOX))()) == 0


def test_the_truncated_density_is_one_in_all_inside_and_nothing_outside():
    axis = np.linspace(-4, 4, 801, dtype=np.float32)
    theta = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    log_q = stats.norm.logpdf(theta).sum(-1).astype(np.float32)
    log_prob = np.asarray(truncated_log_prob(jnp.asarray(log_q), jnp.asarray(theta), BOX, jnp.float32(np.log(MASS))))
    # The box's faces lie on the grid: half a cell too much at either end, 1.5 % of the mass.
    assert np.exp(log_prob).sum() * 0.01**2 == pytest.approx(1, abs=0.02)
    inside = ((theta >= np.float32(LOW)) & (theta <= np.float32(HIGH))).all(-1)
    np.testing.assert_array_equal(np.isneginf(log_prob), ~inside)
    np.testing.assert_allclose(log_prob[inside], log_q[inside] - np.log(MASS), rtol=1e-5)


def test_weighted_draws_are_in_proportion_and_none_twice(key):
    """There are many more candidates than draws; those whose weight is zero or NaN are never taken."""
    weight = np.array([1.0, 2.0, 5.0, 0.0, np.nan])
    kind = np.tile(np.arange(5), 20_000)
    candidates = jnp.stack([jnp.asarray(kind, jnp.float32), jnp.arange(len(kind), dtype=jnp.float32)], axis=1)
    draws = np.asarray(weighted_sample(key, candidates, jnp.log(jnp.asarray(weight[kind])), 800))
    assert len(np.unique(draws[:, 1])) == 800
    counts = np.bincount(draws[:, 0].astype(int), minlength=5)
    assert counts[3] == counts[4] == 0
    assert stats.chisquare(counts[:3], 800 * weight[:3] / 8).pvalue > 1e-3


def test_candidates_of_no_weight_are_never_taken(key):
    """Only three have weight, and twenty are requested: the others come from the fallback."""
    candidates = jnp.arange(100.0)[:, None]
    log_weight = jnp.where(jnp.isin(jnp.arange(100), jnp.array([7, 8, 90])), 0.0, -jnp.inf).at[3].set(jnp.nan)
    fallback = lambda key, n: jnp.full((n, 1), -5.0)
    draws = np.asarray(jax.jit(lambda key: weighted_sample(key, candidates, log_weight, 20, fallback))(key))[:, 0]
    assert sorted(draws[draws >= 0]) == [7.0, 8.0, 90.0] and (draws == -5.0).sum() == 17
