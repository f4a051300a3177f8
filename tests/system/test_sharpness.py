"""Posteriors of raw series by the default call, about as wide as the exact ones on a grid.

A small part of `experiments.sharpness`. At the settings of before, widths were 3 to 8 times the exact ones here.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlfi
from jaxlfi.bayessim.presets import QUICK
from jaxlfi.heuristics import Fixed

SEEDS = 3
TIMES = jnp.linspace(0, 4, 40)


def spring(key, theta):
    """A damped oscillation from rest, of stiffness and damping, with noise."""
    return _oscillation(theta) + 0.05 * jax.random.normal(key, TIMES.shape)


def _oscillation(theta):
    stiffness, damping = theta
    frequency = jnp.sqrt(jnp.maximum(stiffness - damping**2 / 4, 1e-3))
    return jnp.exp(-damping * TIMES / 2) * jnp.cos(frequency * TIMES)


def spring_log_likelihood(theta, x):
    """Of Gaussian noise."""
    return -0.5 * jnp.sum(((_oscillation(theta) - x) / 0.05) ** 2)


def memory(key, theta):
    """A stationary autoregressive series of the first order, by its coefficient and the deviation of its noise."""
    coefficient, deviation = theta
    noise = deviation * jax.random.normal(key, (60,))
    first = noise[0] / jnp.sqrt(1 - coefficient**2)
    one = lambda value, z: (coefficient * value + z, coefficient * value + z)
    return jnp.concatenate([first[None], jax.lax.scan(one, first, noise[1:])[1]])


def memory_log_likelihood(theta, x):
    """Of each number given the one before."""
    coefficient, deviation = theta
    first = deviation / jnp.sqrt(1 - coefficient**2)
    rest = (x[1:] - coefficient * x[:-1]) / deviation
    return -0.5 * (x[0] / first) ** 2 - jnp.log(first) - 0.5 * jnp.sum(rest**2) - 59 * jnp.log(deviation)


PROBLEMS = {
    "memory": (memory, memory_log_likelihood, [-0.95, 0.2], [0.95, 5.0], (False, True), [0.6, 1.0]),
    "spring": (spring, spring_log_likelihood, [1.0, 0.05], [40.0, 2.0], (True, True), [12.0, 0.4]),
}


def exact(log_likelihood, low, high, log, x):
    """Mean and standard deviation in inference space, on a grid that is refined once."""
    inner = lambda values: np.where(log, np.log(np.where(log, values, 1.0)), values)
    low, high = inner(np.array(low)), inner(np.array(high))
    height = jax.jit(jax.vmap(lambda theta: log_likelihood(jnp.where(jnp.array(log), jnp.exp(theta), theta), x)))
    for _ in range(2):
        axes = [np.linspace(low[d], high[d], 500) for d in range(2)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        log_p = np.asarray(height(grid), float)
        p = np.exp(log_p - log_p.max())
        p /= p.sum()
        mean = p @ grid
        deviation = np.sqrt(p @ (grid - mean) ** 2)
        low, high = np.maximum(low, mean - 8 * deviation), np.minimum(high, mean + 8 * deviation)
    return mean, deviation


@pytest.mark.parametrize("name", ["memory", pytest.param("spring", marks=pytest.mark.slow)])
def test_raw_series_have_posteriors_as_wide_as_exact_ones(name):
    simulate, log_likelihood, low, high, log, truth = PROBLEMS[name]
    box = jaxlfi.Support(low, high)
    names = ("first", "second")
    task = jaxlfi.Task(
        simulate, names=names, log=tuple(n for n, is_log in zip(names, log, strict=True) if is_log),
        supports={"box": box}, feasible=box, truth=truth,
    )  # fmt: skip
    settings = QUICK.replace(rounds=10, min_rounds=0, predictive=False)
    observed = jnp.stack([simulate(jax.random.key(500 + i), jnp.array(truth)) for i in range(SEEDS)])
    infer = lambda key, x: jaxlfi.infer(key, task, x, support="box", heuristic=Fixed(), settings=settings).belief
    with jax.debug_key_reuse(False):
        beliefs = jax.jit(jax.vmap(infer))(jax.random.split(jax.random.key(1), SEEDS), observed)
    found = jax.vmap(lambda mixture: (mixture.mean, mixture.covariance))(beliefs.mixture)
    means, deviations = np.asarray(found[0]), np.sqrt(np.asarray(found[1]).diagonal(axis1=1, axis2=2))
    mean, deviation = map(np.stack, zip(*(exact(log_likelihood, low, high, log, x) for x in observed), strict=True))
    ratio = np.exp(np.log(deviations / deviation).mean(axis=0))
    assert (ratio > 0.65).all() and (ratio < 1.6).all(), ratio
    assert (np.abs(means - mean) / deviation).mean() < 0.7
