"""Long recordings, of thousands of numbers, as machines log them.

`recorder` was looked at when it was decided what estimators see of them (`jaxlfi.estimators.averages`). The other four
were written down before they were run: a motor's current and speed, the sound of a tap, which is too fast for means of
neighbours to show anything, the drift of a sensor, and pictures of a ball. `tap` and `ball` then served to decide how
responses are reduced.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy import stats

from experiments.sharpness.curves import gaussian
from experiments.sharpness.problem import Problem

TIMES = jnp.linspace(0.0, 10.0, 4000)


def _oscillation(theta):
    size, damping, frequency, _ = theta
    return size * jnp.exp(-damping * TIMES) * jnp.cos(frequency * TIMES)


def _recorder(key, theta):
    """A damped oscillation with noise whose deviation is a parameter, too."""
    return _oscillation(theta) + theta[3] * jax.random.normal(key, TIMES.shape)


def _recorder_likelihood(key, theta, x):
    return jnp.sum(stats.norm.logpdf(x, _oscillation(theta), theta[3]))


TICK, RESISTANCE, INDUCTANCE = 0.002, 1.2, 5e-3
VOLTS = 6.0 * jnp.sign(jnp.sin(2 * jnp.pi * (0.5 * TICK * jnp.arange(1500) + (TICK * jnp.arange(1500)) ** 2 / 2)))
READ = jnp.array([0.05, 0.6])
"""A motor's step in s, resistance in ohm, inductance in H, voltage in V; noise of current in A and speed in rad/s."""


def _driven(theta):
    """Current and speed of a motor that drives a wheel, 3 s at 500 Hz."""
    inertia, friction, constant = theta

    def step(state, volts):
        current, speed = state
        # The current's equation is stiff: its step is implicit.
        current = (current + TICK / INDUCTANCE * (volts - constant * speed)) / (1 + TICK / INDUCTANCE * RESISTANCE)
        speed = speed + TICK / inertia * (constant * current - friction * speed)
        return (current, speed), jnp.stack([current, speed])

    return lax.scan(step, (jnp.zeros(()), jnp.zeros(())), VOLTS)[1]


def _drive(key, theta):
    return _driven(theta) + READ * jax.random.normal(key, (1500, 2))


def _drive_likelihood(key, theta, x):
    clean = _driven(theta)
    return -0.5 * jnp.sum(((x.reshape(clean.shape) - clean) / READ) ** 2)


AFTER = jnp.arange(2000) / 4000.0
"""Times after a tap, in s."""


def _tap(theta):
    """Sound at 4,000 Hz: about six records per period."""
    frequency, decay, loudness = theta
    return loudness * jnp.exp(-decay * AFTER) * jnp.sin(2 * jnp.pi * frequency * AFTER)


def _drift(key, theta):
    """A sensor at rest: an offset, and slowly decaying errors."""
    offset, memory, deviation = theta
    key_first, key_steps = jax.random.split(key)
    first = deviation / jnp.sqrt(1 - memory**2) * jax.random.normal(key_first)
    step = lambda error, noise: (memory * error + deviation * noise,) * 2
    return offset + lax.scan(step, first, jax.random.normal(key_steps, (3000,)))[1]


def _drift_likelihood(key, theta, x):
    offset, memory, deviation = theta
    error = x - offset
    first = stats.norm.logpdf(error[0], 0.0, deviation / jnp.sqrt(1 - memory**2))
    return first + jnp.sum(stats.norm.logpdf(error[1:], memory * error[:-1], deviation))


SIDE = jnp.linspace(-1.0, 1.0, 48)


def _ball(theta):
    """A picture of 48 x 48 pixels, rows first, of a ball that is out of focus."""
    across, up, radius = theta
    distance = jnp.sqrt((SIDE - across) ** 2 + (SIDE[:, None] - up) ** 2 + 1e-6)
    return jax.nn.sigmoid((radius - distance) / 0.05)


PROBLEMS = (
    Problem(
        name="recorder", simulate=_recorder, log_likelihood=_recorder_likelihood, names=("size", "c", "w", "noise"),
        units=("", "1/s", "rad/s", ""), truth=(1.7, 0.3, 4.0, 0.3), low=(0.5, 0.05, 1.0, 0.05),
        high=(3.0, 1.0, 10.0, 1.0), phi_low={"c": 0.0, "w": 0.2, "noise": 0.01, "size": 0.1},
    ),
    Problem(
        name="drive", simulate=_drive, log_likelihood=_drive_likelihood, names=("inertia", "friction", "constant"),
        units=("kg m^2", "N m s/rad", "N m/A"), truth=(4e-4, 6e-4, 0.06), low=(1e-4, 1e-4, 0.02),
        high=(1.5e-3, 3e-3, 0.15), log=("inertia", "friction", "constant"),
    ),
    gaussian(
        _tap, 0.1, name="tap", names=("frequency", "decay", "loudness"), units=("Hz", "1/s", ""),
        truth=(660.0, 40.0, 1.0), low=(620.0, 15.0, 0.4), high=(690.0, 90.0, 2.0),
        phi_low={"decay": 1.0, "loudness": 0.1},
    ),
    Problem(
        name="drift", simulate=_drift, log_likelihood=_drift_likelihood, names=("offset", "memory", "deviation"),
        units=("", "", ""), truth=(0.4, 0.93, 0.1), low=(-1.0, 0.6, 0.02), high=(1.0, 0.99, 0.4),
        phi_low={"deviation": 0.005}, phi_high={"memory": 0.995},
    ),
    gaussian(
        _ball, 0.4, name="ball", names=("across", "up", "radius"), units=("", "", ""), truth=(0.25, -0.1, 0.3),
        low=(-0.6, -0.6, 0.1), high=(0.6, 0.6, 0.6), phi_low={"radius": 0.05},
    ),
)  # fmt: skip
