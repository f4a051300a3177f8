"""DROPO recovers how masses are spread, and does not spread where one mass explains the log."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rl.pushed import FEASIBLE, INTERVAL, SPACE, pushed
from scipy import stats

from jaxlfi.rl.randomisation import dropo
from jaxlfi.rl.randomisation.dropo import Dropo, Transitions

MANY = 600
SIGMAS = 4.0


def log_of(masses: np.ndarray, noise: float = 0.0) -> Transitions:
    """Transitions from states that differ, each of its own mass, with noise on what is logged after them."""
    rng = np.random.default_rng(3)
    states = rng.normal(size=(len(masses), 2))
    forces = rng.uniform(2.0, 6.0, (len(masses), 1, 1))  # never near zero: each transition says something of the mass
    after = jax.vmap(pushed)(jnp.asarray(masses)[:, None], jnp.asarray(states), jnp.asarray(forces))
    return Transitions(jnp.asarray(states), jnp.asarray(forces), after + noise * rng.normal(size=after.shape))


def test_it_recovers_the_mean_and_the_spread_of_masses():
    middle, spread = np.log(2.0), 0.15
    masses = np.exp(middle + spread * np.random.default_rng(1).standard_normal(MANY))
    found = dropo.fit(0, pushed, log_of(masses), SPACE, FEASIBLE, Dropo(epsilon=1e-8))
    assert abs(float(found.mean[0]) - middle) < SIGMAS * spread / MANY**0.5
    assert abs(float(found.deviation[0]) - spread) < SIGMAS * spread / (2 * MANY) ** 0.5


def test_one_mass_seen_with_noise_is_a_narrow_distribution_around_it():
    """The mean's standard error is that of least squares on what pushes do: position and velocity of each."""
    noise, mass = 0.02, 2.0
    logged = log_of(np.full(MANY, mass), noise)
    found = dropo.fit(0, pushed, logged, SPACE, FEASIBLE, Dropo(epsilon=noise**2))
    moved = np.asarray(logged.actions)[:, 0, 0] / mass  # d state / d ln mass, but for the lengths of time
    error = noise / np.sqrt(np.sum(moved**2) * (INTERVAL**2 + (INTERVAL**2 / 2) ** 2))
    assert abs(float(found.mean[0]) - np.log(mass)) < SIGMAS * error
    assert float(found.deviation[0]) < 0.05  # a spread of 0.15 has a likelihood lower by hundreds


def test_the_likelihood_is_that_of_the_draws_moments():
    theta = jnp.array([[0.5], [1.0], [4.0], [8.0]])
    logged = Transitions(jnp.array([[0.2, -1.0], [0.0, 3.0]]), jnp.array([[[2.0], [1.0]], [[-4.0], [0.5]]]),
                         jnp.array([[0.3, -0.5], [0.5, 2.5]]))  # fmt: skip
    expected = 0.0
    for state, actions, after in zip(logged.states, logged.actions, logged.after, strict=True):
        simulated = np.array([pushed(one, state, actions) for one in theta], float)
        covariance = np.cov(simulated.T) + 0.01 * np.eye(2)
        expected += stats.multivariate_normal(simulated.mean(axis=0), covariance).logpdf(np.asarray(after, float))
    found = jax.jit(dropo.log_likelihood, static_argnums=0)(pushed, logged, theta, 0.01)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_transitions_of_a_trajectory():
    """Three actions and a lookahead of two are two transitions, each with the actions between its states."""
    states, actions = np.arange(8.0).reshape(4, 2), np.array([[10.0], [20.0], [30.0]])
    made = dropo.transitions(states, actions, lookahead=2)
    assert made.states.tolist() == [[0, 1], [2, 3]] and made.after.tolist() == [[4, 5], [6, 7]]
    assert made.actions.tolist() == [[[10], [20]], [[20], [30]]]
    with pytest.raises(ValueError, match="a state more than actions"):
        dropo.transitions(states[:3], actions)
    with pytest.raises(ValueError, match="at least 4 actions"):
        dropo.transitions(states, actions, lookahead=4)
    with pytest.raises(ValueError, match="expected a lookahead of 1, got 2"):
        dropo.fit(0, pushed, made, SPACE, FEASIBLE)
