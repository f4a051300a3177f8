"""Tasks of which something can be chosen: at their nominal design, at others, and several experiments together."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.distributions.support import Support
from jaxlfi.tasks.design import Design
from jaxlfi.tasks.experiments import at, experiments, single
from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.observation import simulator_shapes
from jaxlfi.tasks.simulation import simulate, simulate_batch
from jaxlfi.tasks.task import Task
from jaxlfi.tasks.trials import repeated

BOX = Support([0.1], [9.0])


def decay(key, theta, design):
    return jnp.exp(-theta[0] * design[0] * jnp.arange(1.0, 4.0)) + 0.0 * jax.random.normal(key, (3,)), True


def task(**changes):
    fields = {"simulate": decay, "names": ["rate"], "supports": {"guess": BOX}, "feasible": BOX}
    return Task(**(fields | {"design": {"time": (0.0, 4.0, "s")}} | changes))


def test_a_task_is_inferred_at_its_nominal_design():
    assert task().design.nominal == (2.0,)
    x, failure = simulate(jax.random.key(0), task(), jnp.ones((2, 1)))
    np.testing.assert_allclose(x, np.exp(-2.0 * np.array([[1, 2, 3]] * 2)), rtol=1e-5)
    assert failure.tolist() == [0, 0]
    assert simulator_shapes(task()).trajectory == (3,)
    own = task(design=Design({"time": (0.0, 4.0)}, nominal={"time": 1.0}))
    np.testing.assert_allclose(simulate(jax.random.key(0), own, jnp.ones((1, 1)))[0][0, 0], np.exp(-1.0), rtol=1e-6)


def test_a_task_made_again_is_the_same_task():
    assert task() == task() and hash(task()) == hash(task())
    assert dataclasses.replace(task(), name="other").simulate == task().simulate
    assert at(task(), [1.0]) != task() and at(task(), [2.0]) == task()
    assert repeated(task(), 3).design is None


def test_several_experiments_are_one_after_another():
    both = experiments(task(), [{"time": 1.0}, [0.5]])
    assert single(both) == task() and single(task()) == task()
    x, failure = simulate(jax.random.key(0), both, jnp.ones((1, 1)))
    np.testing.assert_allclose(x[0], np.exp(-np.array([1, 2, 3, 0.5, 1.0, 1.5])), rtol=1e-5)
    assert failure.tolist() == [0]
    assert experiments(both, [[1.0]]) == at(task(), [1.0])
    assert both.named_summaries(6)


@pytest.mark.parametrize("each", [False, True])
def test_simulators_outside_jax_take_a_design(each):
    def one(rng, theta, design):
        return np.exp(-theta[0] * design * np.array([1.0, 2.0])), theta[0] < 5.0

    def batch(rng, theta, design):
        return np.exp(-theta * design * np.array([1.0, 2.0])), theta[:, 0] < 5.0

    own = task(simulate=HostSimulator(one if each else batch, each=each))
    theta = jnp.array([[1.0], [6.0]])
    trajectory, x, failure = simulate_batch(jax.random.key(0), own, theta, (2,))
    np.testing.assert_allclose(x[0], np.exp([-2.0, -4.0]), rtol=1e-5)
    assert failure.tolist() == [0, 1]
    trajectory, x, failure = simulate_batch(jax.random.key(0), experiments(own, [[1.0], [3.0]]), theta, (4,))
    np.testing.assert_allclose(trajectory[0], np.exp([-1.0, -2.0, -3.0, -6.0]), rtol=1e-5)
    assert failure.tolist() == [0, 1]


def test_designs_map():
    over = jax.vmap(decay, (None, None, 0))(jax.random.key(0), jnp.ones(1), jnp.array([[1.0], [2.0]]))[0]
    np.testing.assert_allclose(over[1, 0], np.exp(-2.0), rtol=1e-6)


@pytest.mark.parametrize(
    ("design", "message"),
    [
        ({}, "design: expected a mapping"),
        ({"time": (1.0, 0.0)}, "design: time: expected .low, high."),
        ({"time": (0.0, 1.0, 3)}, "design: time: expected"),
        ({"time": 1.0}, "design: time: expected"),
        ([1.0], "design: expected a mapping"),
    ],
)
def test_what_is_no_design_is_refused(design, message):
    with pytest.raises(ValueError, match=message) as caught:
        task(design=design)
    assert "\n" not in str(caught.value)


def test_designs_outside_of_their_bounds_are_refused():
    with pytest.raises(ValueError, match="design: time: expected 0 to 4, got 5"):
        at(task(), [5.0])
    with pytest.raises(ValueError, match=r"design: expected names among \['time'\], got \['tiem'\]"):
        experiments(task(), [{"tiem": 1.0}])
    with pytest.raises(ValueError, match="design: time: expected 0 to 4, got nan"):
        at(task(), [float("nan")])
    with pytest.raises(ValueError, match="design: time: expected 0 to 4, got 9"):
        Design({"time": (0.0, 4.0)}, nominal=[9.0])
    with pytest.raises(ValueError, match="noise: expected standard deviations above 0"):
        Design({"time": (0.0, 4.0)}, noise=0.0)


def test_tasks_and_simulators_without_a_design_are_refused():
    with pytest.raises(ValueError, match="design: expected a task with a design"):
        at(task(design=None, simulate=lambda key, theta: theta), [1.0])
    with pytest.raises(ValueError, match=r"simulate: expected a function of \(key, theta, design\)"):
        task(simulate=lambda key, theta: theta)
