"""Host simulators: what they are given, and which shapes they may give."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.distributions.support import Support
from jaxlfi.tasks.host import HostSimulator, SimulatorError
from jaxlfi.tasks.simulation import simulate_batch
from jaxlfi.tasks.task import Task

THETA = np.float32([[0.5, 1.0], [2.0, -1.0], [1.0, 0.0]])


def plus_noise(rng, theta):
    """Trajectories [N, 2]."""
    return theta + 0.1 * rng.normal(size=theta.shape)


def task(function, **changes) -> Task:
    """The first parameter in logarithms."""
    box = Support([0.1, -3.0], [20.0, 3.0])
    return Task(HostSimulator(function), ("a", "b"), {"box": box}, box, log=("a",), **changes)


def test_a_batch_repeats_by_its_key(key):
    simulator = HostSimulator(plus_noise)
    first, outcomes = simulator.batch(jax.random.clone(key), THETA)
    second, _ = simulator.batch(jax.random.clone(key), THETA)
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(outcomes, [0, 0, 0])
    other, _ = simulator.batch(jax.random.split(key)[0], THETA)
    assert np.abs(other - first).max() > 1e-3


def test_a_generator_goes_on(key):
    simulator, rng = HostSimulator(plus_noise), np.random.default_rng(0)
    first, second = (simulator.batch(rng, THETA)[0] for _ in range(2))
    assert np.abs(first - second).max() > 1e-3


def test_one_simulation_is_a_batch_of_one(key):
    trajectory, outcome = HostSimulator(lambda rng, theta: (2 * theta, np.ones(len(theta), bool)))(key, THETA[1])
    np.testing.assert_array_equal(trajectory, 2 * THETA[1])
    assert outcome == 0


@pytest.mark.parametrize(
    ("outcome", "expected"),
    [
        (np.array([True, False, True]), [0, 1, 0]),
        (np.array([0, 2, 1]), [0, 2, 1]),
        ([0, 0, 1], [0, 0, 1]),
    ],
)
def test_outcomes_are_validity_or_reasons(outcome, expected):
    _, outcomes = HostSimulator(lambda rng, theta: (theta, outcome)).batch(np.random.default_rng(0), THETA)
    np.testing.assert_array_equal(outcomes, expected)


@pytest.mark.parametrize(
    ("given", "shape", "expected"),
    [
        ((3, 5), None, (3, 5)),
        ((3, 5), (5,), (3, 5)),
        ((3, 5), (5, 1), (3, 5, 1)),  # as a file of one channel says
        ((3, 5, 1), (5,), (3, 5)),
        ((3, 1, 5), (5, 1), (3, 5, 1)),
        ((3, 5, 2), (5, 2), (3, 5, 2)),
    ],
)
def test_axes_of_one_are_added_and_dropped(given, shape, expected):
    values = np.arange(np.prod(given), dtype=float).reshape(given)
    trajectories, _ = HostSimulator(lambda rng, theta: values).batch(np.random.default_rng(0), THETA, shape)
    assert trajectories.shape == expected
    np.testing.assert_array_equal(trajectories.ravel(), values.ravel())


@pytest.mark.parametrize(
    ("result", "shape", "message"),
    [
        (np.zeros((2, 5)), None, r"expected numbers of shape \[3, ...\] for 3 .* got float64 of shape \[2, 5\]"),
        (np.zeros(3), None, r"got float64 of shape \[3\]"),
        (np.zeros((3, 4)), (5,), r"expected numbers of shape \[3, 5\] .* of shape \[3, 4\]"),
        (np.zeros((3, 2, 5)), (5, 2), r"of shape \[3, 2, 5\]"),
        (np.full((3, 5), "x"), None, r"got <U1 of shape \[3, 5\]"),
        (np.zeros((3, 5)) * 1j, None, r"got complex128"),
        ([[1.0, 2.0], [1.0], [3.0]], None, r"^simulate: ValueError: "),  # trajectories of unlike lengths
        (None, None, r"got object of shape \[\]"),
        ((np.zeros((3, 5)), np.zeros(2, int)), None, r"expected an outcome for each of 3 .* int64 of shape \[2\]"),
        ((np.zeros((3, 5)), np.zeros(3)), None, r"expected an outcome .* got float64 of shape \[3\]"),
    ],
)  # fmt: skip
def test_broken_contracts_are_reported(result, shape, message):
    with pytest.raises(SimulatorError, match=message) as error:
        HostSimulator(lambda rng, theta: result).batch(np.random.default_rng(0), THETA, shape)
    assert str(error.value).startswith("simulate: ")


def test_what_it_raises_is_named():
    with pytest.raises(SimulatorError, match=r"^simulate: ZeroDivisionError: division by zero$"):
        HostSimulator(lambda rng, theta: 1 / 0).batch(np.random.default_rng(0), THETA)


def test_it_cannot_be_traced(key):
    simulator = HostSimulator(plus_noise)
    with pytest.raises(SimulatorError, match=r"^simulate: expected concrete arguments for a host simulator"):
        jax.jit(simulator)(key, THETA[0])


def test_host_simulators_of_one_function_are_equal():
    assert HostSimulator(plus_noise) == HostSimulator(plus_noise)
    assert hash(HostSimulator(plus_noise)) == hash(HostSimulator(plus_noise))
    assert HostSimulator(plus_noise) != HostSimulator(lambda rng, theta: theta)


def test_batches_are_in_natural_units_and_only_of_what_is_wanted(key):
    calls = []

    def noting(rng, theta):
        calls.append(theta)
        return theta

    theta = jnp.array([[0.0, 1.0], [np.log(2.0), -1.0], [1.0, 0.0]])
    wanted = np.array([True, True, False])
    trajectories, x, failure = simulate_batch(key, task(noting), theta, (2,), wanted)
    np.testing.assert_allclose(calls[0], [[1.0, 1.0], [2.0, -1.0]], rtol=1e-6)
    np.testing.assert_allclose(trajectories, [[1.0, 1.0], [2.0, -1.0], [0.0, 0.0]], rtol=1e-6)
    np.testing.assert_allclose(x, trajectories)
    np.testing.assert_array_equal(failure, [0, 0, 1])
