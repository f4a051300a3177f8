"""Problems with unknown noise, on signals that change by more than the noise from each value to the next.

They were written down before they were run, to judge how well the size of the noise is inferred: an oscillation at few
times, a motor with a fluctuating load under random steps of voltage, and two coupled masses in two channels.
"""

import jax
import jax.numpy as jnp
from jax import lax

from experiments.sharpness.problem import Problem


def _with_unknown_noise(model, **fields) -> Problem:
    """A problem whose observation is a model's series, with Gaussian noise of the last parameter's size."""

    def simulate(key, theta):
        clean = model(theta[:-1])
        return clean + theta[-1] * jax.random.normal(key, clean.shape)

    def log_likelihood(key, theta, x):
        clean = model(theta[:-1])
        return -0.5 * jnp.sum(((x.reshape(clean.shape) - clean) / theta[-1]) ** 2) - clean.size * jnp.log(theta[-1])

    return Problem(simulate=simulate, log_likelihood=log_likelihood, **fields)


FEW = jnp.linspace(0.0, 12.0, 36)


def _vibration(theta):
    """Positions of a mass of 1 from rest, at about three times per period."""
    stiffness, damping = theta
    return 3 * jnp.exp(-damping * FEW / 2) * jnp.cos(jnp.sqrt(stiffness - damping**2 / 4) * FEW)


VOLTAGE = jnp.where(jax.random.bernoulli(jax.random.key(7), 0.5, (70,)), 1.0, -1.0)


def _loaded(key, theta):
    """Speed of a motor under random steps of voltage, with a load that fluctuates: an autoregression with an input."""
    gain, slowing, load = theta

    def step(speed, inputs):
        voltage, noise = inputs
        speed = slowing * speed + gain * voltage + load * noise
        return speed, speed

    return lax.scan(step, jnp.zeros(()), (VOLTAGE, jax.random.normal(key, VOLTAGE.shape)))[1]


def _loaded_likelihood(key, theta, x):
    gain, slowing, load = theta
    before = jnp.concatenate([jnp.zeros(1), x[:-1]])
    errors = (x - slowing * before - gain * VOLTAGE) / load
    return -0.5 * jnp.sum(errors**2) - len(x) * jnp.log(load)


SECONDS = jnp.linspace(0.0, 8.0, 28)


def _coupled(theta):
    """Two equal masses, each held by a spring and joined by another, after a push of the first."""
    outer, inner = theta
    together, apart = jnp.cos(jnp.sqrt(outer) * SECONDS), jnp.cos(jnp.sqrt(outer + 2 * inner) * SECONDS)
    return jnp.stack([together + apart, together - apart], axis=-1)


PROBLEMS = (
    _with_unknown_noise(
        _vibration, name="vibration", names=("stiffness", "damping", "noise"), units=("N/m", "N s/m", "mm"),
        truth=(36.0, 0.25, 0.3), low=(30.0, 0.05, 0.08), high=(42.0, 0.8, 1.0), log=("noise",),
        phi_low={"stiffness": 25.0, "damping": 0.01},
    ),
    Problem(
        "loaded", _loaded, ("gain", "slowing", "load"), ("rad/s", "", "rad/s"), (1.0, 0.6, 0.2),
        (0.3, 0.1, 0.05), (2.0, 0.9, 0.8), log=("load",), log_likelihood=_loaded_likelihood,
        phi_low={"gain": 0.05, "slowing": -0.2}, phi_high={"slowing": 0.97},
    ),
    _with_unknown_noise(
        _coupled, name="coupled", names=("outer", "inner", "noise"), units=("N/m", "N/m", "m"),
        truth=(9.0, 2.0, 0.15), low=(6.0, 0.5, 0.04), high=(13.0, 4.5, 0.6), log=("noise",),
        phi_low={"outer": 4.0, "inner": 0.1},
    ),
)  # fmt: skip
