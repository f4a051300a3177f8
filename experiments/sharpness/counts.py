"""Counts: regressions, and an epidemic with a reporting delay."""

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy import special

from experiments.sharpness.problem import Problem

GRID20, GRID30 = jnp.linspace(-1, 1, 20), jnp.linspace(0, 1, 30)
MOST_LOG_MEAN = 12.0
"""Largest logarithm of a mean: beyond it, counts would not fit into the numbers that hold them."""


def poisson_log_prob(count, mean):
    """Logarithm of P(count) of a Poisson distribution."""
    return special.xlogy(count, mean) - mean - special.gammaln(count + 1)


def _poisson_mean(theta):
    return jnp.exp(jnp.minimum(theta[0] + theta[1] * GRID20 + theta[2] * GRID20**2, MOST_LOG_MEAN))


def _poisson(key, theta):
    return jax.random.poisson(key, _poisson_mean(theta)).astype(jnp.float32)


def _poisson_likelihood(key, theta, x):
    return jnp.sum(poisson_log_prob(x, _poisson_mean(theta)))


def _overdispersed_mean(theta):
    return jnp.exp(jnp.minimum(theta[0] + theta[1] * GRID30, MOST_LOG_MEAN))


def _overdispersed(key, theta):
    """Poisson counts whose means vary by a gamma distribution."""
    key_mean, key_count = jax.random.split(key)
    mean = _overdispersed_mean(theta) * jax.random.gamma(key_mean, theta[2], (30,)) / theta[2]
    return jax.random.poisson(key_count, mean).astype(jnp.float32)


def _overdispersed_likelihood(key, theta, x):
    mean, size = _overdispersed_mean(theta), theta[2]
    log_prob = special.gammaln(x + size) - special.gammaln(size) - special.gammaln(x + 1)
    log_prob += size * jnp.log(size / (size + mean)) + special.xlogy(x, mean / (size + mean))
    return jnp.sum(log_prob)


DAYS, STEPS, PEOPLE, REPORTED = 40, 4, 10_000.0, 0.3
"""Days, steps per day and people of the epidemic, and the share of infections that is ever reported."""


def _reports(theta):
    """Expected reports per day of a deterministic SIR model; infections are reported after an exponential delay."""
    contact, recovery, delay = theta

    def step(state, _):
        healthy, ill, waiting = state
        infections = -jnp.expm1(-contact * ill / PEOPLE / STEPS) * healthy
        recoveries = -jnp.expm1(-recovery / STEPS) * ill
        reports = -jnp.expm1(-1 / (delay * STEPS)) * waiting
        return (healthy - infections, ill + infections - recoveries, waiting + infections - reports), reports

    start = (PEOPLE - 20.0, 20.0, 0.0)
    _, reports = lax.scan(step, start, length=DAYS * STEPS)
    return REPORTED * jnp.sum(reports.reshape(DAYS, STEPS), axis=1) + 0.1


def _epidemic(key, theta):
    return jax.random.poisson(key, _reports(theta)).astype(jnp.float32)


def _epidemic_likelihood(key, theta, x):
    return jnp.sum(poisson_log_prob(x, _reports(theta)))


PROBLEMS = (
    Problem(
        "poisson_regression", _poisson, ("level", "slope", "curvature"), ("", "", ""), (1.5, 1.0, -0.5),
        (-2.0, -3.0, -4.0), (4.0, 3.0, 3.0), log_likelihood=_poisson_likelihood,
    ),
    Problem(
        "negative_binomial", _overdispersed, ("level", "slope", "size"), ("", "", ""), (2.0, 1.0, 3.0),
        (-1.0, -3.0, 0.3), (4.0, 4.0, 30.0), log=("size",), log_likelihood=_overdispersed_likelihood,
    ),
    Problem(
        "epidemic", _epidemic, ("contact rate", "recovery rate", "delay"), ("1/d", "1/d", "d"), (0.6, 0.25, 5.0),
        (0.2, 0.05, 0.5), (2.0, 1.0, 20.0), log=("contact rate", "recovery rate", "delay"),
        log_likelihood=_epidemic_likelihood,
    ),
)  # fmt: skip
