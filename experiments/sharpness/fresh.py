"""Problems of further kinds, written down when the default had settled: their results were not used to choose anything.

Doses and concentrations, lifetimes in no order, yes-or-no answers, a pendulum seen through two channels, noise that is
itself a parameter, two modes of a structure, a rhythm of unknown phase, and two series with memory: one oscillates, and
all information of the other is in its squares.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from experiments.sharpness.curves import gaussian
from experiments.sharpness.problem import Problem

HOURS, ERROR = jnp.array([0.25, 0.5, 1, 1.5, 2, 3, 4, 6, 8, 12, 16, 24]), 0.1
"""Times at which blood is drawn after a dose of 100 mg, and the error of a concentration's logarithm."""


def _concentrations(theta):
    """Concentrations of a substance that is absorbed and eliminated at rates proportional to its amount."""
    absorption, elimination, volume = theta
    apart = absorption - elimination
    apart = jnp.where(jnp.abs(apart) < 1e-3, 1e-3, apart)
    return 100 / volume * absorption / apart * (jnp.exp(-elimination * HOURS) - jnp.exp(-absorption * HOURS))


def _pharmacokinetics(key, theta):
    return _concentrations(theta) * jnp.exp(ERROR * jax.random.normal(key, HOURS.shape))


def _pharmacokinetics_likelihood(key, theta, x):
    return -0.5 * jnp.sum((jnp.log(x / _concentrations(theta)) / ERROR) ** 2)


def _weibull(key, theta):
    """Sixty lifetimes, in no order."""
    return theta[1] * jax.random.exponential(key, (60,)) ** (1 / theta[0])


def _weibull_likelihood(key, theta, x):
    shape, scale = theta
    z = x / scale
    return jnp.sum(jnp.log(shape / scale) + (shape - 1) * jnp.log(z) - z**shape)


def _ar2(key, theta):
    """A second-order autoregression from rest, which oscillates."""

    def step(last, noise):
        value = theta[0] * last[0] + theta[1] * last[1] + theta[2] * noise
        return (value, last[0]), value

    return lax.scan(step, (0.0, 0.0), jax.random.normal(key, (80,)))[1]


def _ar2_likelihood(key, theta, x):
    padded = jnp.concatenate([jnp.zeros(2), x])
    noise = (x - theta[0] * padded[1:-1] - theta[1] * padded[:-2]) / theta[2]
    return -0.5 * jnp.sum(noise**2) - len(x) * jnp.log(theta[2])


DOSES = jnp.linspace(-2, 2, 40)


def _responses(key, theta):
    """Yes or no, once at each dose."""
    return (jax.random.uniform(key, DOSES.shape) < jax.nn.sigmoid(theta[0] + theta[1] * DOSES)).astype(jnp.float32)


def _responses_likelihood(key, theta, x):
    log_odds = theta[0] + theta[1] * DOSES
    return jnp.sum(x * jax.nn.log_sigmoid(log_odds) + (1 - x) * jax.nn.log_sigmoid(-log_odds))


NOISES, TICK = jnp.array([0.05, 0.2]), 0.02
"""Noise of the angle in rad and of the rate in rad/s, and the integration step in s."""


def _swings(theta):
    """Angle and rate of a damped pendulum that is released, in 50 records of four steps each."""
    length, damping, start = theta

    def step(state, _):
        angle, rate = state
        rate = rate - TICK * (9.81 / length * jnp.sin(angle) + damping * rate)
        angle = angle + TICK * rate
        return (angle, rate), jnp.stack([angle, rate])

    return lax.scan(step, (start, jnp.zeros(())), length=200)[1][3::4]


def _pendulum(key, theta):
    return _swings(theta) + NOISES * jax.random.normal(key, (50, 2))


def _pendulum_likelihood(key, theta, x):
    return -0.5 * jnp.sum(((x - _swings(theta)) / NOISES) ** 2)


def _first_variance(theta):
    return theta[0] / (1 - jnp.minimum(theta[1] + theta[2], 0.98))


def _next_variance(theta, variance, value):
    return theta[0] + theta[1] * value**2 + theta[2] * variance


def _garch(key, theta):
    """Returns whose variance depends on their past squares."""

    def step(variance, noise):
        value = jnp.sqrt(variance) * noise
        return _next_variance(theta, variance, value), value

    return lax.scan(step, _first_variance(theta), jax.random.normal(key, (150,)))[1]


