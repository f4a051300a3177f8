"""Problems written down while proposals and training were being changed, and run only once that was decided.

A sensor that saturates, counts with memory, a switch between two hidden states, two decays at once, and a vehicle that
drives past a beacon.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy import stats
from jax.scipy.special import gammaln

from experiments.sharpness.curves import gaussian
from experiments.sharpness.problem import Problem

TIMES, NOISE, FULL_SCALE = jnp.linspace(0.0, 4.0, 48), 0.15, 1.0
"""An accelerometer's sampling times, noise, and the reading at which it saturates."""


def _acceleration(theta):
    amplitude, frequency, bias = theta
    return bias + amplitude * jnp.sin(2 * jnp.pi * frequency * TIMES)


def _saturating(key, theta):
    """A shaken accelerometer that saturates at both ends of its scale."""
    return jnp.clip(_acceleration(theta) + NOISE * jax.random.normal(key, TIMES.shape), -FULL_SCALE, FULL_SCALE)


def _saturating_likelihood(key, theta, x):
    mean = _acceleration(theta)
    above, below = stats.norm.logsf(FULL_SCALE, mean, NOISE), stats.norm.logcdf(-FULL_SCALE, mean, NOISE)
    inside = stats.norm.logpdf(x, mean, NOISE)
    return jnp.sum(jnp.where(x >= FULL_SCALE, above, jnp.where(x <= -FULL_SCALE, below, inside)))


DAYS, MOST = 70, 60
"""Length of a series of counts, and a bound above all counts that occur."""


def _arrivals(key, theta):
    """Counts of patients: each of yesterday's stays with a probability, and new ones arrive (an INAR(1) process)."""
    stays, rate = theta

    def step(count, key):
        key_stay, key_new = jax.random.split(key)
        staying = jnp.sum((jax.random.uniform(key_stay, (MOST,)) < stays) & (jnp.arange(MOST) < count))
        count = jnp.minimum(staying + jax.random.poisson(key_new, rate), MOST)
        return count, count

    key_first, key_rest = jax.random.split(key)
    first = jnp.minimum(jax.random.poisson(key_first, rate / (1 - stays)), MOST)
    return lax.scan(step, first, jax.random.split(key_rest, DAYS))[1].astype(jnp.float32)


def _arrivals_likelihood(key, theta, x):
    """The first count by the stationary law, the others given the one before."""
    stays, rate = theta
    staying = jnp.arange(MOST + 1.0)[:, None]
    now, before = x[1:], x[:-1]
    chosen = gammaln(before + 1) - gammaln(staying + 1) - gammaln(jnp.maximum(before - staying, 0) + 1)
    kept = chosen + staying * jnp.log(stays) + (before - staying) * jnp.log1p(-stays)
    new = now - staying
    arrived = new * jnp.log(rate) - rate - gammaln(jnp.maximum(new, 0) + 1)
    possible = (staying <= before) & (new >= 0)
    steps = jax.nn.logsumexp(jnp.where(possible, kept + arrived, -jnp.inf), axis=0)
    mean = rate / (1 - stays)
    return jnp.sum(steps) + x[0] * jnp.log(mean) - mean


RECORDS = 90


def _channel(key, theta):
    """Current through an ion channel that is closed at first, and opens and closes at random."""
    opening, closing, current = theta
    key_switch, key_noise = jax.random.split(key)

    def step(is_open, uniform):
        is_open = jnp.where(is_open, uniform >= closing, uniform < opening)
        return is_open, is_open

    states = lax.scan(step, jnp.asarray(False), jax.random.uniform(key_switch, (RECORDS,)))[1]
    return current * states + 0.5 * jax.random.normal(key_noise, (RECORDS,))


