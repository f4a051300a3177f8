"""Problems written down when all defaults had been chosen, to judge them: jumps, delays, play, contacts and images.

A level that changes at an unknown time, a ball that bounces, a camera's picture of a spot, a heated rod, a power law
over decades, a counter with a dead time, a gear with play, a delayed step response, and the calibration of an arm.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy import stats

from experiments.sharpness.curves import gaussian
from experiments.sharpness.problem import Problem

SAMPLES = jnp.linspace(0.0, 10.0, 60)


def _change(theta):
    """A level that jumps."""
    before, after, when = theta
    return jnp.where(SAMPLES < when, before, after)


GRAVITY, FRAMES, BOUNCES = 9.81, jnp.linspace(0.02, 2.0, 50), 12


def _bounces(theta):
    """Heights of a ball that is dropped and loses part of its speed at each contact."""
    height, restitution = theta
    fall = jnp.sqrt(2 * height / GRAVITY)
    speeds = restitution * jnp.sqrt(2 * GRAVITY * height) * restitution ** jnp.arange(BOUNCES)
    starts = fall + jnp.concatenate([jnp.zeros(1), jnp.cumsum(2 * speeds / GRAVITY)[:-1]])
    since = FRAMES[:, None] - starts
    flying = (since >= 0) & (since < 2 * speeds / GRAVITY)
    arcs = jnp.sum(jnp.where(flying, speeds * since - 0.5 * GRAVITY * since**2, 0.0), axis=1)
    return jnp.where(fall > FRAMES, height - 0.5 * GRAVITY * FRAMES**2, arcs)


SIDE = 16


def _spot(theta):
    """Brightness of the pixels of a picture of one round spot."""
    across, down, radius, bright = theta
    pixels = jnp.arange(SIDE)
    gauss = lambda centre: jnp.exp(-0.5 * ((pixels - centre) / radius) ** 2)
    return (bright * gauss(down)[:, None] * gauss(across)).reshape(-1)


CELLS, SECONDS, INNER = 20, 50, 10


def _rod(theta):
    """Temperatures at three places of a rod that is heated at one end and loses heat to the air."""
    diffusivity, loss, power = theta

    def step(temperature, _):
        padded = jnp.pad(temperature, 1, mode="edge")
        change = diffusivity * (padded[2:] - 2 * temperature + padded[:-2]) - loss * temperature
        return temperature + (change.at[0].add(power)) / INNER, None

    def second(temperature, _):
        temperature = lax.scan(step, temperature, length=INNER)[0]
        return temperature, temperature[jnp.array([1, 6, 13])]

    return lax.scan(second, jnp.zeros(CELLS), length=SECONDS)[1].reshape(-1)


LENGTHS, SPREAD = jnp.geomspace(0.1, 100.0, 30), 0.15


def _power_law(key, theta):
    """Drag over three decades of size, with proportional errors."""
    factor, exponent = theta
    return factor * LENGTHS**exponent * jnp.exp(SPREAD * jax.random.normal(key, LENGTHS.shape))


def _power_law_likelihood(key, theta, x):
    factor, exponent = theta
    return jnp.sum(stats.norm.logpdf(jnp.log(x), jnp.log(factor) + exponent * jnp.log(LENGTHS), SPREAD))


INTERVALS = 40


def _dead_time(key, theta):
    """Times between counts of a detector that is blind for a while after each."""
    blind, rate = theta
    return blind + jax.random.exponential(key, (INTERVALS,)) / rate


def _dead_time_likelihood(key, theta, x):
    blind, rate = theta
    return jnp.where(jnp.min(x) >= blind, jnp.sum(jnp.log(rate) - rate * (x - blind)), -jnp.inf)


COMMANDS = 2.0 * jnp.sin(SAMPLES * 1.3) * (1 + 0.05 * SAMPLES)


def _backlash(theta):
    """Positions of a gear that follows a known command with play."""
    play, gain, offset = theta

    def step(position, command):
        position = jnp.clip(position, command - play / 2, command + play / 2)
        return position, position

    return gain * lax.scan(step, 0.0, COMMANDS)[1] + offset


def _delayed(theta):
    """A first-order step response with a dead time."""
    gain, lag, delay = theta
    since = jnp.maximum(SAMPLES - delay, 0.0)
    return gain * (1 - jnp.exp(-since / lag))


POSES = jnp.stack([jnp.sin(0.7 * jnp.arange(20)), 1.2 * jnp.cos(1.1 * jnp.arange(20)), 0.9 * jnp.sin(
    1.9 * jnp.arange(20) + 1)], axis=1)  # fmt: skip
"""Angles of an arm's three joints in twenty poses, in radians."""


