"""The posterior without the pooled proposals, against a closed form and a plain NumPy reference."""

import functools

import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

import jaxlfi
from jaxlfi.bayessim import pooled
from jaxlfi.bayessim.pooled import CONFIRMED, FARTHEST, HIGHEST, ORDINARY
from jaxlfi.distributions.belief import Belief
from jaxlfi.distributions.mixture import GaussianMixture
from jaxlfi.distributions.support import Support

LOW, HIGH = np.array([-4.0, -2.0]), np.array([4.0, 6.0])
BOX = Support(LOW, HIGH)
MEAN, FACTOR = np.array([0.8, 1.5]), np.array([[0.5, 0.0], [0.3, 0.4]])
ROUNDS = 41
"""Number of rounds of every pool, so that most tests call the same program; those not asked for count as later ones."""

log_pool = jax.jit(pooled.log_pool, static_argnums=0)


@functools.partial(jax.jit, static_argnums=0)
def without_pool(prior, q, *pool, size=1000):
    """The reported mixture, its mean and covariance, and the effective share."""
    found, effective = pooled.without_pool(prior, q, *pool, size).reported(q)
    return found, found.mean, found.covariance, effective


@jax.jit
def going_on(q, *pool, weighted=None):
    """The weights of the mixture for proposals and heuristics, and the number of simulations at each component."""
    quotients = pooled.without_pool(None, q, *pool)
    return quotients.proposed(q, q if weighted is None else weighted).weights, quotients.simulations


def prior_of(prior):
    """A prior in the form that a task has."""
    return jaxlfi.Task(
        lambda key, theta: theta, names=("a", "b"), supports={"box": BOX}, feasible=BOX, prior=prior
    ).inference.prior


def gaussian(mean=MEAN, factor=FACTOR):
    return GaussianMixture(np.zeros(1, np.float32), np.float32(mean)[None], np.float32(factor)[None])


def pair(other, weight):
    """The Gaussian and another one with the given weight."""
    logits = np.log(np.float32([1 - weight, weight]))
    return jax.tree.map(lambda a, b: np.concatenate([a, b]), gaussian(), other).replace(logits=logits)


def proposals(*informed, box=BOX):
    """The proposals of one uninformed round over the box and of rounds that drew from the given Gaussians."""
    flat = gaussian(np.zeros(box.dim), np.eye(box.dim))
    beliefs = [Belief(flat, box, np.array(False))]
    beliefs += [Belief(mixture, box, np.array(True)) for mixture in informed]
    beliefs += [Belief(flat, box, np.array(True))] * (ROUNDS - len(beliefs))
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *jax.device_get(beliefs))


def test_the_pool_is_the_mixture_of_the_rounds():
    wide = gaussian(factor=2 * FACTOR)
    theta = np.array([[0.0, 1.0], [1.0, 3.0], [-3.5, 5.5]], np.float32)
    found = np.asarray(log_pool(None, proposals(wide, wide), 1, 0.0, theta))
    normal = stats.multivariate_normal(MEAN, 4 * FACTOR @ FACTOR.T)
    draws = normal.rvs(400_000, random_state=0)
    inside = np.mean(np.all((draws > LOW) & (draws < HIGH), axis=1))
    expected = np.log(1 / 64 + normal.pdf(theta) / inside)  # the third proposal is of a later round
    np.testing.assert_allclose(found, expected, atol=0.02)
    theta[0] = [5.0, 0.0]
    assert np.isneginf(log_pool(None, proposals(wide), 1, 0.0, theta)).tolist() == [True, False, False]