def _channel_likelihood(key, theta, x):
    """By the forward recursion of a hidden Markov model."""
    opening, closing, current = theta
    moves = jnp.log(jnp.array([[1 - opening, opening], [closing, 1 - closing]]))

    def step(log_states, reading):
        ahead = jax.nn.logsumexp(log_states[:, None] + moves, axis=0)
        ahead += stats.norm.logpdf(reading, jnp.array([0.0, current]), 0.5)
        return ahead, None

    return jax.nn.logsumexp(lax.scan(step, jnp.array([0.0, -jnp.inf]), x)[0])


SECONDS = jnp.linspace(0.0, 10.0, 30)


def _two_decays(theta):
    """Fluorescence of two substances that decay at different rates."""
    fast, slow, share = theta
    return share * jnp.exp(-fast * SECONDS) + (1 - share) * jnp.exp(-slow * SECONDS)


LEGS, BEACON = 30, jnp.array([3.0, 2.0])
STEP, BEARING, DISTANCE = 0.2, 0.05, 0.1
"""A vehicle's commanded advance in each leg (m), and noise of the bearing (rad) and of the distance (m)."""


def _beacon_readings(theta):
    scale, drift, start = theta
    heading = start + drift * jnp.arange(LEGS)
    place = jnp.cumsum(scale * STEP * jnp.stack([jnp.cos(heading), jnp.sin(heading)], axis=-1), axis=0)
    away = BEACON - place
    bearing = jnp.arctan2(away[:, 1], away[:, 0]) - heading
    return jnp.linalg.norm(away, axis=-1), jnp.arctan2(jnp.sin(bearing), jnp.cos(bearing))


def _odometry(key, theta):
    """Distance and bearing of a beacon from a vehicle whose wheels are worn and whose heading drifts."""
    distance, bearing = _beacon_readings(theta)
    noise = jax.random.normal(key, (LEGS, 2))
    return jnp.stack([distance + DISTANCE * noise[:, 0], bearing + BEARING * noise[:, 1]], axis=-1)


def _odometry_likelihood(key, theta, x):
    distance, bearing = _beacon_readings(theta)
    read = x.reshape(LEGS, 2)
    errors = jnp.concatenate([(read[:, 0] - distance) / DISTANCE, (read[:, 1] - bearing) / BEARING])
    return -0.5 * jnp.sum(errors**2)


PROBLEMS = (
    Problem(
        "saturating", _saturating, ("amplitude", "frequency", "bias"), ("g", "Hz", "g"), (1.4, 0.6, 0.2),
        (0.6, 0.45, -0.3), (2.4, 0.8, 0.6), log_likelihood=_saturating_likelihood,
    ),
    Problem(
        "arrivals", _arrivals, ("stays", "rate"), ("", "1/d"), (0.6, 3.0), (0.1, 0.8), (0.9, 6.0), log=("rate",),
        log_likelihood=_arrivals_likelihood, phi_low={"stays": 0.01}, phi_high={"stays": 0.95, "rate": 8.0},
    ),
    Problem(
        "channel", _channel, ("opening", "closing", "current"), ("", "", "pA"), (0.1, 0.2, 1.5),
        (0.02, 0.04, 0.5), (0.4, 0.6, 3.0), log=("opening", "closing"), log_likelihood=_channel_likelihood,
        phi_high={"opening": 0.9, "closing": 0.9},
    ),
    gaussian(
        _two_decays, 0.02, name="two_decays", names=("fast", "slow", "share"), units=("1/s", "1/s", ""),
        truth=(1.5, 0.2, 0.6), low=(0.7, 0.05, 0.3), high=(4.0, 0.5, 0.9), log=("fast", "slow"),
        phi_low={"share": 0.05}, phi_high={"share": 0.98},
    ),
    Problem(
        "odometry", _odometry, ("scale", "drift", "heading"), ("", "rad", "rad"), (0.93, 0.015, 0.35),
        (0.7, -0.03, 0.0), (1.1, 0.04, 0.8), log_likelihood=_odometry_likelihood,
    ),
)  # fmt: skip
