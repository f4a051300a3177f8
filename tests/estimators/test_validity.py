"""The probability of success: it is learnt from attempts, and is part of every posterior."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlfi
from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support
from jaxlfi.estimators import dataset as datasets
from jaxlfi.estimators import validity
from jaxlfi.estimators.likelihood_estimators import MixtureLikelihood
from jaxlfi.estimators.mixture_network import MixtureNetwork
from jaxlfi.heuristics import Fixed
from tests.small import settings, whole_runs  # noqa: F401 - a fixture

UNIT = Support([0.0], [1.0])
ATTEMPTS = 2000
SUCCESS = {
    "cube": lambda theta: theta**3,
    "threshold": lambda theta: 1.0 * (theta > 0.5),
    "valley": lambda theta: 1 - 0.95 * np.exp(-0.5 * ((theta - 0.5) / 0.15) ** 2),
    "always": np.ones_like,
}
"""Probabilities of success given the parameter; the observation below is in the middle, where they differ most."""


@jax.jit
def learnt(theta, success):
    """The log-probability learnt from attempts, at the centres of ten bins."""
    attempts = datasets.empty(ATTEMPTS, 1, 1).replace(theta=theta, x=success, size=jnp.asarray(ATTEMPTS))
    start = validity.unknown(jax.random.key(0), UNIT, Space(("a",), (False,)))
    return start.learnt(jax.random.key(1), attempts).log_prob((jnp.arange(10.0)[:, None] + 0.5) / 10)


@pytest.mark.parametrize("kind", SUCCESS)
def test_the_probability_is_learnt(kind):
    rng = np.random.default_rng(0)
    theta = rng.uniform(size=(ATTEMPTS, 1)).astype(np.float32)
    success = (rng.uniform(size=(ATTEMPTS, 1)) < SUCCESS[kind](theta)).astype(np.float32)
    middles = (np.arange(10) + 0.5) / 10
    got = np.exp(np.asarray(learnt(theta, success), float))
    np.testing.assert_allclose(got, SUCCESS[kind](middles), atol=0.15)
    assert np.abs(got - SUCCESS[kind](middles)).mean() < 0.05
    if kind == "always":
        assert (got == 1).all()  # nothing is trained


kind = ["cube"]
"""Name of the probability of the simulator below: one task and one compiled program for all of them."""


def simulate(rng, theta):
    return theta + 0.3 * rng.normal(size=theta.shape), rng.uniform(size=len(theta)) < SUCCESS[kind[0]](theta[:, 0])


TASK = jaxlfi.Task(jaxlfi.HostSimulator(simulate), names=("a",), supports={"unit": UNIT}, feasible=UNIT)
SHARED = {
    "hidden": (32,), "ensemble_size": 2, "epochs": 0, "warm_start": False, "schedule": "cosine", "validation": 0.1,
}  # fmt: skip
ESTIMATORS = {
    "likelihood": MixtureLikelihood(components=2, steps=400, learning_rate=3e-3, noise_floor=0.0, **SHARED),
    "atomic": MixtureNetwork(components=3, steps=1000, learning_rate=3e-3, loss="combined", **SHARED),
}


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_posteriors_are_those_given_success(estimator):
    """Compared with a sum over a grid. Without the factor, the cube's mean would be 0.500, and the valley a hill."""
    rounds = settings(
        estimator=ESTIMATORS[estimator], rounds=2, simulations_per_round=500, simulation_budget=2500,
        restriction="reject", predictive=False,
    )  # fmt: skip
    grid = np.linspace(0, 1, 4001)
    for kind[0] in ("cube", "threshold", "valley"):
        run = jaxlfi.infer(jax.random.key(0), TASK, np.array([0.5]), heuristic=Fixed(), settings=rounds)
        draws = np.asarray(run.posterior.sample(jax.random.key(9), 4000), float)[:, 0]
        weight = SUCCESS[kind[0]](grid) * np.exp(-0.5 * ((0.5 - grid) / 0.3) ** 2)
        weight /= weight.sum()
        mean = (weight * grid).sum()
        deviation = np.sqrt((weight * (grid - mean) ** 2).sum())
        assert draws.mean() == pytest.approx(mean, abs=0.35 * deviation), kind[0]
        assert draws.std() == pytest.approx(deviation, rel=0.25), kind[0]
