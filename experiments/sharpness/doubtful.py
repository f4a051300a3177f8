"""Problems with unreliable readings, and one whose signal is strongly curved.

They were written down before they were run, to judge estimates that leave out outliers
(`jaxlfi.estimators.robust_estimates`): a sonar that misses some echoes, a marker whose position is sometimes far off, a
thermometer with spikes to one side, and a chirp without any outliers.
"""

import jax
import jax.numpy as jnp
from jax.scipy import special, stats

from experiments.sharpness.problem import Problem

PINGS, FARTHEST, NEAREST, MISSED = jnp.linspace(0.05, 2.0, 40), 4.0, 0.1, 0.12
"""A sonar's times in s, limits of its range in m, and the probability of no echo, which reads as the farthest."""


def _approach(theta):
    return jnp.maximum(theta[0] - theta[1] * PINGS, NEAREST)


def _sonar(key, theta):
    """A vehicle that drives towards a wall, measured by a sonar that misses some echoes."""
    key_noise, key_missed = jax.random.split(key)
    read = _approach(theta) + theta[2] * jax.random.normal(key_noise, PINGS.shape)
    return jnp.where(jax.random.uniform(key_missed, PINGS.shape) < MISSED, FARTHEST, read)


def _sonar_likelihood(key, theta, x):
    read = jnp.log1p(-MISSED) + stats.norm.logpdf(x, _approach(theta), theta[2])
    return jnp.sum(jnp.where(x == FARTHEST, jnp.log(MISSED), read))


FRAMES, USUAL, FAR_OFF, CONFUSED = jnp.linspace(0.1, 4.0, 40), 0.005, 0.1, 0.1
"""A motion-capture system's times in s, deviations of usual and confused coordinates in m, and the latter's share."""


def _marked(theta):
    length, swing, damping = theta
    angle = swing * jnp.exp(-damping * FRAMES) * jnp.cos(jnp.sqrt(9.81 / length) * FRAMES)
    return length * jnp.stack([jnp.sin(angle), -jnp.cos(angle)], axis=-1)


def _marker(key, theta):
    """A pendulum's marker in two coordinates, each of which is sometimes confused with something else nearby."""
    key_noise, key_confused = jax.random.split(key)
    clean = _marked(theta)
    deviation = jnp.where(jax.random.uniform(key_confused, clean.shape) < CONFUSED, FAR_OFF, USUAL)
    return clean + deviation * jax.random.normal(key_noise, clean.shape)


def _marker_likelihood(key, theta, x):
    clean = _marked(theta)
    density = lambda share, deviation: jnp.log(share) + stats.norm.logpdf(x.reshape(clean.shape), clean, deviation)
    return jnp.sum(jnp.logaddexp(density(1 - CONFUSED, USUAL), density(CONFUSED, FAR_OFF)))


MINUTES, NOISE, SPIKED, HEIGHT = jnp.linspace(0.5, 30.0, 40), 0.3, 0.2, 8.0
"""A thermometer's times in min, deviation in K, share of readings with a spike, and mean height of spikes in K."""


def _warming(theta):
    room, rise, time = theta
    return room + rise * (1 - jnp.exp(-MINUTES / time))


def _spikes(key, theta):
    """A heated body, measured by a thermometer with upward spikes."""
    keys = jax.random.split(key, 3)
    spike = jnp.where(jax.random.uniform(keys[1], MINUTES.shape) < SPIKED, HEIGHT, 0.0)
    noise = NOISE * jax.random.normal(keys[0], MINUTES.shape)
    return _warming(theta) + noise + spike * jax.random.exponential(keys[2], MINUTES.shape)


def _spikes_likelihood(key, theta, x):
    """A spiked reading is the sum of a normal and an exponential variable."""
    away = x - _warming(theta)
    plain = jnp.log1p(-SPIKED) + stats.norm.logpdf(away, 0.0, NOISE)
    sum_of_both = NOISE**2 / (2 * HEIGHT**2) - away / HEIGHT + special.log_ndtr(away / NOISE - NOISE / HEIGHT)
    return jnp.sum(jnp.logaddexp(plain, jnp.log(SPIKED / HEIGHT) + sum_of_both))


SECONDS, HISS = jnp.linspace(0.0, 3.0, 60), 0.15
"""A microphone's times in s, and its deviation."""


def _sweep(theta):
    frequency, rate, phase, amplitude = theta
    return amplitude * jnp.cos(2 * jnp.pi * (frequency * SECONDS + 0.5 * rate * SECONDS**2) + phase)


def _chirp(key, theta):
    """A tone that rises."""
    return _sweep(theta) + HISS * jax.random.normal(key, SECONDS.shape)


def _chirp_likelihood(key, theta, x):
    return -0.5 * jnp.sum(((x - _sweep(theta)) / HISS) ** 2)


PROBLEMS = (
    Problem(
        "sonar", _sonar, ("distance", "speed", "spread"), ("m", "m/s", "m"), (3.0, 0.6, 0.02),
        (2.0, 0.2, 0.008), (3.6, 0.9, 0.06), log=("spread",), log_likelihood=_sonar_likelihood,
    ),
    Problem(
        "marker", _marker, ("length", "swing", "damping"), ("m", "rad", "1/s"), (0.8, 0.5, 0.15),
        (0.5, 0.2, 0.03), (1.2, 0.9, 0.5), log=("damping",), log_likelihood=_marker_likelihood,
    ),
    Problem(
        "spikes", _spikes, ("room", "rise", "time"), ("K", "K", "min"), (20.0, 30.0, 8.0),
        (15.0, 10.0, 3.0), (25.0, 50.0, 20.0), log=("time",), log_likelihood=_spikes_likelihood,
    ),
    Problem(
        "chirp", _chirp, ("frequency", "rate", "phase", "amplitude"), ("Hz", "Hz/s", "rad", "V"), (1.0, 0.3, 0.3, 1.2),
        (0.75, 0.1, -0.8, 0.5), (1.2, 0.5, 1.2, 2.0), log_likelihood=_chirp_likelihood,
    ),
)  # fmt: skip
