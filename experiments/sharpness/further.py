"""More problems of kinds that other users bring, in addition to `fresh`.

`outliers` and `local_level` were looked at when the statistics of series were chosen (`jaxlfi.estimators.statistics`);
the others were not used to choose anything.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy import stats

from experiments.sharpness.curves import gaussian
from experiments.sharpness.problem import Problem

PLACES = jnp.linspace(0, 3, 30)


def _outliers(key, theta):
    """A straight line with Student's t noise of two degrees of freedom, whose variance is infinite."""
    return theta[0] + theta[1] * PLACES + theta[2] * jax.random.t(key, 2.0, PLACES.shape)


def _outliers_likelihood(key, theta, x):
    return jnp.sum(stats.t.logpdf((x - theta[0] - theta[1] * PLACES) / theta[2], 2.0) - jnp.log(theta[2]))


def _local_level(key, theta):
    """A level that drifts at random, measured with noise."""
    key_level, key_noise = jax.random.split(key)
    level = jnp.cumsum(theta[0] * jax.random.normal(key_level, (100,)))
    return level + theta[1] * jax.random.normal(key_noise, (100,))


def _local_level_likelihood(key, theta, x):
    """By the Kalman filter."""
    drift, noise = theta[0] ** 2, theta[1] ** 2

    def step(state, value):
        mean, variance, total = state
        variance = variance + drift
        predicted, error = variance + noise, value - mean
        gain = variance / predicted
        total = total - 0.5 * (error**2 / predicted + jnp.log(predicted))
        return (mean + gain * error, variance * (1 - gain), total), None

    return lax.scan(step, (0.0, 0.0, 0.0), x)[0][2]


DECAY_TIMES = jnp.linspace(0, 10, 25)


def _activity(theta):
    return theta[0] * jnp.exp(-DECAY_TIMES / theta[1]) + theta[2]


def _radioactive(key, theta):
    """Counts from a decaying source and a background."""
    return jax.random.poisson(key, _activity(theta)).astype(jnp.float32)


def _counts_likelihood(rate, x):
    return jnp.sum(x * jnp.log(rate) - rate)


CONCENTRATIONS = jnp.array([0.1, 0.2, 0.4, 0.7, 1, 1.5, 2, 3, 5, 8, 12, 20.0])


def _velocity(theta):
    return theta[0] * CONCENTRATIONS / (theta[1] + CONCENTRATIONS)


def _enzyme(key, theta):
    """Velocities of a reaction by Michaelis and Menten's law, with relative errors of a tenth."""
    return _velocity(theta) * jnp.exp(0.1 * jax.random.normal(key, CONCENTRATIONS.shape))


def _enzyme_likelihood(key, theta, x):
    return -0.5 * jnp.sum((jnp.log(x / _velocity(theta)) / 0.1) ** 2)


def _coin(key, theta):
    """The number of heads in fifty throws: a single number."""
    return jnp.sum(jax.random.uniform(key, (50,)) < theta[0]).astype(jnp.float32)[None]


def _coin_likelihood(key, theta, x):
    return x[0] * jnp.log(theta[0]) + (50 - x[0]) * jnp.log1p(-theta[0])


def _new_cases(theta):
    """New cases on thirty days, by an SIR model with ten steps per day."""
    contact, recovery, start = theta

    def step(state, _):
        susceptible, infected = state
        new, recovered = 0.1 * contact * susceptible * infected, 0.1 * recovery * infected
        return (susceptible - new, infected + new - recovered), new

    new = lax.scan(step, (1 - start, start), length=300)[1]
    return 2000 * new.reshape(30, 10).sum(1) + 0.1


def _outbreak(key, theta):
    return jax.random.poisson(key, _new_cases(theta)).astype(jnp.float32)


def _populations(key, theta):
    """A hundred values in no order, from two populations."""
    key_which, key_noise = jax.random.split(key)
    first = jax.random.uniform(key_which, (100,)) < theta[2]
    return jnp.where(first, theta[0], theta[1]) + jax.random.normal(key_noise, (100,))


def _populations_likelihood(key, theta, x):
    first = jnp.log(theta[2]) - 0.5 * (x - theta[0]) ** 2
    return jnp.sum(jnp.logaddexp(first, jnp.log1p(-theta[2]) - 0.5 * (x - theta[1]) ** 2))


MOTOR_NOISES, MOTOR_STEP = jnp.array([0.1, 1.0]), 0.01
"""Noise of the current in A and the speed in rad/s, and the integration step in s."""