def _garch_likelihood(key, theta, x):
    def step(variance, value):
        return _next_variance(theta, variance, value), -0.5 * (value**2 / variance + jnp.log(variance))

    return jnp.sum(lax.scan(step, _first_variance(theta), x)[1])


WHEN = jnp.asarray(np.sort(np.random.default_rng(3).uniform(0, 10, 30)), jnp.float32)
"""Hours at which a rhythm is measured, unevenly."""


def _rhythm(theta):
    return theta[0] * jnp.cos(theta[1] * WHEN + theta[2])


SPAN = jnp.linspace(0, 1, 25)


def _trend(key, theta):
    """A straight line in noise whose standard deviation is not known."""
    return theta[0] + theta[1] * SPAN + theta[2] * jax.random.normal(key, SPAN.shape)


def _trend_likelihood(key, theta, x):
    residuals = (x - theta[0] - theta[1] * SPAN) / theta[2]
    return -0.5 * jnp.sum(residuals**2) - len(x) * jnp.log(theta[2])


SECONDS = jnp.linspace(0, 6, 60)


def _ringing(theta):
    """A structure that rings in two modes after an impact."""
    first, second, first_damping, second_damping, share = theta
    slow = jnp.exp(-first_damping * SECONDS) * jnp.cos(first * SECONDS)
    return slow + share * jnp.exp(-second_damping * SECONDS) * jnp.cos(second * SECONDS)


PROBLEMS = (
    Problem(
        "trend", _trend, ("level", "slope", "noise"), ("V", "V/s", "V"), (1.0, 2.0, 0.4), (-3.0, -4.0, 0.05),
        (4.0, 6.0, 3.0), log=("noise",), log_likelihood=_trend_likelihood,
    ),
    Problem(
        "weibull", _weibull, ("shape", "scale"), ("", "h"), (1.7, 120.0), (0.5, 20.0), (6.0, 600.0),
        log=("shape", "scale"), log_likelihood=_weibull_likelihood,
    ),
    Problem(
        "ar2", _ar2, ("first", "second", "noise"), ("", "", ""), (0.9, -0.5, 1.0), (-0.5, -0.9, 0.3),
        (1.4, 0.3, 3.0), log=("noise",), log_likelihood=_ar2_likelihood,
    ),
    Problem(
        "responses", _responses, ("intercept", "slope"), ("", ""), (0.5, 2.0), (-3.0, -1.0), (3.0, 6.0),
        log_likelihood=_responses_likelihood,
    ),
    Problem(
        "pharmacokinetics", _pharmacokinetics, ("absorption", "elimination", "volume"), ("1/h", "1/h", "l"),
        (1.2, 0.15, 20.0), (0.5, 0.03, 5.0), (4.0, 0.45, 80.0), log=("absorption", "elimination", "volume"),
        log_likelihood=_pharmacokinetics_likelihood,
    ),
    gaussian(
        _rhythm, 0.3, name="rhythm", names=("amplitude", "frequency", "phase"), units=("", "rad/h", "rad"),
        truth=(1.0, 1.0, 0.5), low=(0.3, 0.6, -1.5), high=(3.0, 1.6, 1.5), log=("amplitude",),
    ),
    gaussian(
        _ringing, 0.1, name="ringing",
        names=("first frequency", "second frequency", "first damping", "second damping", "share"),
        units=("rad/s", "rad/s", "1/s", "1/s", ""), truth=(2.0, 5.0, 0.2, 0.4, 0.7), low=(1.2, 3.5, 0.05, 0.1, 0.2),
        high=(3.0, 7.0, 1.0, 1.5, 2.0), log=("first damping", "second damping", "share"),
    ),
    Problem(
        "pendulum", _pendulum, ("length", "damping", "start"), ("m", "1/s", "rad"), (0.8, 0.3, 1.0),
        (0.3, 0.05, 0.3), (2.0, 1.5, 2.0), log=("length", "damping"), log_likelihood=_pendulum_likelihood,
    ),
    Problem(
        "garch", _garch, ("base", "shock", "memory"), ("", "", ""), (0.2, 0.3, 0.5), (0.03, 0.02, 0.05),
        (1.0, 0.8, 0.9), log=("base",), phi_low={"base": 0.01, "shock": 0.0, "memory": 0.0},
        phi_high={"base": 3.0, "shock": 0.95, "memory": 0.98}, informed=("base",), open=("shock", "memory"),
        log_likelihood=_garch_likelihood,
    ),
)  # fmt: skip
