"""Problems of robotics that were written down, and committed, when settings were final, to judge the default call.

The pose of a robot, the friction of its tyres and joints, its battery, an object that it drops, a drone in the wind,
the inertia of an arm, a camera, and a laser scanner with false readings. One is from statistics: g-and-k quantiles.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy import stats

from experiments.sharpness.curves import gaussian
from experiments.sharpness.problem import Problem

LANDMARKS = jnp.array([[0.0, 0.0], [6.0, 1.0], [5.0, 7.0], [-1.0, 6.0]])
RANGE, BEARING = 0.15, 0.04
"""Noise of distances (m) and bearings (rad)."""


def _seen(theta):
    """Distances and bearings of landmarks from a place and heading."""
    x, y, heading = theta
    away = LANDMARKS - jnp.stack([x, y])
    angle = jnp.arctan2(away[:, 1], away[:, 0]) - heading
    return jnp.linalg.norm(away, axis=1), jnp.arctan2(jnp.sin(angle), jnp.cos(angle))


def _localisation(key, theta):
    distance, bearing = _seen(theta)
    noise = jax.random.normal(key, (2, len(LANDMARKS)))
    return jnp.concatenate([distance + RANGE * noise[0], bearing + BEARING * noise[1]])


def _localisation_likelihood(key, theta, x):
    distance, bearing = _seen(theta)
    errors = x - jnp.concatenate([distance, bearing])
    return -0.5 * jnp.sum((errors / jnp.repeat(jnp.array([RANGE, BEARING]), len(LANDMARKS))) ** 2)


SLIPS = jnp.linspace(0.01, 0.4, 24)


def _tyre(theta):
    """Friction of a tyre as a function of slip, by Pacejka's formula."""
    stiffness, shape, peak = theta
    return peak * jnp.sin(shape * jnp.arctan(stiffness * SLIPS))


SPEEDS = jnp.linspace(0.02, 2.0, 40)


def _stribeck(theta):
    """Friction torque of a joint as a function of speed, after Stribeck."""
    coulomb, stiction, speed, viscous = theta
    return coulomb + stiction * jnp.exp(-((SPEEDS / speed) ** 2)) + viscous * SPEEDS


