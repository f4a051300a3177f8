"""Black boxes: nothing simulated that is not needed, the same posterior, and contracts enforced."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxlfi
from envs.gaussian_linear import MIXING, NOISE, posterior
from jaxlfi.bayessim.host import simulate_within_budget
from jaxlfi.heuristics import Edge, Fixed
from jaxlfi.tasks.observation import SimulatorError
from tests.small import SETTINGS, command, gaussian, whole_runs  # noqa: F401 - a fixture

OBSERVED = np.array([0.8, -0.6], np.float32)


def numpy_simulate(rng, theta):
    """The Gaussian task in NumPy."""
    return theta @ MIXING.T + NOISE * rng.normal(size=theta.shape)


def boxed(simulate=numpy_simulate, **changes):
    """The Gaussian task as a black box."""
    return dataclasses.replace(
        gaussian(), simulate=simulate, black_box=True, summary=lambda trajectory: trajectory, **changes
    )


def task():
    """For the command line."""
    return boxed()


def wrong_shape():
    """Gives one trajectory too few."""
    return boxed(lambda rng, theta: numpy_simulate(rng, theta)[1:], truth=None, observation=OBSERVED)


def failing():
    """Never succeeds."""
    return boxed(
        lambda rng, theta: (numpy_simulate(rng, theta), np.zeros(len(theta), bool)),
        truth=None,
        observation=OBSERVED,
    )


class Counting:
    """A simulator that fails a share of the time and notes what it was asked for."""

    def __init__(self, failing_share):
        self.share, self.calls = failing_share, []

    def __call__(self, rng, theta):
        self.calls.append(len(theta))
        return numpy_simulate(rng, theta), rng.uniform(size=len(theta)) >= self.share


@pytest.mark.parametrize(("share", "expected"), [(0.0, 100), (0.1, None), (0.6, 125), (1.0, 125)])
def test_attempts_stop_exactly_at_the_additions_or_the_budget(share, expected):
    simulator = Counting(share)
    theta = gaussian().support("ok").sample(jax.random.key(1), 125)
    attempts = simulate_within_budget(boxed(simulator), jax.random.key(2), theta, 100, (2,))
    assert sum(simulator.calls) == int(attempts.attempted)
    assert int(attempts.succeeded) + int(attempts.failed(2).sum()) == int(attempts.attempted)
    if expected is None:
        assert int(attempts.succeeded) == 100 and 100 < int(attempts.attempted) <= 125
        assert simulator.calls[0] == 100 and len(simulator.calls) > 1
    else:
        assert int(attempts.attempted) == expected
    kept = np.asarray(attempts.kept)
    assert np.all(np.asarray(attempts.x)[kept] != 0)


def test_simulations_that_are_not_finite_fail_by_that_name():
    def simulate(rng, theta):
        x = numpy_simulate(rng, theta)
        x[::2] = np.nan
        return x

    theta = gaussian().support("ok").sample(jax.random.key(1), 40)
    attempts = simulate_within_budget(boxed(simulate), jax.random.key(2), theta, 40, (2,))
    assert attempts.failed(2).tolist() == [0, 20]


def test_the_posterior_is_the_exact_one():
    settings = dataclasses.replace(
        SETTINGS,
        simulations_per_round=300,
        simulation_budget=300,
        estimator=dataclasses.replace(SETTINGS.estimator, steps=1500, batch_size=100, learning_rate=1e-2, components=1),
    )
    run = jaxlfi.infer(jax.random.key(3), boxed(), OBSERVED, support="ok", heuristic=Edge(), settings=settings)
    exact = posterior(OBSERVED)
    spread = np.sqrt(np.diag(exact.covariance))
    assert np.all(np.abs(run.mixture.mean - exact.mean) < 0.6 * spread)
    np.testing.assert_allclose(np.sqrt(np.diag(run.mixture.covariance)), spread, rtol=0.4)


def test_it_is_deterministic_and_leaves_the_same_files(tmp_path):
    arguments = ["infer", "tests.test_black_box:task", "--support", "misspecified"]
    from tests.small import FLAGS

    for name in ("a", "b"):
        assert command(*arguments, *FLAGS, "--out", tmp_path / name) == 0
    assert (tmp_path / "a" / "posterior.npz").read_bytes() == (tmp_path / "b" / "posterior.npz").read_bytes()
    assert {p.name for p in (tmp_path / "a").iterdir()} == {
        "config.json", "ledger.jsonl", "posterior.npz", "dataset.npz", "history.npz", "observation.npz",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("simulate", "message"),
    [
        (lambda rng, theta: numpy_simulate(rng, theta)[1:], r"expected numbers of shape \[20, 2\]"),
        (lambda rng, theta: numpy_simulate(rng, theta)[:, :1], r"got float64 of shape \[20, 1\]"),
        (lambda rng, theta: (numpy_simulate(rng, theta), np.ones(3, bool)), "expected an outcome for each of 20"),
        (lambda rng, theta: (numpy_simulate(rng, theta), np.zeros(len(theta), bool)), r"got none \(failed: 25, non_finite: 0\)"),  # noqa: E501
        (lambda rng, theta: 1 / 0, "ZeroDivisionError"),
    ],
)  # fmt: skip
def test_a_broken_contract_is_told(simulate, message):
    with pytest.raises(SimulatorError, match=message):
        jaxlfi.infer(jax.random.key(0), boxed(simulate), OBSERVED, heuristic=Fixed(), settings=SETTINGS)


def test_it_cannot_be_vmapped():
    with pytest.raises(ValueError, match="black box"):
        jax.vmap(lambda key: jaxlfi.infer(key, boxed(), OBSERVED, settings=SETTINGS))(
            jax.random.split(jax.random.key(0), 2)
        )
