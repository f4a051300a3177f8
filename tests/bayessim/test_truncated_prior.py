"""Proposals from the truncated prior: simulations of all rounds are pooled, and posteriors keep their width."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi import METHODS, QUICK
from jaxlfi.bayessim import algorithm
from jaxlfi.envs import gaussian_linear
from jaxlfi.estimators.mixture_network import MixtureNetwork
from jaxlfi.heuristics import Fixed
from tests.small import gaussian, settings, whole_runs  # noqa: F401 - a fixture

X = jnp.asarray(gaussian_linear.MIXING @ np.array([0.3, -0.9], np.float32))
NETWORK = MixtureNetwork(
    hidden=(16,),
    components=1,
    epochs=0,
    steps=600,
    batch_size=100,
    learning_rate=5e-3,
    schedule="cosine",
    parameters="zscore",
    warm_start=False,
)


def compared(chosen, keys):
    """Standard deviations relative to the exact ones, and errors of means in exact ones, both [runs, 2]."""
    exact, task = jax.jit(gaussian_linear.posterior)(X), gaussian()
    box = task.support("ok")
    run = lambda key: algorithm.run(key, task, chosen, Fixed(), X, box, lambda *_: ())[0]
    mixture = jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(2), keys)).reported.mixture
    deviation = np.sqrt(np.diag(exact.covariance))
    mean, covariance = jax.vmap(lambda one: (one.mean, one.covariance))(mixture)
    return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)) / deviation, (mean - exact.mean) / deviation


@pytest.mark.slow
def test_rounds_do_not_narrow_the_posterior():
    """Rounds that draw from the posterior itself do, and would do so more without the first, wide round in the pool."""
    rounds = settings(estimator=NETWORK, rounds=12, simulations_per_round=200, simulation_budget=200, predictive=False)
    ratio, off = compared(rounds.replace(restriction="prior"), 6)
    assert 0.93 < np.exp(np.log(ratio).mean()) < 1.1 and np.abs(off.mean(axis=0)).max() < 0.3
    narrowed, _ = compared(rounds.replace(restriction="reject"), 6)
    assert np.exp(np.log(narrowed).mean()) < 0.92


@pytest.mark.slow
def test_flows_of_the_method_are_as_wide_as_the_posterior():
    chosen = METHODS["tsnpe"](QUICK).replace(rounds=5, predictive=False)
    chosen = chosen.replace(estimator=chosen.estimator.replace(epochs=50, transforms=2))
    ratio, off = compared(chosen, 3)
    assert 0.85 < np.exp(np.log(ratio).mean()) < 1.2 and np.abs(off).max() < 0.8
