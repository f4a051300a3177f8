"""The same simulator in other units and with an offset: the same posterior, with every method and normaliser."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from scipy import stats

import jaxlfi
from jaxlfi.bayessim.presets import METHODS
from jaxlfi.diagnostics.resolution import resolution_warnings
from tests.small import settings, whole_runs  # noqa: F401 - a fixture

BOX = jaxlfi.Support([-3.0], [3.0])
READINGS = 5
EXACT = stats.norm(1.0, 0.2 / np.sqrt(READINGS))
"""The posterior of theta ~ U(-3, 3) if x_t = theta + 0.2 e_t is 1 five times; the bounds are twenty of its standard
deviations away."""
UNITS = [(1e-12, 0.0), (1e9, 0.0), (1e-4, 50.0), (0.1, 101_325.0), (1e-3, 1e9)]
"""Units and offsets. Single precision resolves 4e-6 near 50, 0.008 near 101,325 and 64 near 1e9."""


@dataclasses.dataclass
class Readings:
    """A simulator whose unit and offset are changed between runs, which share their compiled programs."""

    unit: float = 1.0
    offset: float = 0.0

    def __call__(self, rng, theta):
        return self.offset + self.unit * (theta + 0.2 * rng.normal(size=(len(theta), READINGS)))


SIMULATOR = Readings()


@functools.cache
def task():
    return jaxlfi.Task(jaxlfi.HostSimulator(SIMULATOR), names=("theta",), supports={"box": BOX}, feasible=BOX)


def inferred(method, unit, offset, **estimator):
    """Mean and standard deviation of the posterior."""
    SIMULATOR.unit, SIMULATOR.offset = unit, offset
    small = METHODS[method](settings(rounds=2, simulations_per_round=150, simulation_budget=150, predictive=False))
    fewer = {
        "epochs": 0,
        "steps": 150,
        "batch_size": 50,
        "patience": 0,
        "ensemble_size": 1,
        "hidden": (20,),
        **estimator,
    }
    small = small.replace(estimator=small.estimator.replace(learning_rate=5e-3, clip_norm=5.0, **fewer))
    observation = np.full(READINGS, offset + unit)
    run = jaxlfi.infer(jax.random.key(0), task(), observation, heuristic=jaxlfi.Fixed(), settings=small)
    np.testing.assert_allclose(run.x, observation, rtol=1e-15)
    kept = np.asarray(run.dataset.x)[: int(run.dataset.size)]
    assert np.abs((kept - offset) / unit).max() < 4.5  # as simulated: |theta| < 3, plus noise
    draws = np.asarray(run.posterior.sample(jax.random.key(1), 2000))
    return draws.mean(), draws.std()


@pytest.mark.parametrize(
    ("method", "normaliser"),
    [
        pytest.param("bayessim", "zscore", marks=pytest.mark.slow),
        ("bayessim", "asinh"),
        pytest.param("npe", "asinh", marks=pytest.mark.slow),
    ],
)
def test_the_posterior_does_not_depend_on_them(method, normaliser):
    changes = {"normaliser": normaliser} | ({"regression": 1} if method == "npe" else {"components": 1})
    mean, deviation = inferred(method, 1.0, 0.0, **changes)
    assert abs(mean - EXACT.mean()) < 0.25 and 0.4 < deviation / EXACT.std() < 5  # the prior's is 19 times as large
    for unit, offset in UNITS:
        other = inferred(method, unit, offset, **changes)
        assert abs(other[0] - mean) < 0.25, (unit, offset)  # training amplifies rounding
        assert 0.4 < other[1] / deviation < 2.5, (unit, offset)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["apt", "snle"])
def test_nor_by_the_other_methods(method):
    mean, deviation = inferred(method, 1.0, 0.0)
    for unit, offset in UNITS[2:]:
        other = inferred(method, unit, offset)
        assert abs(other[0] - mean) < 0.3 and 0.4 < other[1] / deviation < 2.5, (unit, offset)


def test_a_summary_that_single_precision_cannot_resolve_is_named():
    rng = np.random.default_rng(0)
    varying, lost = rng.normal(size=100), 1e8 + rng.normal(size=100)
    x = np.stack([varying, lost, np.zeros(100), np.full(100, 2.5)], axis=1)
    names = ["angle", "pressure", "nothing", "start"]
    (single,) = resolution_warnings(names, x.astype(np.float32))
    assert single.startswith("summary pressure is 1e+08, start is 2.5 in all simulations") and "float32" in single
    (double,) = resolution_warnings(names, x)
    assert double.startswith("summary start is 2.5 in all simulations") and "float" not in double
    assert resolution_warnings(names[:1], x[:, :1]) == [] == resolution_warnings(names, x[:1])
