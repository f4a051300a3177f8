"""Curves and fields with Gaussian noise, and linear models: problems whose likelihoods are immediate."""

import dataclasses
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy import special

from experiments.sharpness.problem import Linear, Problem

T40, T25, T20, T15 = jnp.linspace(0, 4, 40), jnp.linspace(0, 5, 25), jnp.linspace(0, 10, 20), jnp.linspace(0, 6, 15)


def gaussian(model: Callable, noise: float, **fields) -> Problem:
    """A problem whose observation is a model's series, with Gaussian noise of one standard deviation."""

    def simulate(key, theta):
        x = model(theta)
        return x + noise * jax.random.normal(key, x.shape)

    def log_likelihood(key, theta, x):
        return -0.5 * jnp.sum(((x - model(theta)) / noise) ** 2)

    return Problem(simulate=simulate, log_likelihood=log_likelihood, **fields)


def linear(matrix: np.ndarray, noise: float, **fields) -> Problem:
    """A linear model with Gaussian noise."""
    weights = jnp.asarray(matrix, jnp.float32)

    def simulate(key, theta):
        return weights @ theta + noise * jax.random.normal(key, (len(weights),))

    return Problem(simulate=simulate, linear=Linear(np.asarray(matrix, float), noise), **fields)


def _spring(theta):
    """A damped oscillation from rest, of mass 1."""
    stiffness, damping = theta
    frequency = jnp.sqrt(jnp.maximum(stiffness - damping * damping / 4, 1e-3))
    return jnp.exp(-damping * T40 / 2) * jnp.cos(frequency * T40)


def _oscillation(theta):
    return theta[0] * jnp.sin(theta[1] * T25) * jnp.exp(-0.1 * T25)


def _logistic(theta):
    rate, capacity, first = theta
    return capacity / (1 + (capacity / first - 1) * jnp.exp(-rate * T20))


def _thermocouple(theta):
    """Volts."""
    return 4e-5 * theta[0] * (1 - jnp.exp(-T20 / theta[1]))


def _decay(theta):
    return theta[0] * jnp.exp(-theta[1] * T15) + theta[2]


def _sliding(theta):
    """Positions of a block that slides on a level table until it rests."""
    friction, speed = theta
    deceleration = 9.81 * friction
    time = jnp.minimum(jnp.linspace(0.05, 1.0, 20), speed / jnp.maximum(deceleration, 1e-6))
    return speed * time - 0.5 * deceleration * time**2


CONCENTRATIONS = jnp.linspace(0.05, 1.5, 15)


def _enzyme(theta):
    """Rates at concentrations far below the half-saturation: their ratio is what is measured."""
    fastest, half = theta
    return fastest * CONCENTRATIONS / (half + CONCENTRATIONS)


TIMES10 = jnp.linspace(0.1, 1.0, 10)


def _squared(theta):
    """A quantity that depends on the square of a speed and drifts: the speed's sign is not observed."""
    speed, drift = theta
    return 0.5 * speed**2 * TIMES10 + drift


def _ranges(theta):
    """Ten measurements of the distance from a beacon."""
    return jnp.full(10, jnp.sqrt(theta[0] ** 2 + theta[1] ** 2))


FREEDOM = 3


@dataclasses.dataclass(frozen=True)
class StudentT:
    """A prior with heavy tails: independent Student's t of `FREEDOM` degrees of freedom and scale 1."""

    dim: int

    def sample(self, *, seed, sample_shape=()):
        """Draws of shape [*sample_shape, D]."""
        shape = (sample_shape,) if isinstance(sample_shape, int) else tuple(sample_shape)
        normal = jax.random.normal(seed, (FREEDOM + 1, *shape, self.dim))
        return normal[0] / jnp.sqrt(jnp.mean(normal[1:] ** 2, axis=0))

    def log_prob(self, value):
        """Log-density of vectors [..., D]."""
        half, n = 0.5 * (FREEDOM + 1), float(FREEDOM)
        constant = special.gammaln(half) - special.gammaln(0.5 * n) - 0.5 * jnp.log(n * math.pi)
        return jnp.sum(constant - half * jnp.log1p(value**2 / n), axis=-1)


def _design(rows: int, columns: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(rows, columns)) / np.sqrt(rows)


_NAMES = {dim: tuple(f"p{d + 1}" for d in range(dim)) for dim in (2, 3, 4, 5, 8, 20)}
_ONES = {dim: ("",) * dim for dim in _NAMES}
_TIMES5 = jnp.linspace(-1, 1, 6)