@pytest.mark.parametrize("dim", [2, 6])
@pytest.mark.parametrize("inflation", [1.5, 2.0, 3.0])
def test_what_a_gaussian_lost_by_wide_proposals_it_gets_back(inflation, dim):
    """The precision of q is the sum of the posterior's and the proposals'; nearly all rounds proposed the same.

    With importance weights of q's own draws, truncated at four geometric means, variances in six dimensions would be a
    fifth too small.
    """
    mean, factor = np.resize(MEAN, dim), np.kron(np.eye(dim // 2), FACTOR)
    box = Support(np.resize(LOW, dim), np.resize(HIGH, dim))
    exact = factor @ factor.T
    proposed = inflation**2 * exact
    learnt = np.linalg.inv(np.linalg.inv(exact) + np.linalg.inv(proposed))
    rounds = proposals(*[gaussian(mean, inflation * factor)] * 40, box=box)
    q = gaussian(mean, np.linalg.cholesky(learnt))
    _, centre, covariance, effective = without_pool(None, q, rounds, 40, 0.0, box)
    np.testing.assert_allclose(covariance, exact, rtol=0.06, atol=0.006)
    np.testing.assert_allclose(centre, mean, atol=0.02)
    assert 0.05 < effective < 1


def test_each_component_is_moved_by_the_slope_of_the_pool():
    """Compared with importance resampling of q in NumPy, for two unlike components and a pool leaning to one side."""
    q = GaussianMixture(
        np.log(np.float32([0.7, 0.3])),
        np.float32([[0.5, 1.0], [-0.3, 1.5]]),
        np.float32([[[0.4, 0.0], [0.1, 0.3]], [[0.3, 0.0], [0.0, 0.5]]]),
    )
    leaning = gaussian(np.array([1.5, 0.5]), 1.2 * np.eye(2))
    pool = proposals(leaning, leaning, leaning)
    _, centre, covariance, _ = without_pool(None, q, pool, 3, 0.0, BOX)
    rng = np.random.default_rng(3)
    parts = zip((140_000, 60_000), q.means, q.scale_tril, strict=True)
    draws = np.concatenate([mean + rng.normal(size=(n, 2)) @ factor.T for n, mean, factor in parts])
    weight = 1 / (1 / 64 + 3 * stats.multivariate_normal([1.5, 0.5], 1.44 * np.eye(2)).pdf(draws) / 0.92)
    weight /= weight.sum()
    mean = weight @ draws
    np.testing.assert_allclose(centre, mean, atol=0.02)
    np.testing.assert_allclose(covariance, (draws - mean).T @ ((draws - mean) * weight[:, None]), atol=0.02)
    assert centre[0] < draws.mean(axis=0)[0] - 0.1  # away from where most was proposed


def test_a_stray_component_where_nothing_was_proposed_stays_light():
    """The quotient alone would raise its weight from 0.02 to 0.63; only five of a thousand simulations are there."""
    far = gaussian(MEAN - [3.5, 0.0])
    q = pair(far, 0.02)
    rounds = proposals(*[gaussian(factor=2 * FACTOR)] * 9)
    found, *_ = without_pool(None, q, rounds, 9, 0.0, BOX)
    assert special.softmax(found.logits)[1] < 1.1 * HIGHEST * 0.02
    assert np.linalg.norm(found.means[1] - far.means[0]) < FARTHEST * 0.6
    weights, _ = going_on(q, rounds, 9, 0.0, BOX, 1000)
    np.testing.assert_allclose(weights, [0.98, 0.02], rtol=1e-5)


def test_the_tail_of_a_skewed_posterior_weighs_what_it_does_without_the_pool():
    """With importance weights of q's draws in NumPy, 0.02 becomes 0.24, far more than a stray component may gain."""
    tail = gaussian(MEAN + np.array([1.5, 1.0]), 2 * FACTOR)
    q = pair(tail, 0.02)
    rounds = proposals(*[gaussian(factor=1.2 * FACTOR)] * 9)
    rng = np.random.default_rng(5)
    density = stats.multivariate_normal(MEAN, 1.44 * FACTOR @ FACTOR.T).pdf

    def mass(component):
        draws = component.means[0] + rng.normal(size=(200_000, 2)) @ component.scale_tril[0].T
        return np.mean(1 / (1 / 64 + 9 * density(draws)))

    exact = np.array([0.98 * mass(gaussian()), 0.02 * mass(tail)])
    exact /= exact.sum()
    assert exact[1] > 2 * HIGHEST * 0.02
    many = 100_000
    found, *_ = without_pool(None, q, rounds, 9, 0.0, BOX, size=many)
    np.testing.assert_allclose(special.softmax(found.logits)[1], exact[1], rtol=0.25)
    # In the loop it gains half as much.
    weights, _ = going_on(q, rounds, 9, 0.0, BOX, many)
    half = exact[1] / ORDINARY
    np.testing.assert_allclose(weights[1], half / (exact[0] + half), rtol=0.25)


def test_a_tail_gains_less_where_what_is_reported_has_hardly_any_mass():
    """Compared with draws in NumPy. A network of little weight is often far too wide, and only looks like a tail."""
    tail = gaussian(MEAN + np.array([2.7, 1.0]), 1.3 * FACTOR)
    q, rounds = pair(tail, 0.02), proposals(*[gaussian(factor=1.5 * FACTOR)] * 9)
    draws = tail.means[0] + np.random.default_rng(6).normal(size=(100_000, 2)) @ tail.scale_tril[0].T
    density = lambda of: stats.multivariate_normal(of.means[0], of.scale_tril[0] @ of.scale_tril[0].T).pdf(draws)
    mixed = lambda weight: (1 - weight) * density(gaussian()) + weight * density(tail)

    def gain(weight):
        weights, _ = going_on(q, rounds, 9, 0.0, BOX, 100_000, weighted=pair(tail, weight))
        return np.log(weights[1] / weights[0] / (0.02 / 0.98))

    shares = [np.mean(np.minimum(mixed(weight) / mixed(0.02), 1)) for weight in (1e-6, 0.004, 0.01)]
    for weight, share in zip((1e-6, 0.004, 0.01), shares, strict=True):
        np.testing.assert_allclose(gain(weight), min(share / CONFIRMED, 1) * gain(0.02), rtol=0.2)
    assert shares[0] < 0.7 * CONFIRMED and shares[1] > CONFIRMED and gain(0.02) > np.log(5)


def test_the_simulations_where_a_component_lies_are_counted():
    """Compared with draws of the proposals: the share of them in the ellipsoid of the component's effective volume.

    A ball of the volume (2 pi e)^(D/2) has a radius of 2.33 standard deviations in two dimensions.
    """
    few = gaussian(MEAN + np.array([0.3, -0.2]), 0.2 * FACTOR)
    wide = gaussian(factor=2 * FACTOR)
    _, (count,) = going_on(few, proposals(*[wide] * 9), 9, 0.0, BOX, 4000)
    rng = np.random.default_rng(6)
    draws = MEAN + rng.normal(size=(400_000, 2)) @ (2 * FACTOR).T
    draws = draws[np.all((draws > LOW) & (draws < HIGH), axis=1)]
    offset = np.linalg.solve(0.2 * FACTOR, (draws - few.means[0]).T)
    radius = 2 * np.sqrt(np.e / 2)
    share = 0.9 * np.mean(np.sum(offset**2, axis=0) < radius**2)
    share += 0.1 * np.pi * radius**2 * np.linalg.det(0.2 * FACTOR) / 64
    np.testing.assert_allclose(count, 4000 * share, rtol=0.03)


def test_a_constant_pool_changes_nothing():
    q = gaussian(np.array([-3.9, 0.0]))  # half of it beyond the bound, where nothing was proposed
    _, centre, covariance, effective = without_pool(None, q, proposals(gaussian()), 0, 0.0, BOX)
    np.testing.assert_allclose(centre, [-3.9, 0.0], atol=1e-4)
    np.testing.assert_allclose(covariance, FACTOR @ FACTOR.T, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(effective, 1.0, rtol=1e-5)


def test_a_support_that_nothing_was_proposed_in_leaves_q_as_it_is():
    other = Support(np.array([10.0, 10.0]), np.array([11.0, 11.0]))
    found, *_, effective = without_pool(None, gaussian(), proposals(gaussian()), 1, 0.0, other)
    np.testing.assert_array_equal(found.means, gaussian().means)
    assert effective == 0


def test_where_a_prior_is_zero_the_pool_counts_as_flat():
    """A uniform prior ends in the middle of the component: half of its points lie where nothing is proposed."""
    prior = distrax.Independent(distrax.Uniform(jnp.array([0.8, -2.0]), jnp.array([4.0, 6.0])), 1)
    wide = gaussian(factor=2 * FACTOR)
    _, centre, covariance, effective = without_pool(prior_of(prior), gaussian(), proposals(*[wide] * 9), 9, 0.0, BOX)
    assert np.isfinite(centre).all() and np.isfinite(covariance).all() and 0 < effective <= 1
    _, _, wider, _ = without_pool(None, gaussian(), proposals(*[wide] * 9), 9, 0.0, BOX)
    assert np.all(np.diag(FACTOR @ FACTOR.T) <= np.diag(covariance) + 1e-6)
    assert np.all(np.diag(covariance) <= np.diag(wider) + 1e-6)


def test_a_prior_that_proposals_have_as_a_factor_drops_out(key):
    prior = distrax.MultivariateNormalDiag(jnp.array([0.5, 1.0]), jnp.array([1.0, 2.0]))
    theta = jnp.array([[0.0, 0.0], [1.0, 2.0], [2.0, -1.0]])
    own = prior_of(prior)
    rounds = proposals(gaussian(factor=2 * FACTOR))
    only_first = np.asarray(log_pool(own, rounds, 0, 0.0, theta))
    np.testing.assert_allclose(only_first, only_first[0], atol=1e-5)
    # The second round drew from Gaussian * prior / Z, which relative to the prior is Gaussian / Z.
    normal = stats.multivariate_normal(MEAN, 4 * FACTOR @ FACTOR.T)
    draws = normal.rvs(200_000, random_state=1)
    inside = np.all((draws > LOW) & (draws < HIGH), axis=1)
    z = np.mean(inside * stats.multivariate_normal([0.5, 1.0], np.diag([1.0, 4.0])).pdf(draws))
    expected = np.log(normal.pdf(theta) / z + np.exp(only_first))
    np.testing.assert_allclose(log_pool(own, rounds, 1, 0.0, theta), expected, atol=0.1)
