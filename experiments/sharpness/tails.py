"""Problems with long tails that were written down when the treatment of tails had been chosen, to judge it.

Right-censored lifetimes, readings with Student's t errors of unknown degrees of freedom, and a Gaussian field whose
correlation length is a large part of the line along which it is measured.
"""

import jax
import jax.numpy as jnp
from jax.scipy import stats

from experiments.sharpness.problem import Problem

ITEMS, END = 30, 1.0


def _censored(key, theta):
    """Times at which items fail, by a Weibull law, or the end of the test."""
    life, shape = theta
    times = life * jax.random.exponential(key, (ITEMS,)) ** (1 / shape)
    return jnp.sort(jnp.minimum(times, END))


def _censored_likelihood(key, theta, x):
    life, shape = theta
    failed, scaled = x < END, x / life
    density = jnp.log(shape / life) + (shape - 1) * jnp.log(scaled)
    return jnp.sum(jnp.where(failed, density, 0.0) - scaled**shape)


READINGS = 60


def _freedom(key, theta):
    """Readings whose errors follow Student's t."""
    freedom, spread = theta
    return spread * jax.random.t(key, freedom, (READINGS,))


def _freedom_likelihood(key, theta, x):
    freedom, spread = theta
    return jnp.sum(stats.t.logpdf(x, freedom, 0.0, spread))


PLACES, NUGGET = jnp.linspace(0.0, 10.0, 40), 0.2


def _factor(theta):
    length, spread = theta
    distance = jnp.abs(PLACES[:, None] - PLACES)
    return jnp.linalg.cholesky(spread**2 * jnp.exp(-distance / length) + NUGGET**2 * jnp.eye(len(PLACES)))


def _field(key, theta):
    """A Gaussian field with exponential correlations, read with an error."""
    return _factor(theta) @ jax.random.normal(key, PLACES.shape)


def _field_likelihood(key, theta, x):
    factor = _factor(theta)
    whitened = jax.scipy.linalg.solve_triangular(factor, x, lower=True)
    return -0.5 * jnp.sum(whitened**2) - jnp.sum(jnp.log(jnp.diagonal(factor)))


PROBLEMS = (
    Problem(
        name="censored",
        simulate=_censored,
        names=("life", "shape"),
        units=("h", "1"),
        truth=(2.0, 1.5),
        low=(0.5, 0.4),
        high=(8.0, 4.0),
        phi_low={"life": 0.2, "shape": 0.2},
        log_likelihood=_censored_likelihood,
    ),
    Problem(
        name="freedom",
        simulate=_freedom,
        names=("freedom", "spread"),
        units=("1", "m"),
        truth=(4.0, 1.0),
        low=(1.2, 0.3),
        high=(20.0, 3.0),
        phi_low={"freedom": 0.8, "spread": 0.1},
        log_likelihood=_freedom_likelihood,
    ),
    Problem(
        name="field",
        simulate=_field,
        names=("length", "spread"),
        units=("m", "K"),
        truth=(2.0, 1.0),
        low=(0.3, 0.3),
        high=(15.0, 4.0),
        phi_low={"length": 0.1, "spread": 0.1},
        log_likelihood=_field_likelihood,
    ),
)
