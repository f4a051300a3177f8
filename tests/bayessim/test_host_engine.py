"""Runs of host simulators: the same posterior, all simulations recorded, and contracts enforced."""

import dataclasses
import re

import jax
import numpy as np
import pytest

import jaxlfi
from jaxlfi.bayessim.host import HostEngine
from jaxlfi.envs.gaussian_linear import posterior
from jaxlfi.tasks.host import HostSimulator, SimulatorError
from tests.small import FLAGS, SETTINGS, command, gaussian, read_ledger, settings, whole_runs  # noqa: F401 - a fixture
from tests.tasks.test_host import Counting, numpy_simulate

OBSERVED = np.array([0.8, -0.6], np.float32)


class Replaceable:
    """A stand-in for each test's simulator: all tests have one task, whose programs are compiled once."""

    simulate = staticmethod(numpy_simulate)

    def __call__(self, rng, theta):
        return self.simulate(rng, theta)


SIMULATOR = Replaceable()


def task(**changes):
    """The Gaussian task with a simulator that JAX cannot trace."""
    return dataclasses.replace(gaussian(), simulate=HostSimulator(SIMULATOR), **changes)


REFERENCE = "tests.bayessim.test_host_engine:task"


@pytest.mark.slow
def test_the_posterior_is_the_exact_one():
    estimator = SETTINGS.estimator.replace(steps=1500, batch_size=100, learning_rate=1e-2, components=1)
    enough = settings(simulations_per_round=300, simulation_budget=300, estimator=estimator)
    unknown = task(truth=None)
    run = jaxlfi.infer(jax.random.key(3), unknown, OBSERVED, support="ok", heuristic=jaxlfi.Edge(), settings=enough)
    exact = posterior(OBSERVED)
    deviation = np.sqrt(np.diag(exact.covariance))
    assert np.all(np.abs(run.mixture.mean - exact.mean) < 0.6 * deviation)
    np.testing.assert_allclose(np.sqrt(np.diag(run.mixture.covariance)), deviation, rtol=0.4)


@pytest.mark.slow
def test_it_is_deterministic_and_leaves_the_same_files(tmp_path):
    arguments = ["infer", REFERENCE, "--support", "misspecified"]
    for name in ("a", "b"):
        assert command(*arguments, *FLAGS, "--out", tmp_path / name) == 0
    assert (tmp_path / "a" / "posterior.npz").read_bytes() == (tmp_path / "b" / "posterior.npz").read_bytes()
    assert {p.name for p in (tmp_path / "a").iterdir()} == {
        *("config.json", "ledger.jsonl", "posterior.npz", "dataset.npz", "history.npz", "observation.npz"),
        *("summary.json", "checkpoint"),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("flags", "simulated"), [((), 20), pytest.param(("--no-predictive",), 0, marks=pytest.mark.slow)]
)
def test_every_simulation_is_in_the_ledger(tmp_path, monkeypatch, flags, simulated):
    """The simulator fails one time in ten and records its requests."""
    counting = Counting(0.1)
    monkeypatch.setattr(SIMULATOR, "simulate", counting)
    np.savez(tmp_path / "observed.npz", trajectory=OBSERVED)
    arguments = ("infer", REFERENCE, "--observation", tmp_path / "observed.npz", "--support", "ok", *FLAGS, *flags)
    assert command(*arguments, "--out", tmp_path / "run") == 0
    ledger = read_ledger(tmp_path / "run")
    assert [line["predictive_simulations"] for line in ledger] == [simulated] * 2
    assert all(line["attempted"] == line["succeeded"] + sum(line["failed"].values()) for line in ledger)
    assert sum(counting.calls) == sum(line["attempted"] + line["predictive_simulations"] for line in ledger)
    assert sum(line["failed"]["failed"] for line in ledger) > 0  # otherwise the counts of failures would not be tested


@pytest.mark.parametrize(
    ("simulate", "message"),
    [
        (lambda rng, theta: numpy_simulate(rng, theta)[1:], r"expected numbers of shape \[20, 2\]"),
        (lambda rng, theta: (numpy_simulate(rng, theta), np.ones(3, bool)), "expected an outcome for each of 20"),
        (lambda rng, theta: (theta, np.zeros(len(theta), bool)), r"got none \(failed: 25, non_finite: 0\)$"),
        (lambda rng, theta: 1 / 0, "ZeroDivisionError"),
    ],
)
def test_a_broken_contract_ends_the_run_in_one_line(simulate, message, monkeypatch):
    monkeypatch.setattr(SIMULATOR, "simulate", simulate)
    with pytest.raises(SimulatorError, match=message) as refused:
        jaxlfi.infer(jax.random.key(0), task(), OBSERVED, heuristic=jaxlfi.Edge(), settings=SETTINGS)
    assert "\n" not in str(refused.value)


def test_a_simulator_that_does_not_work_ends_the_run_before_anything_is_compiled(monkeypatch):
    def fail(rng, theta):
        raise ValueError("no mesh")

    monkeypatch.setattr(HostEngine, "compile", lambda *_: pytest.fail("compiled"))
    one_by_one = dataclasses.replace(gaussian(), simulate=HostSimulator(fail, each=True))
    with pytest.raises(SimulatorError, match=r"expected some valid simulations in the first round.*no mesh"):
        jaxlfi.infer(jax.random.key(3), one_by_one, OBSERVED, support="ok", settings=SETTINGS)


def test_it_cannot_be_vmapped():
    keys = jax.random.split(jax.random.key(0), 2)
    with pytest.raises(ValueError, match=re.escape("infer: expected concrete arguments for a host simulator")):
        jax.vmap(lambda key: jaxlfi.infer(key, task(), OBSERVED, settings=SETTINGS))(keys)
