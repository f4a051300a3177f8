"""Widths by the default call on two small problems of raw series, beside posteriors on a grid.

The quick suite has widths of the parts: `estimators/test_regression.py` of the default networks, `bayessim/`
of inflated proposals, of corrections, and of posteriors at a bound.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlfi
from tests.small import whole_runs  # noqa: F401 - a fixture

pytestmark = pytest.mark.slow
RUNS, DRAWS, NOISE = 4, 2000, 0.05
SIMULATIONS = 1000
TIMES = np.linspace(0.25, 10.0, 40, dtype=np.float32)


def spring(theta, module=jnp):
    """A released mass on a damped spring: stiffness and damping, for unit mass."""
    stiffness, damping = theta[..., 0, None], theta[..., 1, None]
    return module.exp(-0.5 * damping * TIMES) * module.cos(module.sqrt(stiffness - 0.25 * damping**2) * TIMES)


def noisy_spring(key, theta):
    return spring(theta) + NOISE * jax.random.normal(key, TIMES.shape)


def spring_log_likelihood(theta, x):
    return -0.5 * np.sum((spring(theta, np) - x) ** 2, axis=-1) / NOISE**2


def autoregression(key, theta):
    """A stationary AR(1) series of 60 numbers: its coefficient, and the scale of its innovations."""
    coefficient, scale = theta
    noise = scale * jax.random.normal(key, (60,))
    first = noise[0] / jnp.sqrt(1 - coefficient**2)
    _, rest = jax.lax.scan(lambda x, e: (coefficient * x + e,) * 2, first, noise[1:])
    return jnp.concatenate([first[None], rest])


def autoregression_log_likelihood(theta, x):
    coefficient, scale = theta[..., 0], theta[..., 1]
    squares = (1 - coefficient**2) * x[0] ** 2 + np.sum((x[1:] - coefficient[:, None] * x[:-1]) ** 2, axis=-1)
    return -len(x) * np.log(scale) + 0.5 * np.log(1 - coefficient**2) - 0.5 * squares / scale**2


PROBLEMS = {
    "spring": (noisy_spring, spring_log_likelihood, ("stiffness", "damping"), ([1, 0.1], [4, 0.8]), (2.3, 0.3)),
    "autoregression": (autoregression, autoregression_log_likelihood, ("a", "scale"), ([0, 0.3], [0.9, 2]), (0.6, 1)),
}


def on_a_grid(log_likelihood, low, high, x, points: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the posterior under the uniform prior on the box."""
    axes = [np.linspace(a, b, points) for a, b in zip(low, high, strict=True)]
    theta = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    value = log_likelihood(theta, x)
    weight = np.exp(value - value.max())
    weight /= weight.sum()
    mean = weight @ theta
    return mean, np.sqrt(weight @ (theta - mean) ** 2)


@pytest.mark.parametrize("name", PROBLEMS)
def test_posteriors_are_as_wide_as_exact_ones(name):
    rounds = 10  # as by default
    number = SIMULATIONS // rounds
    settings = jaxlfi.QUICK.replace(
        rounds=rounds,
        min_rounds=0,
        simulations_per_round=number,
        simulation_budget=number + number // 4,
        predictive=False,
    )
    simulate, log_likelihood, names, (low, high), truth = PROBLEMS[name]
    box = jaxlfi.Support(low, high)
    task = jaxlfi.Task(simulate, names=names, supports={"guess": box}, feasible=box)
    keys = jax.random.split(jax.random.key(8), (3, RUNS))
    observed = jax.vmap(simulate, (0, None))(keys[0], jnp.asarray(truth, jnp.float32))

    @jax.jit
    @jax.vmap
    def inferred(key_run, key_draws, x):
        run = jaxlfi.infer(key_run, task, x, heuristic=jaxlfi.Fixed(), settings=settings)
        return run.posterior.sample(key_draws, DRAWS)

    draws = np.asarray(inferred(keys[1], keys[2], observed), np.float64)
    exact = np.array([on_a_grid(log_likelihood, low, high, np.asarray(x, np.float64)) for x in observed])
    ratio = np.exp(np.mean(np.log(draws.std(axis=1) / exact[:, 1])))
    off = np.mean(np.abs(draws.mean(axis=1) - exact[:, 0]) / exact[:, 1])
    assert 0.7 < ratio < 1.4 and off < 0.6
