"""A point mass that is pushed, whose motion is known in closed form."""

import jax.numpy as jnp

from jaxlfi.distributions.space import Space
from jaxlfi.distributions.support import Support

INTERVAL = 0.1
"""Of a push, in s."""
SPACE = Space(("mass",), (True,))
FEASIBLE = Support([0.25], [16.0])
"""Of the mass, in kg."""


def pushed(theta, state, actions):
    """Position (m) and velocity (m/s) after constant forces [n, 1] in N, one interval each, exactly integrated."""
    position, velocity = state
    for (force,) in actions:
        acceleration = force / theta[0]
        position = position + INTERVAL * velocity + 0.5 * INTERVAL**2 * acceleration
        velocity = velocity + INTERVAL * acceleration
    return jnp.stack([position, velocity])
