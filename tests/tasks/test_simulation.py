"""Simulating within a budget, against a plain Python loop; failures, each with its reason."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxlfi.distributions.support import Support
from jaxlfi.tasks.simulation import simulate, trajectory_and_outcome, within_budget
from jaxlfi.tasks.task import Task

BUDGET = 9
budget = jax.jit(within_budget)


def loop(failures, simulations_per_round):
    """Attempt in order and stop at the last success that is needed."""
    counted, kept, by_reason = [], [], {1: 0, 2: 0, 3: 0}
    for place, failure in enumerate(failures):
        if len(kept) == simulations_per_round:
            break
        counted.append(place)
        if failure == 0:
            kept.append(place)
        else:
            by_reason[failure] += 1
    return counted, kept, by_reason


@given(st.lists(st.integers(0, 3), min_size=BUDGET, max_size=BUDGET), st.integers(1, BUDGET))
def test_budget_against_a_loop(failures, simulations_per_round):
    theta, x = jnp.zeros((BUDGET, 2)), jnp.zeros((BUDGET, 1))
    attempts = budget(theta, x, jnp.asarray(failures), simulations_per_round)
    counted, kept, by_reason = loop(failures, simulations_per_round)
    assert np.flatnonzero(attempts.counted).tolist() == counted
    assert np.flatnonzero(attempts.kept).tolist() == kept
    assert int(attempts.attempted) == len(counted)
    assert int(attempts.succeeded) == len(kept)
    assert attempts.failed(3).tolist() == list(by_reason.values())
    assert int(attempts.attempted) == int(attempts.succeeded) + int(attempts.failed(3).sum())


def test_batched_attempts_are_counted_run_by_run():
    failure = jnp.array([[0, 1, 0, 2], [3, 3, 1, 3]])
    one = lambda failure: within_budget(jnp.zeros((4, 1)), jnp.zeros((4, 1)), failure, 2)
    attempts = jax.vmap(one)(failure)
    np.testing.assert_array_equal(attempts.failed(3), [[1, 0, 0], [1, 0, 3]])
    np.testing.assert_array_equal(attempts.attempted, [3, 4])
    np.testing.assert_array_equal(attempts.succeeded, [2, 0])


def task_of(simulator, summary="identity", failures=("slow", "fell")) -> Task:
    box = Support([0.5, -2.0], [20.0, 2.0])
    return Task(simulator, ("a", "b"), {"own": box}, box, summary=summary, failures=failures, log=("a",))


def run(task, theta, key):
    x, failure = jax.jit(lambda k, t: simulate(k, task, t))(key, jnp.asarray(theta, jnp.float32))
    return np.asarray(x), np.asarray(failure)


THETA = [[0.0, 0.5], [np.log(10.0), -1.5], [1.0, 0.0]]


def test_simulators_see_natural_units(key):
    x, failure = run(task_of(lambda key, theta: theta), THETA, key)
    np.testing.assert_allclose(x, [[1.0, 0.5], [10.0, -1.5], [np.e, 0.0]], rtol=1e-6)
    np.testing.assert_array_equal(failure, [0, 0, 0])


def test_a_boolean_outcome_is_validity(key):
    x, failure = run(task_of(lambda key, theta: (theta, theta[1] > -1.0)), THETA, key)
    np.testing.assert_array_equal(failure, [0, 1, 0])
    np.testing.assert_array_equal(x[1], [0.0, 0.0])
    assert x[0, 0] == 1.0


def test_an_integer_outcome_is_the_reason(key):
    outcome = lambda theta: jnp.where(theta[1] < -1.0, 2, jnp.where(theta[1] == 0.0, 1, 0))
    x, failure = run(task_of(lambda key, theta: (theta, outcome(theta))), THETA, key)
    np.testing.assert_array_equal(failure, [0, 2, 1])
    assert failure.dtype == np.int32
    np.testing.assert_array_equal(x[1:], 0.0)


@pytest.mark.parametrize("code", [-1, 3, 99])
def test_an_integer_that_is_no_reason_counts_as_the_first(code, key):
    """3 would be "non_finite", which is not the simulator's to tell; none may get lost between the reasons."""
    _, failure = run(task_of(lambda key, theta: (theta, jnp.where(theta[1] < 0.0, code, 0))), THETA, key)
    np.testing.assert_array_equal(failure, [0, 1, 0])


@pytest.mark.parametrize("bad", [jnp.nan, jnp.inf, -jnp.inf])
def test_non_finite_trajectories_are_a_failure(bad, key):
    """This also holds if the simulator reports success; if it reports a reason, that comes first."""
    broken = lambda key, theta: (jnp.where(theta[1] <= 0.0, bad, theta), jnp.where(theta[1] < -1.0, 1, 0))
    x, failure = run(task_of(broken), THETA, key)
    np.testing.assert_array_equal(failure, [0, 1, 3])  # "non_finite" is the third of the reasons
    assert np.isfinite(x).all()


def test_non_finite_summaries_are_a_failure(key):
    task = task_of(lambda key, theta: theta, summary=lambda trajectory: jnp.log(trajectory))
    x, failure = run(task, THETA, key)
    np.testing.assert_array_equal(failure, [0, 3, 3])  # log(-1.5) and log(0)
    np.testing.assert_allclose(x, [[0.0, np.log(0.5)], [0.0, 0.0], [0.0, 0.0]], rtol=1e-6)


def test_gradients_of_no_summary_see_a_failed_trajectory(key):
    """A failed trajectory is not summarised: what the summary would make of it cannot hide the reason."""
    summary = lambda trajectory: jnp.where(jnp.isnan(trajectory), 7.0, trajectory)
    x, failure = run(task_of(lambda key, theta: theta * jnp.nan, summary), THETA, key)
    np.testing.assert_array_equal(failure, [3, 3, 3])
    np.testing.assert_array_equal(x, np.zeros((3, 2)))


def test_rows_have_keys_of_their_own_and_repeat(key):
    noise = task_of(lambda key, theta: theta + jax.random.normal(key, (2,)))
    again = jax.random.clone(key)
    x, _ = run(noise, [[0.0, 0.0]] * 4, key)
    assert len(np.unique(x[:, 0])) == 4
    chex.assert_trees_all_equal(x, run(noise, [[0.0, 0.0]] * 4, again)[0])


def test_integer_trajectories_become_float(key):
    task = task_of(lambda key, theta: jnp.arange(3))
    trajectory, failure = trajectory_and_outcome(task, key, jnp.zeros(2))
    assert trajectory.dtype == jnp.float32 and int(failure) == 0