def _motor_response(theta):
    """Current and speed of a motor after a step of 6 V, in 40 records of five steps each."""
    resistance, constant, inertia, friction = theta

    def step(state, _):
        current, speed = state
        current = current + MOTOR_STEP * (6 - resistance * current - constant * speed) / 0.05
        speed = speed + MOTOR_STEP * (constant * current - friction * speed) / inertia
        return (current, speed), jnp.stack([current, speed])

    return lax.scan(step, (0.0, 0.0), length=200)[1][4::5]


def _motor(key, theta):
    return _motor_response(theta) + MOTOR_NOISES * jax.random.normal(key, (40, 2))


def _motor_likelihood(key, theta, x):
    return -0.5 * jnp.sum(((x - _motor_response(theta)) / MOTOR_NOISES) ** 2)


def _driven(theta):
    """Fifty positions of an oscillator under a periodic force, from an unknown state."""
    stiffness, damping, force, position, speed = theta
    step_size = 0.02

    def step(state, time):
        x, v = state
        v = v + step_size * (-stiffness * x - damping * v + force * jnp.cos(1.3 * time))
        x = x + step_size * v
        return (x, v), x

    return lax.scan(step, (position, speed), step_size * jnp.arange(500))[1][9::10]


PROBLEMS = (
    Problem(
        "outliers", _outliers, ("level", "slope", "scale"), ("", "", ""), (1.0, -2.0, 0.3), (-4.0, -6.0, 0.05),
        (5.0, 3.0, 3.0), log=("scale",), log_likelihood=_outliers_likelihood,
    ),
    Problem(
        "local_level", _local_level, ("drift", "noise"), ("", ""), (0.3, 1.0), (0.03, 0.2), (3.0, 5.0),
        log=("drift", "noise"), log_likelihood=_local_level_likelihood,
    ),
    Problem(
        "motor", _motor, ("resistance", "constant", "inertia", "friction"), ("ohm", "N m/A", "kg m2", "N m s"),
        (1.5, 0.2, 0.01, 0.01), (0.6, 0.08, 0.003, 0.002), (5.0, 0.5, 0.04, 0.05),
        log=("resistance", "constant", "inertia", "friction"), log_likelihood=_motor_likelihood,
    ),
    Problem(
        "radioactive", _radioactive, ("activity", "lifetime", "background"), ("1/s", "s", "1/s"), (80.0, 2.0, 6.0),
        (10.0, 0.5, 1.0), (400.0, 8.0, 40.0), log=("activity", "lifetime", "background"),
        log_likelihood=lambda key, theta, x: _counts_likelihood(_activity(theta), x),
    ),
    Problem(
        "enzyme", _enzyme, ("largest velocity", "half-saturation"), ("", ""), (3.0, 1.2), (0.5, 0.1), (15.0, 12.0),
        log=("largest velocity", "half-saturation"), log_likelihood=_enzyme_likelihood,
    ),
    Problem(
        "coin", _coin, ("probability",), ("",), (0.3,), (0.02,), (0.98,), phi_low={"probability": 0.001},
        phi_high={"probability": 0.999}, log_likelihood=_coin_likelihood,
    ),
    Problem(
        "outbreak", _outbreak, ("contact", "recovery", "start"), ("1/d", "1/d", ""), (0.7, 0.25, 0.004),
        (0.3, 0.08, 0.0005), (1.5, 0.7, 0.03), log=("contact", "recovery", "start"),
        log_likelihood=lambda key, theta, x: _counts_likelihood(_new_cases(theta), x),
    ),
    Problem(
        "populations", _populations, ("first", "second", "share"), ("", "", ""), (-1.5, 2.0, 0.35), (-5.0, 0.5, 0.1),
        (0.5, 6.0, 0.9), phi_low={"share": 0.02}, phi_high={"share": 0.98}, log_likelihood=_populations_likelihood,
    ),
    gaussian(
        _driven, 0.1, name="driven", names=("stiffness", "damping", "force", "position", "speed"),
        units=("1/s2", "1/s", "m/s2", "m", "m/s"), truth=(4.0, 0.3, 1.0, 1.0, -0.5), low=(2.0, 0.05, 0.2, -2.0, -3.0),
        high=(8.0, 1.5, 4.0, 3.0, 3.0), log=("stiffness", "damping", "force"),
    ),
)  # fmt: skip
