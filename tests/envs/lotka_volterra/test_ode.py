"""The Lotka-Volterra equations against scipy and a conserved quantity, and their noise."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.integrate import solve_ivp

from jaxlfi.envs.lotka_volterra.jump_process import lotka_volterra_nine
from jaxlfi.envs.lotka_volterra.ode import NOISES, gaussian_noise, lognormal_noise, populations, task
from jaxlfi.registry import TASKS
from jaxlfi.tasks.simulation import simulate

RATES = [(0.01, 0.1, 0.1, 0.02), (0.03, 0.15, 0.12, 0.011), (0.004, 0.31, 0.22, 0.006)]
"""Unlike in all four, so that two that are swapped would show."""
START = np.array([9.0, 40.0])
solve = jax.jit(functools.partial(populations, interval=0.5, records=121, substeps=10))


def oracle(rates, start=START, duration=60.0, records=121):
    birth, death, prey_birth, prey_death = rates
    slope = lambda t, s: [birth * s[0] * s[1] - death * s[0], prey_birth * s[1] - prey_death * s[0] * s[1]]
    times = np.linspace(0, duration, records)
    return solve_ivp(slope, (0, duration), start, t_eval=times, rtol=1e-8, atol=1e-10).y.T


@pytest.mark.parametrize("rates", RATES)
def test_populations_against_scipy(rates):
    expected = oracle(rates)
    got = np.asarray(solve(jnp.array(rates), jnp.asarray(START, jnp.float32)))
    assert got.shape == (121, 2)
    np.testing.assert_allclose(got[0], START, rtol=1e-6)
    np.testing.assert_allclose(got, expected, rtol=2e-3, atol=2e-3)
    assert np.ptp(expected[:, 0]) > 5  # there is something to see


@pytest.mark.parametrize("rates", RATES)
def test_a_quantity_is_conserved(rates):
    """V = theta_1 Y - theta_2 ln Y + theta_4 X - theta_3 ln X has dV/dt = 0.

    (theta_1 - theta_2 / Y) Y (theta_3 - theta_4 X) + (theta_4 - theta_3 / X) X (theta_1 Y - theta_2) = 0.
    """
    birth, death, prey_birth, prey_death = rates
    x, y = np.asarray(solve(jnp.array(rates), jnp.asarray(START, jnp.float32)), np.float64).T
    value = birth * y - death * np.log(y) + prey_death * x - prey_birth * np.log(x)
    np.testing.assert_allclose(value, value[0], atol=2e-5)
    wrong = birth * y - prey_birth * np.log(y) + prey_death * x - death * np.log(x)
    assert rates[1] == rates[2] or np.ptp(wrong) > 1e-3


def test_equilibrium_stays():
    """X = theta_3 / theta_4 and Y = theta_2 / theta_1."""
    rates = np.array(RATES[1])
    start = np.array([rates[2] / rates[3], rates[1] / rates[0]])
    got = solve(jnp.asarray(rates, jnp.float32), jnp.asarray(start, jnp.float32))
    np.testing.assert_allclose(got, np.broadcast_to(start, got.shape), rtol=1e-4)


def test_the_tasks_own_step_is_fine_enough():
    """Two steps in a tenth of a time unit, for 200 of them, at the rates of the tutorial."""
    expected = oracle(RATES[0], duration=200.0, records=2001)
    got = jax.jit(functools.partial(populations, interval=0.1, records=2001, substeps=2))(
        jnp.array(RATES[0]), jnp.asarray(START, jnp.float32)
    )
    np.testing.assert_allclose(got, expected, rtol=5e-3, atol=5e-3)


# ---------------------------------------------------------------------------------------------------- noise

CLEAN = jnp.array([[3.0, 50.0]]) * jnp.ones((4000, 1))


def test_gaussian_noise(key):
    off = np.asarray(gaussian_noise(key, CLEAN) - CLEAN)
    for column in off.T:
        assert stats.kstest(column, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(off.T)[0, 1]) < 5 / np.sqrt(4000)


def test_gaussian_noise_of_another_scale(key):
    off = np.asarray(gaussian_noise(key, CLEAN, 3.0) - CLEAN)
    np.testing.assert_allclose(off.std(0), 3.0, rtol=5 / np.sqrt(2 * 4000))


@pytest.mark.parametrize("scale", [0.25, np.array([0.1, 0.6])])
def test_lognormal_noise(scale, key):
    off = np.log(np.asarray(lognormal_noise(key, CLEAN, jnp.asarray(scale)) / CLEAN))
    for column, sd in zip(off.T, np.broadcast_to(scale, 2), strict=True):
        assert stats.kstest(column / sd, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(off.T)[0, 1]) < 5 / np.sqrt(4000)


def test_noises_by_name():
    assert {"gaussian": gaussian_noise, "lognormal": lognormal_noise} == NOISES
    with pytest.raises(ValueError, match=r"^noise: expected one of \['gaussian', 'lognormal'\], got 'pink'"):
        task("pink")


# ----------------------------------------------------------------------------------------------------- task


@pytest.mark.parametrize("noise", NOISES)
def test_the_task_is_the_solution_seen_through_its_noise(noise, key):
    problem = task(noise, duration=60.0, interval=0.5)
    got = np.asarray(jax.jit(problem.simulate)(key, jnp.asarray(problem.truth)))
    assert got.shape == (121, 2) == (len(problem.times), len(problem.channels))
    expected = oracle(RATES[0])
    if noise == "gaussian":
        off = (got - expected).ravel()
        assert abs(off.std() - 1) < 5 / np.sqrt(2 * off.size) and np.abs(off).max() < 5
    else:
        off = np.log(got / expected).ravel()
        assert abs(off.std() - 0.25) < 5 * 0.25 / np.sqrt(2 * off.size)
    np.testing.assert_allclose(problem.times[[0, 1, -1]], [0.0, 0.5, 60.0])


def test_the_task_is_appendix_a():
    problem = task()
    np.testing.assert_allclose(problem.truth, [0.01, 0.1, 0.1, 0.02], rtol=1e-6)
    assert problem.summary is lotka_volterra_nine and problem.dim == 4 and len(problem.times) == 2001
    assert bool(problem.support("ok").contains(problem.truth))
    assert not bool(problem.support("misspecified").contains(problem.truth))
    for box in problem.supports.values():
        assert bool(problem.feasible.contains(box.low)) and bool(problem.feasible.contains(box.high))


def test_the_appendix_to_the_letter_is_its_first_tenth(key):
    """200 steps of 0.1; everything else is the same."""
    problem, whole = TASKS.load("jaxlfi.envs.lotka_volterra.ode:short"), task()
    np.testing.assert_allclose(problem.times, whole.times[:201], atol=1e-6)
    assert problem.times[-1] == 20.0 and problem.name == "lotka_volterra_ode_short"
    again = jax.random.clone(key)
    trajectory = problem.simulate(key, problem.truth)
    assert trajectory.shape == (201, 2)
    off = np.asarray(trajectory) - oracle(RATES[0], duration=20.0, records=201)
    assert abs(off.std() - 1) < 5 / np.sqrt(2 * off.size)
    for name, box in whole.supports.items():
        np.testing.assert_array_equal(problem.support(name).low, box.low)
        np.testing.assert_array_equal(problem.support(name).high, box.high)
    np.testing.assert_array_equal(problem.truth, whole.truth)
    positive = np.asarray(TASKS.load("jaxlfi.envs.lotka_volterra.ode:short").simulate(again, problem.truth))
    np.testing.assert_array_equal(positive, trajectory)


def test_summaries_are_named_in_their_order():
    """A trajectory whose nine statistics are all unlike."""
    rng = np.random.default_rng(0)
    x, y = rng.normal(5, 2, 400).cumsum() / 30, rng.normal(40, 9, 400)
    got = dict(zip(task().summary_names, np.asarray(lotka_volterra_nine(jnp.stack([x, y], 1))), strict=True))
    lag = lambda series, k: np.corrcoef(series[k:], series[:-k])[0, 1]
    expected = {"mean X": x.mean(), "mean Y": y.mean()}
    expected |= {"log var X": np.log(x.var(ddof=1) + 1), "log var Y": np.log(y.var(ddof=1) + 1)}
    expected |= {f"{name} lag {k}": lag(series, k) for name, series in {"X": x, "Y": y}.items() for k in (1, 2)}
    expected |= {"X with Y": np.corrcoef(x, y)[0, 1]}
    assert list(got) == list(expected)
    for name, value in expected.items():
        assert got[name] == pytest.approx(value, abs=0.02), name


def test_rates_too_fast_for_the_step_count_as_failures(key):
    problem = task(duration=60.0, interval=0.5)
    theta = jnp.array([[0.01, 0.1, 0.1, 0.02], [9.0, 0.1, 50.0, 0.001]])
    x, failure = jax.jit(lambda k, t: simulate(k, problem, t))(key, theta)
    np.testing.assert_array_equal(failure, [0, len(problem.reasons)])
    assert bool(jnp.isfinite(x).all()) and x.shape == (2, 9)
