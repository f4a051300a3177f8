"""Problems whose sensors have outliers, as those of robots do.

Written down when regression features had been made robust (`jaxlfi.estimators.clipping`), on `outliers` of the further
problems. The results of `encoder` then led to Huber's estimates there; the other two were not used to choose anything.
"""

import jax
import jax.numpy as jnp
from jax.scipy import stats

from experiments.sharpness.problem import Problem

TIMES, JITTER, LOST, RANGE = jnp.linspace(0.1, 6, 60), 0.05, 0.08, 3.0
"""An encoder's sampling times, standard deviation, probability of a false reading, and range of these."""


def _swing(theta):
    frequency, damping, amplitude = theta
    return amplitude * jnp.exp(-damping * TIMES) * jnp.cos(frequency * TIMES)


def _encoder(key, theta):
    """A damped oscillation, read by an encoder some of whose readings are uniform over its range instead."""
    key_noise, key_lost, key_any = jax.random.split(key, 3)
    read = _swing(theta) + JITTER * jax.random.normal(key_noise, TIMES.shape)
    false = jax.random.uniform(key_any, TIMES.shape, minval=-RANGE, maxval=RANGE)
    return jnp.where(jax.random.uniform(key_lost, TIMES.shape) < LOST, false, read)


def _encoder_likelihood(key, theta, x):
    read = stats.norm.logpdf(x, _swing(theta), JITTER)
    return jnp.sum(jnp.logaddexp(jnp.log1p(-LOST) + read, jnp.log(LOST / (2 * RANGE))))


FRAMES, PIXELS, FREEDOM = jnp.linspace(0.05, 1.2, 24), 2.0, 1.5
"""Frame times of a camera at 100 pixels per metre, scale of its errors, and their degrees of freedom."""


def _flight(theta):
    forward, upward, drag = theta
    slowed = (1 - jnp.exp(-drag * FRAMES)) / drag
    height = (upward + 9.81 / drag) * slowed - 9.81 / drag * FRAMES
    return 100 * jnp.stack([forward * slowed, height], axis=-1)


def _keypoints(key, theta):
    """A thrown ball with drag, in two image coordinates, from a detector with heavy-tailed errors."""
    return _flight(theta) + PIXELS * jax.random.t(key, FREEDOM, (len(FRAMES), 2))


def _keypoints_likelihood(key, theta, x):
    return jnp.sum(stats.t.logpdf((x.reshape(-1, 2) - _flight(theta)) / PIXELS, FREEDOM))


MINUTES = jnp.linspace(0, 40, 30)


def _cooling_curve(theta):
    start, rate, room = theta
    return room + (start - room) * jnp.exp(-rate * MINUTES)


def _cooling(key, theta):
    """Newton's law of cooling, measured with Laplace errors, whose tails are only slightly heavier than a normal's."""
    return _cooling_curve(theta) + 0.7 * jax.random.laplace(key, MINUTES.shape)


def _cooling_likelihood(key, theta, x):
    return -jnp.sum(jnp.abs(x - _cooling_curve(theta))) / 0.7


PROBLEMS = (
    Problem(
        "encoder", _encoder, ("frequency", "damping", "amplitude"), ("rad/s", "1/s", "rad"), (3.0, 0.25, 1.2),
        (2.4, 0.05, 0.4), (3.8, 0.8, 2.2), log=("damping",), log_likelihood=_encoder_likelihood,
    ),
    Problem(
        "keypoints", _keypoints, ("forward", "upward", "drag"), ("m/s", "m/s", "1/s"), (3.0, 5.0, 0.4),
        (1.0, 3.0, 0.1), (6.0, 8.0, 1.5), log=("drag",), log_likelihood=_keypoints_likelihood,
    ),
    Problem(
        "cooling", _cooling, ("start", "rate", "room"), ("K", "1/min", "K"), (60.0, 0.08, 20.0),
        (40.0, 0.02, 10.0), (90.0, 0.3, 30.0), log=("rate",), log_likelihood=_cooling_likelihood,
    ),
)  # fmt: skip
