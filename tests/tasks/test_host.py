"""Host simulators: called for no more than is needed, and held to their contract."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.distributions.support import Support
from jaxlfi.envs.gaussian_linear import MIXING, NOISE
from jaxlfi.tasks.host import HostSimulator, SimulatorError
from jaxlfi.tasks.simulation import simulate_in_waves
from tests.small import gaussian


def numpy_simulate(rng, theta):
    """The Gaussian task in NumPy."""
    return theta @ MIXING.T + NOISE * rng.normal(size=theta.shape)


def hosted(simulate=numpy_simulate, **changes):
    """The Gaussian task with a simulator that JAX cannot trace."""
    return dataclasses.replace(gaussian(), simulate=HostSimulator(simulate), **changes)


class Counting:
    """A simulator that fails a fraction of the time and notes what it was asked for."""

    def __init__(self, failing=0.0):
        self.failing, self.calls = failing, []

    def __call__(self, rng, theta):
        self.calls.append(len(theta))
        return numpy_simulate(rng, theta), rng.uniform(size=len(theta)) >= self.failing


@pytest.mark.parametrize(("failing", "expected"), [(0.0, 100), (0.1, None), (0.6, 125), (1.0, 125)])
def test_simulations_stop_exactly_at_those_wanted_or_at_the_budget(failing, expected):
    simulator = Counting(failing)
    theta = gaussian().support("ok").sample(jax.random.key(1), 125)
    made = simulate_in_waves(jax.random.key(2), hosted(simulator), theta, 100, (2,))
    assert sum(simulator.calls) == int(made.attempted)
    assert int(made.succeeded) + int(made.failed(2).sum()) == int(made.attempted)
    if expected is None:
        assert int(made.succeeded) == 100 and 100 < int(made.attempted) <= 125
        assert simulator.calls[0] == 100 and len(simulator.calls) > 1
    else:
        assert int(made.attempted) == expected
    kept = np.asarray(made.kept)
    assert np.all(np.asarray(made.x)[kept] != 0)


def test_simulations_that_are_not_finite_fail_by_that_name():
    def simulate(rng, theta):
        x = numpy_simulate(rng, theta)
        x[::2] = np.nan
        return x

    theta = gaussian().support("ok").sample(jax.random.key(1), 40)
    made = simulate_in_waves(jax.random.key(2), hosted(simulate), theta, 40, (2,))
    assert made.failed(2).tolist() == [0, 20]


def test_one_simulation_has_the_signature_of_a_simulator_in_jax():
    theta = np.array([0.5, -0.5])
    trajectory, outcome = hosted().simulate(jax.random.key(3), theta)
    again, _ = hosted().simulate(jax.random.key(3), theta)
    other, _ = hosted().simulate(jax.random.key(4), theta)
    assert trajectory.shape == (2,) and outcome == 0
    np.testing.assert_array_equal(trajectory, again)
    assert not np.allclose(trajectory, other)
    failed, outcome = HostSimulator(lambda rng, theta: (theta, np.zeros(len(theta), bool)))(jax.random.key(0), theta)
    np.testing.assert_array_equal(failed, theta)
    assert outcome == 1


def test_parameters_reach_it_in_natural_units():
    seen = []

    def simulate(rng, theta):
        seen.append(theta)
        return theta

    box = Support([0.5, -3.0], [3.0, 3.0])
    task = hosted(simulate, supports={"ok": box}, feasible=box, log=("first",))
    inner = jnp.array([[0.0, 1.0], [1.0, 2.0]])
    simulate_in_waves(jax.random.key(0), task, inner, 2, (2,))
    np.testing.assert_allclose(np.concatenate(seen), [[1.0, 1.0], [np.e, 2.0]], rtol=1e-6)


def test_axes_of_length_one_are_added_or_dropped():
    column = HostSimulator(lambda rng, theta: theta[:, :, None])
    trajectories, _ = column.batch(jax.random.key(0), np.zeros((4, 3)), shape=(3,))
    assert trajectories.shape == (4, 3)
    flat = HostSimulator(lambda rng, theta: theta)
    trajectories, _ = flat.batch(jax.random.key(0), np.zeros((4, 3)), shape=(3, 1))
    assert trajectories.shape == (4, 3, 1)


@pytest.mark.parametrize(
    ("simulate", "message"),
    [
        (lambda rng, theta: theta[1:], r"expected numbers of shape \[4, 2\] for 4 parameter vectors, got .* \[3, 2\]"),
        (
            lambda rng, theta: theta[:, :1],
            r"expected numbers of shape \[4, 2\] for 4 .*, got float64 of shape \[4, 1\]",
        ),
        (lambda rng, theta: np.array([["a", "b"]] * 4), r"expected numbers .* got <U1"),
        (lambda rng, theta: [theta[0], theta[0, :1]], "ValueError"),
        (lambda rng, theta: (theta, np.ones(3, bool)), "expected an outcome for each of 4 simulations"),
        (lambda rng, theta: (theta, np.ones(4)), "expected an outcome for each of 4 simulations, got float64"),
        (lambda rng, theta: 1 / 0, "ZeroDivisionError: division by zero"),
    ],
)
def test_a_broken_contract_is_named(simulate, message):
    with pytest.raises(SimulatorError, match=f"^simulate: {message}"):
        HostSimulator(simulate).batch(jax.random.key(0), np.zeros((4, 2)), shape=(2,))


def test_it_is_not_traced():
    with pytest.raises(SimulatorError, match="host simulator, which cannot be traced"):
        jax.jit(hosted().simulate)(jax.random.key(0), np.zeros(2))
