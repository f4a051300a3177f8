"""Precise measurements: posteriors hundreds to thousands of times narrower than the box, as with good instruments.

They were written down before any of them was run: the position of a spectral line, the tip of a robot arm as an
external tracker sees it, the swing of a pendulum with a fine encoder, a clock compared with a better one, and a source
of which a detector counts hundreds of thousands of decays.
"""

import jax
import jax.numpy as jnp
from jax import lax

from experiments.sharpness.curves import gaussian
from experiments.sharpness.problem import Problem

CHANNELS = jnp.linspace(0.0, 100.0, 200)


def _line(theta):
    """A spectrum: a Gaussian line on a background."""
    place, width, height, background = theta
    return background + height * jnp.exp(-0.5 * ((CHANNELS - place) / width) ** 2)


TURNS = 2 * jnp.pi * jnp.arange(60) / 60
JOINTS = jnp.stack([1.3 * jnp.sin(TURNS), 1.9 * jnp.cos(2 * TURNS + 0.4)])
"""Angles of both joints of an arm in sixty poses, in rad."""


def _reach(theta):
    """The tip of a planar arm whose joints have offsets: x and y in m, by pose."""
    upper, lower, first, second = theta
    shoulder, elbow = JOINTS[0] + first, JOINTS[0] + first + JOINTS[1] + second
    x = upper * jnp.cos(shoulder) + lower * jnp.cos(elbow)
    y = upper * jnp.sin(shoulder) + lower * jnp.sin(elbow)
    return jnp.stack([x, y], axis=-1)


STEP = 0.02
"""Step of a pendulum in s: it is released at rest, and read every fifth step."""


def _swing(theta):
    """Angles of a pendulum that is released at rest, in rad, 20 s at 10 Hz."""
    length, damping, angle = theta

    def step(state, _):
        angle, speed = state
        speed = speed + STEP * (-9.81 / length * jnp.sin(angle) - damping * speed)
        return (angle + STEP * speed, speed), angle

    return lax.scan(step, (angle, jnp.zeros_like(angle)), None, length=1000)[1][::5]


HOURS = jnp.linspace(0.0, 24.0, 97)


def _clock(theta):
    """How far a clock is ahead of a better one, in ms: offset, rate, and the rate's variation with the day's heat."""
    offset, rate, heat = theta
    return offset + rate * HOURS + heat * jnp.sin(2 * jnp.pi * HOURS / 24)


MINUTES = jnp.arange(60.0)


def _activity(theta):
    """Expected counts per minute of a source that decays, and of others."""
    activity, life, others = theta
    return activity * jnp.exp(-MINUTES / life) + others


def _detector(key, theta):
    """Counts, which are Gaussian as there are so many."""
    mean = _activity(theta)
    return mean + jnp.sqrt(mean) * jax.random.normal(key, mean.shape)


def _detector_likelihood(key, theta, x):
    mean = _activity(theta)
    return -0.5 * jnp.sum((x - mean) ** 2 / mean + jnp.log(mean))


PROBLEMS = (
    gaussian(
        _line, 0.02, name="line", names=("place", "width", "height", "background"), units=("", "", "", ""),
        truth=(41.3, 4.2, 1.7, 0.6), low=(20.0, 1.0, 0.3, 0.0), high=(80.0, 12.0, 4.0, 2.0),
        phi_low={"place": 0.0, "width": 0.5, "height": 0.1, "background": -1.0}, phi_high={"place": 100.0},
    ),
    gaussian(
        _reach, 3e-4, name="reach", names=("upper", "lower", "first", "second"), units=("m", "m", "rad", "rad"),
        truth=(0.34, 0.27, 0.11, -0.17), low=(0.15, 0.15, -0.5, -0.5), high=(0.6, 0.6, 0.5, 0.5),
        phi_low={"upper": 0.05, "lower": 0.05},
    ),
    gaussian(
        _swing, 2e-3, name="swing", names=("length", "damping", "angle"), units=("m", "1/s", "rad"),
        truth=(0.83, 0.06, 0.7), low=(0.5, 0.0, 0.2), high=(1.5, 0.3, 1.3), phi_low={"length": 0.3, "damping": 0.0},
    ),
    gaussian(
        _clock, 0.02, name="clock", names=("offset", "rate", "heat"), units=("ms", "ms/h", "ms"),
        truth=(3.2, -0.71, 0.4), low=(-20.0, -3.0, -4.0), high=(20.0, 3.0, 4.0),
    ),
    Problem(
        name="detector", simulate=_detector, log_likelihood=_detector_likelihood,
        names=("activity", "life", "others"), units=("1/min", "min", "1/min"), truth=(2.2e5, 14.0, 3.1e4),
        low=(2e4, 3.0, 1e3), high=(2e6, 60.0, 3e5), log=("activity", "life", "others"),
    ),
)  # fmt: skip
