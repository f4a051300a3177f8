"""A motor that turns an arm, whose parameters form an exact ridge, and a load that breaks it."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.distributions.support import Support
from jaxlfi.tasks.design import Design
from jaxlfi.tasks.task import Task


def arm(load: bool) -> Task:
    """An arm in a horizontal plane on a motor's shaft; a design is the sine that drives it, and maybe a load.

    I angle'' = gear u - damping angle', I = mass / 3 + load for a length of 1 m. Without a load, only two ratios of the
    three parameters affect the motion.
    """
    times, step = np.arange(1, 41) * 0.1, 0.02

    def response(theta, design):
        mass, gear, damping = theta
        inertia = mass / 3 + (design[2] if load else 0.0)

        def advance(state, t):
            angle, speed = state
            torque = gear * design[0] * jnp.sin(2 * jnp.pi * design[1] * t)
            speed = (speed + step * torque / inertia) / (1 + step * damping / inertia)
            return (angle + step * speed, speed), angle

        grid = jnp.arange(round(4.0 / step) + 1) * step
        _, angles = jax.lax.scan(advance, (0.0, 0.0), grid)
        return angles[np.round(times / step).astype(int)]

    def simulate(key, theta, design):
        clean = response(theta, design)
        return clean + 0.01 * jax.random.normal(key, clean.shape)

    truth = np.array([0.5, 2.0, 0.4])
    box = Support(truth / 4, truth * 4)
    loads = {"load": (0.0, 0.5, "kg")} if load else {}
    variables = {"amplitude": (0.05, 0.5, "N m"), "frequency": (0.2, 2.0, "Hz")} | loads
    names = ("mass", "gear", "damping")
    return Task(
        simulate,
        names,
        {"guess": box},
        box,
        units=("kg", "", "N m s/rad"),
        log=names,
        truth=truth,
        name="arm with a load" if load else "arm",
        design=Design(
            variables, {"amplitude": 0.2, "frequency": 0.5} | dict.fromkeys(loads, 0.0), response=response, noise=0.01
        ),
    )
