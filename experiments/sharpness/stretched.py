"""Problems with long tails that were written down when the weight of tails had been chosen, to judge it.

An enzyme's rates at concentrations that are all too low to saturate it, a few waiting times, the decay of a source
counted for less than its lifetime, and exceedances of a threshold.
"""

import jax
import jax.numpy as jnp
from jax.scipy import stats

from experiments.sharpness.curves import gaussian
from experiments.sharpness.problem import Problem

CONCENTRATIONS = jnp.linspace(0.2, 3.0, 15)


def _unsaturated(theta):
    """Rates of an enzyme by the Michaelis-Menten law."""
    fastest, half = theta
    return fastest * CONCENTRATIONS / (half + CONCENTRATIONS)


WAITS = 12


def _waiting(key, theta):
    """Waiting times that follow a gamma distribution, in order of size."""
    mean, shape = theta
    return jnp.sort(mean / shape * jax.random.gamma(key, shape, (WAITS,)))


def _waiting_likelihood(key, theta, x):
    mean, shape = theta
    return jnp.sum(stats.gamma.logpdf(x, shape, scale=mean / shape))


INTERVALS = jnp.linspace(0.05, 1.95, 20)


def _source(key, theta):
    """Counts from a decaying source above a background."""
    rate, lifetime, background = theta
    counts = jax.random.poisson(key, rate * jnp.exp(-INTERVALS / lifetime) + background)
    return counts.astype(jnp.float32)


def _source_likelihood(key, theta, x):
    rate, lifetime, background = theta
    return jnp.sum(stats.poisson.logpmf(x, rate * jnp.exp(-INTERVALS / lifetime) + background))


EXCEEDANCES = 25


def _threshold(key, theta):
    """Exceedances of a threshold, which follow a generalised Pareto distribution."""
    scale, shape = theta
    uniform = jax.random.uniform(key, (EXCEEDANCES,), minval=1e-6)
    return scale * (uniform**-shape - 1) / shape


def _threshold_likelihood(key, theta, x):
    scale, shape = theta
    return -EXCEEDANCES * jnp.log(scale) - (1 / shape + 1) * jnp.sum(jnp.log1p(shape * x / scale))


PROBLEMS = (
    gaussian(
        _unsaturated,
        0.05,
        name="unsaturated",
        names=("fastest", "half"),
        units=("1/s", "mM"),
        truth=(3.0, 4.0),
        low=(0.5, 0.5),
        high=(15.0, 25.0),
        phi_low={"fastest": 0.1, "half": 0.1},
    ),
    Problem(
        name="waiting",
        simulate=_waiting,
        names=("mean", "shape"),
        units=("s", "1"),
        truth=(2.0, 3.0),
        low=(0.3, 0.3),
        high=(8.0, 20.0),
        phi_low={"mean": 0.1, "shape": 0.1},
        log_likelihood=_waiting_likelihood,
    ),
    Problem(
        name="source",
        simulate=_source,
        names=("rate", "lifetime", "background"),
        units=("1", "h", "1"),
        truth=(40.0, 2.0, 10.0),
        low=(5.0, 0.3, 0.5),
        high=(100.0, 12.0, 40.0),
        phi_low={"rate": 1.0, "lifetime": 0.1, "background": 0.1},
        log_likelihood=_source_likelihood,
    ),
    Problem(
        name="threshold",
        simulate=_threshold,
        names=("scale", "shape"),
        units=("m", "1"),
        truth=(1.0, 0.3),
        low=(0.2, 0.02),
        high=(5.0, 1.5),
        phi_low={"scale": 0.05, "shape": 0.01},
        log_likelihood=_threshold_likelihood,
    ),
)
