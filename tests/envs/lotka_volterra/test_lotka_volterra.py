"""The Lotka-Volterra task: supports, Phi, truth and summary to the letter of sections III and V."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.envs import lotka_volterra
from jaxlfi.envs.lotka_volterra.jump_process import JumpProcess, lotka_volterra_nine
from jaxlfi.tasks.simulation import simulate, trajectory_and_outcome


@pytest.fixture(scope="module")
def task():
    return lotka_volterra.task()


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("ok", [-5, -5, -5, -5], [2, 2, 2, 2]),
        ("misspecified", [-3, -5, -5, -5], [2, -1.5, 2, 2]),
        ("broad", [-6, -6, -6, -6], [4, 4, 4, 4]),
        ("broader", [-6, -6, -6, -6], [5, 5, 5, 5]),
        ("broadest", [-7, -7, -7, -7], [7, 7, 7, 7]),
    ],
)
def test_supports_of_section_three(task, name, low, high):
    np.testing.assert_array_equal(task.support(name).low, np.float32(low))
    np.testing.assert_array_equal(task.support(name).high, np.float32(high))


def test_there_are_five_supports_and_the_first_is_the_default(task):
    assert list(task.supports) == ["ok", "misspecified", "broad", "broader", "broadest"]
    np.testing.assert_array_equal(task.support().low, task.supports["ok"].low)
    np.testing.assert_array_equal(task.support().high, task.supports["ok"].high)


def test_phi_of_section_five(task):
    np.testing.assert_array_equal(task.feasible.low, [-6] * 4)
    np.testing.assert_array_equal(task.feasible.high, [4] * 4)


def test_the_truth_is_in_log_rates(task):
    np.testing.assert_allclose(np.exp(task.truth), [0.01, 0.5, 1.0, 0.01], rtol=1e-6)
    assert task.log == () and task.space.labels == task.names  # they are log-rates already


def test_the_misspecified_support_excludes_the_first_two_rates_only(task):
    box = task.support("misspecified")
    inside = (task.truth >= box.low) & (task.truth <= box.high)
    assert np.asarray(inside).tolist() == [False, False, True, True]
    assert float(task.truth[0]) < float(box.low[0]) and float(task.truth[1]) > float(box.high[1])
    for name in ("ok", "broad", "broader", "broadest"):
        assert bool(task.support(name).contains(task.truth))


def test_the_summary_is_the_nine(task):
    assert task.summary is lotka_volterra_nine


def test_the_contract(task, key):
    """Shapes, names and the only reason of failure, at the truth and where populations explode."""
    assert task.dim == len(task.names) == len(task.units) == 4
    assert task.reasons == ("too_many_events", "non_finite")
    assert task.channels == ("predators", "prey")
    np.testing.assert_allclose(task.times, np.linspace(0, 30, 151))
    at_truth, explosive = task.truth, jnp.array([-6.0, -6.0, 4.0, -6.0])
    x, failure = jax.jit(lambda k, t: simulate(k, task, t))(key, jnp.stack([at_truth, explosive]))
    assert x.shape == (2, 9) and failure.tolist() == [0, 1]
    assert bool(jnp.isfinite(x).all()) and not np.asarray(x[1]).any()


def test_the_trajectory_starts_where_the_process_does(key):
    short = lotka_volterra.task(JumpProcess(predators=30, prey=70, duration=2.0, interval=0.5))
    trajectory, failure = trajectory_and_outcome(short, key, short.truth)
    assert trajectory.shape == (5, 2) == (len(short.times), 2) and int(failure) == 0
    np.testing.assert_array_equal(trajectory[0], [30, 70])
    np.testing.assert_allclose(short.times, [0, 0.5, 1, 1.5, 2])


def test_the_default_process_is_the_papers(task, key):
    trajectory, failure = jax.jit(lambda k, t: trajectory_and_outcome(task, k, t))(key, task.truth)
    assert trajectory.shape == (151, 2) and int(failure) == 0
    np.testing.assert_array_equal(trajectory[0], [50, 100])
