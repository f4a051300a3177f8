"""Problems whose posteriors have a long tail to one side, to choose how tails are treated.

The spread of few groups, a step response that ends long before it settles, the number of animals of which an unknown
share is seen, and the correlation time of a signal that is recorded for a few such times.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy import stats

from experiments.sharpness.curves import gaussian
from experiments.sharpness.problem import Problem

GROUPS, ERROR = 10, 0.5


def _groups(key, theta):
    """Means of a few groups, each known with an error."""
    mean, spread = theta
    return mean + jnp.sqrt(spread**2 + ERROR**2) * jax.random.normal(key, (GROUPS,))


def _groups_likelihood(key, theta, x):
    mean, spread = theta
    return jnp.sum(stats.norm.logpdf(x, mean, jnp.sqrt(spread**2 + ERROR**2)))


EARLY = jnp.linspace(0.1, 2.0, 20)


def _settling(theta):
    """A step response of which only the beginning is seen."""
    gain, time = theta
    return gain * (1 - jnp.exp(-EARLY / time))


VISITS = 12


def _animals(key, theta):
    """Counts on several visits, of a population of which each animal is seen with the same probability."""
    number, seen = theta
    draws = jax.random.binomial(key, jnp.round(number), seen, (VISITS,))
    return draws.astype(jnp.float32)


def _animals_likelihood(key, theta, x):
    number, seen = jnp.round(theta[0]), theta[1]
    choose = lambda n, k: lax.lgamma(n + 1) - lax.lgamma(k + 1) - lax.lgamma(jnp.maximum(n - k, 0.0) + 1)
    logs = choose(number, x) + x * jnp.log(seen) + (number - x) * jnp.log1p(-seen)
    return jnp.where(jnp.all(x <= number), jnp.sum(logs), -jnp.inf)


def _correlated(length):
    """A stationary signal with exponential correlations, recorded for a few of its correlation times."""

    def simulate(key, theta):
        time, spread = theta
        share = jnp.exp(-1.0 / time)
        normal = spread * jax.random.normal(key, (length,))
        follow = lambda value, kick: ((now := share * value + jnp.sqrt(1 - share**2) * kick), now)
        return jnp.concatenate([normal[:1], lax.scan(follow, normal[0], normal[1:])[1]])

    return simulate


def _correlation_likelihood(key, theta, x):
    time, spread = theta
    share = jnp.exp(-1.0 / time)
    first = stats.norm.logpdf(x[0], 0.0, spread)
    return first + jnp.sum(stats.norm.logpdf(x[1:], share * x[:-1], spread * jnp.sqrt(1 - share**2)))


PROBLEMS = (
    Problem(
        name="groups",
        simulate=_groups,
        names=("mean", "spread"),
        units=("m", "m"),
        truth=(1.5, 1.2),
        low=(-2.0, 0.1),
        high=(5.0, 5.0),
        phi_low={"spread": 0.01},
        log_likelihood=_groups_likelihood,
    ),
    gaussian(
        _settling,
        0.02,
        name="settling",
        names=("gain", "time"),
        units=("V", "s"),
        truth=(3.0, 4.0),
        low=(0.5, 0.5),
        high=(10.0, 15.0),
        phi_low={"gain": 0.1, "time": 0.1},
    ),
    Problem(
        name="animals",
        simulate=_animals,
        names=("number", "seen"),
        units=("1", "1"),
        truth=(80.0, 0.4),
        low=(40.0, 0.05),
        high=(300.0, 0.9),
        phi_low={"number": 20.0, "seen": 0.02},
        phi_high={"seen": 0.98},
        log_likelihood=_animals_likelihood,
    ),
    Problem(
        name="correlation",
        simulate=_correlated(50),
        names=("time", "spread"),
        units=("s", "m"),
        truth=(4.0, 1.5),
        low=(0.5, 0.3),
        high=(40.0, 5.0),
        phi_low={"time": 0.2, "spread": 0.1},
        log_likelihood=_correlation_likelihood,
    ),
    Problem(
        name="remembering",  # the same with its box for Phi, on which tails were lost when they were kept elsewhere
        simulate=_correlated(60),
        names=("time", "spread"),
        units=("s", "m"),
        truth=(4.0, 1.5),
        low=(0.5, 0.3),
        high=(40.0, 5.0),
        log_likelihood=_correlation_likelihood,
    ),
)