PROBLEMS = (
    gaussian(
        _spring, 0.05, name="spring", names=("stiffness", "damping"), units=("N/m", "N s/m"), truth=(12.0, 0.4),
        low=(1.0, 0.05), high=(40.0, 2.0), log=("stiffness", "damping"),
    ),
    gaussian(
        _oscillation, 0.1, name="oscillator", names=("amplitude", "frequency"), units=("m", "rad/s"),
        truth=(1.5, 1.7), low=(0.2, 0.5), high=(4.0, 4.0), phi_low={"amplitude": 0.0, "frequency": 0.1},
    ),
    linear(
        np.linspace(-1, 1, 30)[:, None] ** np.arange(5), 0.2, name="polynomial", names=_NAMES[5], units=_ONES[5],
        truth=(0.5, -1.0, 0.8, 0.3, -0.6), low=(-3.0,) * 5, high=(3.0,) * 5,
    ),
    gaussian(
        _logistic, 2.0, name="logistic_growth", names=("rate", "capacity", "first"), units=("1/d", "kg", "kg"),
        truth=(0.8, 100.0, 3.0), low=(0.1, 20.0, 0.5), high=(3.0, 300.0, 20.0), log=("rate", "capacity", "first"),
    ),
    gaussian(
        _thermocouple, 1e-4, name="thermocouple", names=("rise", "time constant"), units=("K", "s"),
        truth=(100.0, 2.0), low=(10.0, 0.2), high=(300.0, 10.0), phi_low={"rise": 1.0, "time constant": 0.05},
    ),
    gaussian(
        _decay, 0.05, name="decay_offset", names=("height", "rate", "offset"), units=("V", "1/s", "V"),
        truth=(2.0, 0.5, 0.2), low=(0.2, 0.05, -1.0), high=(5.0, 3.0, 1.0), log=("height", "rate"),
    ),
    linear(
        _design(6, 2, 2), 0.2, name="linear_2", names=_NAMES[2], units=_ONES[2], truth=(0.7, -0.4),
        low=(-3.0, -3.0), high=(3.0, 3.0), shaped=True,
    ),
    # The last three parameters do nothing.
    linear(
        np.concatenate([_design(12, 5, 8), np.zeros((12, 3))], axis=1), 0.2, name="linear_8", names=_NAMES[8],
        units=_ONES[8], truth=(0.5, -0.7, 0.2, 1.0, -0.3, 0.0, 0.4, -0.8), low=(-3.0,) * 8, high=(3.0,) * 8,
        informed=_NAMES[8][:5], open=_NAMES[8][5:], shaped=True,
    ),
    linear(
        _design(40, 20, 20), 0.3, name="linear_20", names=_NAMES[20], units=_ONES[20],
        truth=tuple(np.round(np.random.default_rng(20).uniform(-1, 1, 20), 2).tolist()), low=(-3.0,) * 20,
        high=(3.0,) * 20, shaped=True,
    ),
    # No friction is negative, and the true one is nearly none.
    gaussian(
        _sliding, 0.05, name="friction", names=("friction", "speed"), units=("", "m/s"), truth=(0.005, 1.5),
        low=(0.0, 0.3), high=(0.3, 3.0), phi_low={"friction": 0.0, "speed": 0.05}, informed=("speed",),
        open=("friction",),
    ),
    gaussian(
        lambda theta: theta[0] + theta[1] * _TIMES5, 1.0, name="heavy_tails", names=("level", "slope"),
        units=("", ""), truth=(1.5, -2.0), low=(-6.0, -6.0), high=(6.0, 6.0), prior=StudentT(2),
        informed=("level",),
    ),
    gaussian(
        _squared, 0.15, name="two_modes", names=("speed", "drift"), units=("m/s", "J"), truth=(1.6, 0.3),
        low=(-3.0, -1.0), high=(3.0, 2.0), informed=("drift",), open=("speed",), shaped=True,
    ),
    gaussian(
        _enzyme, 0.08, name="ridge", names=("fastest", "half-saturation"), units=("mol/s", "mol/l"),
        truth=(8.0, 4.0), low=(1.0, 0.3), high=(60.0, 40.0), log=("fastest", "half-saturation"), shaped=True,
    ),
    gaussian(
        _ranges, 0.2, name="circle", names=("east", "north"), units=("m", "m"), truth=(1.2, 0.9),
        low=(-3.0, -3.0), high=(3.0, 3.0), open=("east", "north"), shaped=True,
    ),
)  # fmt: skip

LEANING = (
    linear(
        _design(6, 2, 22), 1.0, name="leaning_2", names=_NAMES[2], units=_ONES[2], truth=(0.05, 1.9),
        low=(0.0, -3.0), high=(2.0, 2.0), shaped=True,
    ),
    linear(
        _design(8, 4, 24), 1.0, name="leaning_4", names=_NAMES[4], units=_ONES[4], truth=(0.05, 1.9, 0.3, -0.5),
        low=(0.0, -3.0, -3.0, -3.0), high=(2.0, 2.0, 3.0, 3.0), shaped=True,
    ),
    # Of the first two parameters little is known beyond their bounds.
    linear(
        _design(6, 3, 23), 3.0, name="leaning_3", names=_NAMES[3], units=_ONES[3], truth=(0.5, 0.5, 0.5),
        low=(0.0, 0.0, -3.0), high=(1.0, 1.0, 3.0), shaped=True,
    ),
)  # fmt: skip
"""Linear models whose posteriors lean on bounds of their boxes; written down after the held-out problems were."""
