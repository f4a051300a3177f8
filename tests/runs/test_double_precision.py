"""Runs where the process has double precision on: simulators get it, and inference is as it is without."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlfi
from jaxlfi.bayessim.batch import RunSpec, posterior_after, round_one, stack_inputs, start_one
from jaxlfi.distributions.precision import own, single
from jaxlfi.distributions.support import Support
from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.observation import simulator_shapes
from jaxlfi.tasks.simulation import simulate_batch
from jaxlfi.tasks.task import Task
from tests.small import settings, whole_runs  # noqa: F401 - a fixture

BOX = Support([-3.0, -3.0], [3.0, 3.0])
OBSERVED = np.array([1.0, -1.0])
LARGE = 1e9
"""Beside it single precision has no digits for a parameter."""


def simulate(key, theta):
    """The parameters with noise, on a way that keeps them in double precision only."""
    assert theta.dtype == jnp.float64
    far, _ = jax.lax.scan(lambda x, step: (x + step, None), theta, jnp.full(10, LARGE / 10))
    return far - LARGE + 0.5 * jax.random.normal(key, (2,)), jnp.argmax(far) < 5


def numpy_simulate(rng, theta):
    """The same on the host."""
    return theta + 0.5 * rng.normal(size=theta.shape)


def summary(trajectory):
    """On such a way, too."""
    return trajectory.astype(float) + LARGE - LARGE


TASK = Task(simulate, ("a", "b"), {"box": BOX}, BOX, summary=summary)
HOST = Task(HostSimulator(numpy_simulate), ("a", "b"), {"box": BOX}, BOX)


@pytest.fixture(autouse=True)
def double():
    """Double precision, as a user switches it on for the whole process."""
    with jax.enable_x64(True):
        yield


def wide(tree) -> list:
    """Leaves in double precision."""
    return [leaf.dtype for leaf in jax.tree.leaves(tree) if str(getattr(leaf, "dtype", "")) in ("float64", "int64")]


def test_what_is_traced_is_in_single_precision_and_what_is_anothers_is_not():
    def function(x, other):
        with own():
            within = jnp.ones(2) + x
            assert within.dtype == jnp.float64
        assert jnp.ones(2).dtype == jnp.float32 and jnp.arange(2).dtype == jnp.int32
        return x, within.astype(jnp.float32), jnp.argsort(x), other

    assert not wide(jax.jit(single(function))(jnp.zeros(2), {"a": np.arange(2), "b": 1.0}))
    with jax.enable_x64(False), own():
        assert jnp.ones(2).dtype == jnp.float32


def test_simulations_are_made_in_double_precision(key):
    theta = BOX.sample(key, 2000)
    for task in (TASK, HOST):
        trajectory, x, failure = simulate_batch(jax.random.clone(key), task, theta, (2,))
        assert not failure.any() and (task is HOST or not wide((trajectory, x)))
        noise = np.asarray(x) - np.asarray(theta)
        np.testing.assert_allclose(noise.mean(axis=0), 0.0, atol=5 * 0.5 / np.sqrt(2000))
        np.testing.assert_allclose(noise.std(axis=0), 0.5, rtol=0.1)  # six standard errors
    assert simulator_shapes(TASK).trajectory == (2,)


@pytest.mark.slow  # what is in which precision is tested of shorter runs, and posteriors elsewhere in single precision
@pytest.mark.parametrize("task", [TASK, HOST])
def test_the_posterior_is_the_exact_one(task, tmp_path):
    """N(x, 0.5^2) in each parameter, by conjugacy."""
    network = settings().estimator.replace(steps=1500, batch_size=100, learning_rate=1e-2, components=1)
    numbers = settings(rounds=1, simulations_per_round=400, simulation_budget=400, estimator=network)
    run = jaxlfi.infer(jax.random.key(0), task, OBSERVED, heuristic=jaxlfi.Fixed(), settings=numbers)
    assert not wide((run.belief, run.network)) and (task is HOST or not wide(run.dataset))
    draws = np.asarray(run.posterior.sample(jax.random.key(1), 2000))
    np.testing.assert_allclose(draws.mean(axis=0), OBSERVED, atol=0.25)
    np.testing.assert_allclose(draws.std(axis=0), 0.5, rtol=0.3)
    loaded = jaxlfi.load(run.save(tmp_path / "run"), task)
    np.testing.assert_allclose(loaded.posterior.sample(jax.random.key(1), 2000), draws, rtol=1e-6)
    assert not wide((loaded.belief, loaded.network)) and (task is HOST or not wide(loaded.dataset))
    assert np.isfinite(run.posterior.log_prob(OBSERVED)) and np.isfinite(run.posterior.map()).all()


@pytest.mark.slow
def test_rules_and_their_numbers_are_mapped_over():
    rates = jnp.asarray([0.1, 0.2])  # in double precision
    rule = lambda rate: jaxlfi.Edge(expansion=rate)
    infer = lambda rate: jaxlfi.infer(jax.random.key(0), TASK, OBSERVED, heuristic=rule(rate), settings=settings())
    runs = jax.vmap(infer)(rates)
    assert not wide((runs.belief, runs.dataset)) and np.isfinite(runs.belief.mixture.means).all()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["apt", "snle"])
def test_other_methods_are_traced_in_single_precision(method):
    """A round, its check and its posterior: tracing finds what was mixed, and compiling would only take longer."""
    numbers = jaxlfi.METHODS[method](jaxlfi.QUICK).replace(simulations_per_round=50, simulation_budget=50)
    numbers = numbers.replace(inflation=np.float64(2.0))  # a number of NumPy's has a precision of its own
    spec = RunSpec("own", "box", TASK.support("box"), jaxlfi.Edge(), 0)
    inputs, _ = stack_inputs([spec], OBSERVED[None], OBSERVED[None])
    one = jax.tree.map(lambda leaf: leaf[0], inputs)
    state = jax.eval_shape(single(functools.partial(start_one, TASK, None)), numbers, one)
    after, row = jax.eval_shape(single(functools.partial(round_one, TASK)), numbers, one, state, 0)
    assert not wide((state, after, row))
    same = jax.tree.map(lambda a, b: (a.shape, a.dtype) == (b.shape, b.dtype), state, after)
    assert all(jax.tree.leaves(same))  # so that it can be carried by a scan, and its memory be used again

    def draws(state, one):
        posterior = posterior_after(numbers.correction, state.reported, state.network, one.x)
        return posterior.inner_draws(jax.random.key(0), 10)

    assert not wide(jax.eval_shape(single(draws), after, one))