def _tip(theta):
    """Positions of the tip of an arm in known poses, given its lengths and the zeros of its joints."""
    angles = jnp.cumsum(POSES + jnp.concatenate([jnp.zeros(1), theta[3:]]), axis=1)
    across, up = jnp.cos(angles) @ theta[:3], jnp.sin(angles) @ theta[:3]
    return jnp.stack([across, up], axis=1).reshape(-1)


PROBLEMS = (
    gaussian(
        _change, 0.5, name="change", names=("before", "after", "when"), units=("V", "V", "s"), truth=(1.0, 2.2, 6.3),
        low=(-1.0, 0.0, 2.0), high=(3.0, 5.0, 9.0), phi_low={"when": 0.5}, phi_high={"when": 9.5},
    ),
    gaussian(
        _bounces, 0.03, name="bounces", names=("height", "restitution"), units=("m", ""), truth=(1.1, 0.72),
        low=(0.6, 0.5), high=(1.6, 0.9), phi_high={"restitution": 0.98},
    ),
    gaussian(
        _spot, 0.2, name="spot", names=("across", "down", "radius", "bright"), units=("px", "px", "px", ""),
        truth=(6.2, 9.1, 1.8, 1.0), low=(3.0, 3.0, 0.8, 0.4), high=(12.0, 12.0, 4.0, 2.0), log=("radius", "bright"),
    ),
    gaussian(
        _rod, 0.3, name="rod", names=("diffusivity", "loss", "power"), units=("1/s", "1/s", "K/s"),
        truth=(1.2, 0.03, 1.0), low=(0.3, 0.005, 0.4), high=(3.0, 0.1, 2.0), log=("diffusivity", "loss"),
        phi_high={"diffusivity": 4.5},
    ),
    Problem(
        "power_law", _power_law, ("factor", "exponent"), ("N", ""), (0.8, 1.7), (0.2, 1.0), (3.0, 2.5),
        log=("factor",), log_likelihood=_power_law_likelihood,
    ),
    Problem(
        "dead_time", _dead_time, ("blind", "rate"), ("ms", "1/ms"), (0.5, 0.9), (0.1, 0.3), (1.2, 2.5),
        log=("rate",), log_likelihood=_dead_time_likelihood, phi_low={"blind": 0.01},
    ),
    gaussian(
        _backlash, 0.1, name="backlash", names=("play", "gain", "offset"), units=("rad", "", "rad"),
        truth=(0.7, 1.1, 0.2), low=(0.2, 0.7, -0.5), high=(1.5, 1.6, 0.8), phi_low={"play": 0.01},
    ),
    gaussian(
        _delayed, 0.05, name="delayed", names=("gain", "lag", "delay"), units=("", "s", "s"), truth=(1.0, 1.5, 2.3),
        low=(0.5, 0.5, 0.5), high=(2.0, 4.0, 5.0), log=("lag",), phi_low={"delay": 0.0},
    ),
    gaussian(
        _tip, 0.02, name="calibration", names=("upper", "fore", "hand", "elbow", "wrist"),
        units=("m", "m", "m", "rad", "rad"), truth=(0.42, 0.31, 0.12, 0.05, -0.08), low=(0.3, 0.2, 0.05, -0.3, -0.3),
        high=(0.55, 0.45, 0.25, 0.3, 0.3), phi_low={"hand": 0.01},
    ),
)  # fmt: skip
