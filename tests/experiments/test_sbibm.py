"""The benchmark's tasks against its published reference posteriors, and its classifier test."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from experiments.sbibm.c2st import c2st
from experiments.sbibm.tasks import TASKS, observation, reference

NUMBERS = (1, 2, 3)


@pytest.mark.parametrize("number", NUMBERS)
def test_two_moons_is_the_benchmarks(number):
    """Under a flat prior the noise that leads from reference draws to the observation is the simulator's own."""
    theta, x = reference("two_moons", number), observation("two_moons", number)
    place = jax.jit(jax.vmap(TASKS["two_moons"]().simulate))(
        jax.random.split(jax.random.key(number), len(theta)), jnp.asarray(theta, jnp.float32)
    )
    u = theta.sum(1) / np.sqrt(2), (theta[:, 1] - theta[:, 0]) / np.sqrt(2)
    moon = x - np.stack([-np.abs(u[0]), u[1]], axis=1) - [0.25, 0]
    assert stats.kstest(np.linalg.norm(moon, axis=1), stats.norm(0.1, 0.01).cdf).pvalue > 1e-4
    simulated = np.asarray(place) - (x - moon - [0.25, 0]) - [0.25, 0]
    for d in range(2):
        assert stats.ks_2samp(simulated[:, d], moon[:, d]).pvalue > 1e-4


@pytest.mark.parametrize("number", NUMBERS)
def test_gaussian_linear_is_the_benchmarks(number):
    """Prior and noise of equal variance 0.1: the posterior has half the observation for mean, and variance 0.05."""
    theta, x = reference("gaussian_linear", number), observation("gaussian_linear", number)
    np.testing.assert_allclose(theta.mean(0), x / 2, atol=5 * np.sqrt(0.05 / len(theta)))
    np.testing.assert_allclose(np.cov(theta.T), 0.05 * np.eye(10), atol=5 * 0.05 * np.sqrt(2 / len(theta)))
    task = TASKS["gaussian_linear"]()
    draws = np.asarray(
        jax.jit(jax.vmap(task.simulate))(jax.random.split(jax.random.key(0), 10000), jnp.ones((10000, 10)))
    )
    np.testing.assert_allclose(draws.mean(0), 1.0, atol=5 * np.sqrt(0.1 / 10000))
    np.testing.assert_allclose(draws.var(0), 0.1, rtol=0.08)
    np.testing.assert_allclose(task.prior.variance(), 0.1, rtol=1e-5)


@pytest.mark.slow
def test_the_classifier_sees_what_can_be_seen():
    """One normal and another shifted by two standard deviations: the best accuracy is Phi(1)."""
    rng = np.random.default_rng(0)
    first, same, shifted = rng.normal(3, 2, (1500, 1)), rng.normal(3, 2, (1500, 1)), rng.normal(7, 2, (1500, 1))
    assert c2st(first, same) == pytest.approx(0.5, abs=0.05)
    assert c2st(first, shifted) == pytest.approx(stats.norm.cdf(1), abs=0.03)


@pytest.mark.slow
def test_exact_references_are_posteriors():
    """The mean rank of the truth among the reference's draws, over many observations, is one half."""
    for name in ("gaussian_linear_uniform", "gaussian_mixture"):
        task, ranks = TASKS[name](), []
        for number in range(1, 61):
            theta = task.support().sample(jax.random.split(jax.random.key(number))[0], 1)[0]
            ranks.append((reference(name, number) < np.asarray(theta)).mean(0))
        assert stats.kstest(np.concatenate(ranks), "uniform").pvalue > 1e-3


def test_the_needle_is_there():
    """Half of the mixture's posterior is ten times as narrow as the other half."""
    draws, x = reference("gaussian_mixture", 1), observation("gaussian_mixture", 1)
    assert np.mean(np.linalg.norm(draws - x, axis=1) < 0.3) == pytest.approx(0.5 + 0.5 * 0.044, abs=0.03)
    simulated = jax.jit(jax.vmap(TASKS["gaussian_mixture"]().simulate))(
        jax.random.split(jax.random.key(0), 4000), jnp.zeros((4000, 2))
    )
    expected = lambda z: 0.5 * stats.norm.cdf(z) + 0.5 * stats.norm.cdf(z, scale=0.1)
    assert stats.kstest(np.asarray(simulated)[:, 0], expected).pvalue > 1e-3