CURRENT, SECOND = jnp.where((jnp.arange(60) // 10) % 2 == 1, 4.0, 0.5), 1.0


def _battery(theta):
    """Voltage of a battery under pulses of current: a resistance in series with a resistance and capacity."""
    series, parallel, time = theta

    def step(voltage, current):
        voltage = voltage + SECOND / time * (parallel * current - voltage)
        return voltage, 12.0 - series * current - voltage

    return lax.scan(step, jnp.zeros(()), CURRENT)[1]


FRAMES, STEP, STEPS = 60, 0.001, 20
"""Number of camera frames of a falling object, and the simulation's step (s) and steps per frame."""


def _dropped(theta):
    """Height of an object that falls on a pad, which is a spring and a damper."""
    stiffness, damping, height = theta

    def step(state, _):
        place, speed = state
        force = jnp.where(place < 0, jnp.maximum(-stiffness * place - damping * speed, 0.0), 0.0)
        speed = speed + STEP * (force - 9.81)
        return (place + STEP * speed, speed), None

    def frame(state, _):
        state = lax.scan(step, state, None, STEPS)[0]
        return state, state[0]

    return lax.scan(frame, (height, jnp.zeros(())), None, FRAMES)[1]


THRUST, PERIOD, SPEED_NOISE = jnp.where((jnp.arange(80) // 16) % 2 == 0, 1.0, -1.0), 0.1, 0.05


def _drone(key, theta):
    """Vertical speed of a drone that goes up and down in gusts, as its sensor measures it."""
    gain, drag, gusts = theta
    key_gusts, key_noise = jax.random.split(key)

    def step(speed, inputs):
        thrust, gust = inputs
        speed = (1 - PERIOD * drag) * speed + PERIOD * gain * thrust + gusts * gust
        return speed, speed

    speed = lax.scan(step, jnp.zeros(()), (THRUST, jax.random.normal(key_gusts, THRUST.shape)))[1]
    return speed + SPEED_NOISE * jax.random.normal(key_noise, THRUST.shape)


def _drone_likelihood(key, theta, x):
    """By a Kalman filter."""
    gain, drag, gusts = theta

    def step(state, inputs):
        mean, variance = state
        thrust, reading = inputs
        mean = (1 - PERIOD * drag) * mean + PERIOD * gain * thrust
        variance = (1 - PERIOD * drag) ** 2 * variance + gusts**2
        total = variance + SPEED_NOISE**2
        log_p = -0.5 * (reading - mean) ** 2 / total - 0.5 * jnp.log(total)
        share = variance / total
        return (mean + share * (reading - mean), (1 - share) * variance), log_p

    return jnp.sum(lax.scan(step, (jnp.zeros(()), jnp.zeros(())), (THRUST, x))[1])


SECONDS = jnp.linspace(0.0, 3.0, 40)


def _arm(theta):
    """Torques of an arm of two links of 0.4 and 0.3 m along a given motion, by its masses and friction."""
    upper, lower, friction_1, friction_2, offset = theta
    q1, q2 = jnp.sin(2 * SECONDS), 0.8 * jnp.sin(3 * SECONDS + 1)
    v1, v2 = 2 * jnp.cos(2 * SECONDS), 2.4 * jnp.cos(3 * SECONDS + 1)
    a1, a2 = -4 * jnp.sin(2 * SECONDS), -7.2 * jnp.sin(3 * SECONDS + 1)
    l1, l2, g = 0.4, 0.3, 9.81
    m11 = (upper / 3 + lower) * l1**2 + lower * (l2**2 / 3 + l1 * l2 * jnp.cos(q2))
    m12 = lower * (l2**2 / 3 + 0.5 * l1 * l2 * jnp.cos(q2))
    coriolis = 0.5 * lower * l1 * l2 * jnp.sin(q2)
    weight_2 = 0.5 * lower * g * l2 * jnp.cos(q1 + q2)
    torque_1 = m11 * a1 + m12 * a2 - coriolis * (2 * v1 * v2 + v2**2)
    torque_1 += (0.5 * upper + lower) * g * l1 * jnp.cos(q1) + weight_2 + friction_1 * v1 + offset
    torque_2 = m12 * a1 + lower * l2**2 / 3 * a2 + coriolis * v1**2 + weight_2 + friction_2 * v2
    return jnp.stack([torque_1, torque_2], axis=-1)


GRID = jnp.stack(jnp.meshgrid(jnp.linspace(-0.5, 0.5, 5), jnp.linspace(-0.4, 0.4, 4)), axis=-1).reshape(-1, 2)


def _camera(theta):
    """Pixels of a flat board one metre away, through a lens with radial distortion, tilted about its vertical axis."""
    focal, distortion, tilt = theta
    x, y = GRID[:, 0] * jnp.cos(tilt), GRID[:, 1]
    depth = 1 + GRID[:, 0] * jnp.sin(tilt)
    u, v = x / depth, y / depth
    lens = focal * (1 + distortion * (u**2 + v**2))
    return jnp.stack([lens * u, lens * v], axis=-1)


BEAMS, FARTHEST = jnp.linspace(-0.9, 0.9, 60), 10.0


def _wall(theta):
    distance, angle = theta[:2]
    return distance / jnp.cos(BEAMS - angle)


def _scanner(key, theta):
    """Distances to a wall from a laser scanner, a share of whose readings are false."""
    spread, false = theta[2:]
    keys = jax.random.split(key, 3)
    right = _wall(theta) + spread * jax.random.normal(keys[0], BEAMS.shape)
    wrong = FARTHEST * jax.random.uniform(keys[1], BEAMS.shape)
    return jnp.where(jax.random.uniform(keys[2], BEAMS.shape) < false, wrong, right)


def _scanner_likelihood(key, theta, x):
    spread, false = theta[2:]
    right = jnp.log1p(-false) + stats.norm.logpdf(x, _wall(theta), spread)
    wrong = jnp.where((x > 0) & (x < FARTHEST), jnp.log(false / FARTHEST), -jnp.inf)
    return jnp.sum(jnp.logaddexp(right, wrong))


DRAWS = 80


def _quantile(theta, z):
    """Quantile of the g-and-k distribution at a standard normal's z."""
    place, scale, skew, kurtosis = theta
    return place + scale * (1 + 0.8 * jnp.tanh(0.5 * skew * z)) * (1 + z * z) ** kurtosis * z


def _quantiles(key, theta):
    """Draws of a g-and-k distribution, in order of size."""
    return jnp.sort(_quantile(theta, jax.random.normal(key, (DRAWS,))))


def _quantiles_likelihood(key, theta, x):
    """From the z of each draw, found by bisection, and the slope of the quantiles there."""
    low, high = jnp.full(x.shape, -8.0), jnp.full(x.shape, 8.0)

    def halve(_, bounds):
        low, high = bounds
        middle = 0.5 * (low + high)
        below = _quantile(theta, middle) < x
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    slope = jax.vmap(jax.grad(_quantile, argnums=1), in_axes=(None, 0))
    z = 0.5 * sum(lax.fori_loop(0, 40, halve, (low, high)))
    z = z - (_quantile(theta, z) - x) / slope(theta, z)  # by Newton's method, which has derivatives
    return jnp.sum(stats.norm.logpdf(z) - jnp.log(slope(theta, z)))


PROBLEMS = (
    Problem(
        "localisation", _localisation, ("x", "y", "heading"), ("m", "m", "rad"), (2.2, 3.1, 0.4),
        (0.5, 1.0, -0.3), (4.5, 5.5, 1.0), log_likelihood=_localisation_likelihood,
    ),
    gaussian(
        _tyre, 0.03, name="tyre", names=("stiffness", "shape", "peak"), units=("", "", ""),
        truth=(12.0, 1.6, 0.9), low=(6.0, 1.2, 0.5), high=(25.0, 2.0, 1.4), log=("stiffness",), phi_low={"peak": 0.1},
    ),
    gaussian(
        _stribeck, 0.03, name="stribeck", names=("coulomb", "stiction", "speed", "viscous"),
        units=("N m", "N m", "rad/s", "N m s"), truth=(0.5, 0.4, 0.3, 0.2), low=(0.2, 0.1, 0.1, 0.0),
        high=(0.9, 0.9, 0.8, 0.5), log=("speed",), phi_low={"coulomb": 0.0, "stiction": 0.0, "viscous": -0.1},
    ),
    gaussian(
        _battery, 0.01, name="battery", names=("series", "parallel", "time"), units=("Ohm", "Ohm", "s"),
        truth=(0.05, 0.03, 6.0), low=(0.01, 0.005, 2.5), high=(0.12, 0.08, 20.0), log=("time",),
        phi_low={"series": 0.0, "parallel": 0.0},
    ),
    gaussian(
        _dropped, 0.01, name="dropped", names=("stiffness", "damping", "height"), units=("1/s^2", "1/s", "m"),
        truth=(3000.0, 15.0, 0.5), low=(1000.0, 4.0, 0.4), high=(8000.0, 40.0, 0.6), log=("stiffness", "damping"),
    ),
    Problem(
        "drone", _drone, ("gain", "drag", "gusts"), ("m/s^2", "1/s", "m/s"), (2.0, 0.8, 0.1),
        (0.8, 0.2, 0.03), (4.0, 2.0, 0.3), log=("gusts",), log_likelihood=_drone_likelihood,
        phi_low={"gain": 0.1, "drag": 0.02},
    ),
    gaussian(
        _arm, 0.4, name="arm_torques", names=("upper", "lower", "friction_1", "friction_2", "offset"),
        units=("kg", "kg", "N m s", "N m s", "N m"), truth=(2.0, 1.2, 0.5, 0.3, 0.2), low=(0.8, 0.5, 0.0, 0.0, -1.0),
        high=(4.0, 2.5, 1.5, 1.0, 1.0), phi_low={"upper": 0.1, "lower": 0.1, "friction_1": -0.5, "friction_2": -0.4},
    ),
    gaussian(
        _camera, 1.0, name="camera", names=("focal", "distortion", "tilt"), units=("px", "", "rad"),
        truth=(420.0, -0.15, 0.2), low=(350.0, -0.4, -0.1), high=(500.0, 0.1, 0.5),
    ),
    Problem(
        "scanner", _scanner, ("distance", "angle", "spread", "false"), ("m", "rad", "m", ""), (3.0, 0.2, 0.05, 0.15),
        (1.5, -0.2, 0.02, 0.03), (5.0, 0.5, 0.15, 0.4), log=("spread",), log_likelihood=_scanner_likelihood,
        phi_low={"distance": 0.5, "angle": -0.5, "false": 0.01}, phi_high={"angle": 0.6, "false": 0.6},
    ),
    Problem(
        "quantiles", _quantiles, ("place", "scale", "skew", "kurtosis"), ("", "", "", ""), (3.0, 1.0, 1.5, 0.3),
        (2.0, 0.4, 0.0, 0.0), (4.5, 2.5, 4.0, 0.8), log_likelihood=_quantiles_likelihood,
        phi_low={"scale": 0.1, "skew": -1.0, "kurtosis": 0.0}, phi_high={"kurtosis": 1.0},
    ),
)  # fmt: skip
