"""Problems with more numbers than a round has simulations, on which estimates from many numbers were tried.

A damped oscillation at 400 times, and a picture of a bar in 400 pixels.
"""

import jax.numpy as jnp

from experiments.sharpness.curves import gaussian

TIMES, SIDE = jnp.linspace(0, 4, 400), jnp.linspace(-1, 1, 20)


def _spring(theta):
    """A damped oscillation from rest, of mass 1."""
    stiffness, damping = theta
    frequency = jnp.sqrt(jnp.maximum(stiffness - damping * damping / 4, 1e-3))
    return jnp.exp(-damping * TIMES / 2) * jnp.cos(frequency * TIMES)


def _bar(theta):
    """Brightness of the pixels of a picture of a blurred bar."""
    angle, offset, width = theta
    away = jnp.cos(angle) * SIDE[:, None] - jnp.sin(angle) * SIDE - offset
    return jnp.exp(-0.5 * (away / width) ** 2).reshape(-1)


PROBLEMS = (
    gaussian(
        _spring, 0.3, name="wide_spring", names=("k", "c"), units=("", ""), truth=(9.0, 0.6), low=(4.0, 0.1),
        high=(16.0, 1.5),
    ),
    gaussian(
        _bar, 0.3, name="bar", names=("angle", "offset", "width"), units=("rad", "", ""), truth=(0.4, 0.15, 0.25),
        low=(-0.6, -0.5, 0.1), high=(1.2, 0.6, 0.6), log=("width",),
    ),
)  # fmt: skip
