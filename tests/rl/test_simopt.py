"""SimOpt's steps against closed forms: of the dual, of Gaussians, and of a push whose way is linear in 1 / mass."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rl.pushed import pushed
from scipy import optimize, stats

from jaxlfi.rl.randomisation import simopt
from jaxlfi.rl.randomisation.gaussian import Gaussian, divergence
from jaxlfi.rl.randomisation.simopt import SimOpt

DRAWS = 20_000
SQUARED = SimOpt(absolute=0.0, squared=30.0, epsilon=0.5)
FORCES = jnp.array([[3.0], [-1.0], [2.0]])


def way(inverse: jax.Array) -> jax.Array:
    """Where pushes take a mass of this inverse from rest: a trajectory [3, 1] that is linear in it."""
    states = [jnp.zeros(2)]
    for force in FORCES:
        states.append(pushed(1.0 / inverse, states[-1], force[None]))
    return jnp.stack(states[1:])[:, :1]


def tilted(mean: float, variance: float, true: float, curvature: float, epsilon: float) -> tuple[float, float]:
    """N(mean, variance) exp(-curvature (x - true)^2 / eta), with eta by the bound: its mean and variance."""

    def moments(eta):
        precision = 1 / variance + 2 * curvature / eta
        return (mean / variance + 2 * curvature * true / eta) / precision, 1 / precision

    def exceeds(log_eta):
        own, var = moments(np.exp(log_eta))
        return 0.5 * (var / variance - 1 - np.log(var / variance) + (own - mean) ** 2 / variance) - epsilon

    return moments(np.exp(optimize.brentq(exceeds, -15, 15)))


def test_steps_are_those_of_the_closed_form():
    """A mass of 2 kg, from a distribution around 1 kg; the Gaussian after five bounded steps, mean and spread."""
    true, expected = 0.5, (1.0, 0.3**2)
    curvature = float(SQUARED.squared * jnp.sum(way(jnp.ones(1)) ** 2))
    now = Gaussian(jnp.array([1.0]), jnp.array([[0.3**2]]))
    costs_of = jax.jit(jax.vmap(lambda own: simopt.discrepancy(SQUARED, way(own), way(jnp.array([true])))))
    step = jax.jit(simopt.step)
    for key in jax.random.split(jax.random.key(0), 5):
        theta = now.sample(key, DRAWS)
        after = step(SQUARED, now, theta, costs_of(theta))
        assert float(divergence(after, now)) <= SQUARED.epsilon + 1e-4
        now, expected = after, tilted(*expected, true, curvature, float(SQUARED.epsilon))
    # A step's weights leave about a third of the draws: the errors of five steps, each in units of its own deviation.
    gate = 5 * (5 * 3 / DRAWS) ** 0.5
    assert abs(float(now.mean[0]) - expected[0]) < gate * expected[1] ** 0.5
    assert abs(float(now.deviation[0]) / expected[1] ** 0.5 - 1) < gate
    assert abs(expected[0] - true) < 0.05 and expected[1] ** 0.5 < 0.1  # the closed form itself goes to the truth


@pytest.mark.parametrize("epsilon", [0.05, 0.5, 2.0])
def test_the_temperature_makes_the_dual_least(epsilon):
    costs = np.random.default_rng(0).gamma(2.0, 7.0, 400)
    dual = lambda log: np.exp(log) * (epsilon + np.log(np.mean(np.exp(-(costs - costs.min()) / np.exp(log)))))
    best = np.exp(optimize.minimize_scalar(dual, bounds=(-3, 12), method="bounded", options={"xatol": 1e-9}).x)
    np.testing.assert_allclose(simopt.temperature(jnp.asarray(costs, jnp.float32), epsilon), best, rtol=2e-3)


def test_the_divergence_of_gaussians():
    rng = np.random.default_rng(0)
    factors = rng.normal(size=(2, 3, 3)) + 2 * np.eye(3)
    (one, other), means = (factors @ factors.transpose(0, 2, 1)), rng.normal(size=(2, 3))
    inverse, shift = np.linalg.inv(other), means[1] - means[0]
    expected = 0.5 * (
        np.trace(inverse @ one) + shift @ inverse @ shift - 3 + np.log(np.linalg.det(other) / np.linalg.det(one))
    )
    found = divergence(
        Gaussian(jnp.asarray(means[0]), jnp.asarray(one)), Gaussian(jnp.asarray(means[1]), jnp.asarray(other))
    )
    np.testing.assert_allclose(found, expected, rtol=1e-4)


@pytest.mark.parametrize("epsilon", [0.1, 1.0, 50.0])
def test_few_draws_do_not_take_it_farther_than_the_bound(key, epsilon):
    """Eight draws of three parameters: what is fitted to the weighted ones alone is too far away in most cases."""
    settings = SimOpt(epsilon=epsilon)
    before = Gaussian(jnp.array([0.0, 1.0, -2.0]), jnp.diag(jnp.array([1.0, 0.1, 4.0])))

    def one(key):
        key_theta, key_costs = jax.random.split(key)
        after = simopt.step(settings, before, before.sample(key_theta, 8), jax.random.exponential(key_costs, (8,)))
        return divergence(after, before)

    found = np.asarray(jax.jit(jax.vmap(one))(jax.random.split(key, 50)))
    assert (found <= epsilon * (1 + 1e-3)).all() and (found > 1e-3).all()
    if epsilon <= 1.0:
        assert np.mean(found > 0.99 * epsilon) > 0.5  # and it goes as far as it may


def test_within_the_bound_nothing_is_shortened():
    before, after = (
        Gaussian(jnp.array([mean]), jnp.array([[variance]])) for mean, variance in ((0.0, 1.0), (0.5, 0.8))
    )
    kept = simopt.bounded(before, after, 10.0)
    assert kept.mean == after.mean and kept.covariance == after.covariance
    half = simopt.bounded(before, after, 0.05)
    np.testing.assert_allclose(divergence(half, before), 0.05, rtol=1e-3)


def test_failed_simulations_weigh_nothing():
    before = Gaussian(jnp.zeros(1), jnp.eye(1))
    theta, costs = jnp.array([[-1.0], [0.2], [0.4], [90.0]]), jnp.array([3.0, 1.0, 2.0, jnp.nan])
    known = simopt.step(SimOpt(epsilon=0.2), before, theta, costs)
    assert np.isfinite(known.covariance).all() and -1.0 < float(known.mean[0]) < 0.4


def test_the_discrepancy_weighs_both_norms():
    settings = SimOpt(absolute=2.0, squared=10.0)
    simulated, real = jnp.array([[1.0, 2.0], [3.0, 4.0]]), jnp.array([[1.0, 0.0], [0.0, 4.0]])
    weights = jnp.array([0.1, 1.0])
    np.testing.assert_allclose(simopt.discrepancy(settings, simulated, real, weights), 2 * 2.3 + 10 * 4.09, rtol=1e-6)


def test_draws_are_of_the_gaussian(key):
    """Means and covariances of many draws, correlated ones."""
    covariance = np.array([[1.0, -0.6], [-0.6, 2.0]])
    draws = np.asarray(Gaussian(jnp.array([3.0, -1.0]), jnp.asarray(covariance)).sample(key, 4000))
    distance = np.einsum("ni,ij,nj->n", draws - [3.0, -1.0], np.linalg.inv(covariance), draws - [3.0, -1.0])
    assert stats.kstest(distance, stats.chi2(2).cdf).pvalue > 1e-4
    assert abs(np.corrcoef(draws.T)[0, 1] + 0.6 / 2**0.5) < 0.06
