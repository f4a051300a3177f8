"""The exploratory actions under which inference observes a DLO, and others of the same kind."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.envs.whip.rig import START

_ALONG_X = (-0.03, -0.05, 0.0, 0.055, 0.055, -0.03, -0.05, 0.0, 0.05, 0.03, -0.05, -0.03, 0.05, 0.03, -0.05, 0.0)
_ALONG_Z = (0.02, 0.02, 0.02, 0.02, *(0.0,) * 12)
_BACK, _FRONT = 0.315, 0.435
"""Range of the gripper's x while it whips, in m: that of the actions above."""


def exploratory_actions(seed: int = 0) -> Float[Array, "16 2"]:
    """Draw back and up, then whip to and fro.

    Seed 0 gives the actions of every object and simulation for which no others are recorded. They whip three times at
    increasing frequency, which excites the pendulum mode of a limp DLO as well as the first bending mode of a stiff
    one. Other seeds take the same steps in a random order, except for the first two, so that the whips differ in length
    and timing.

    The gripper stays at least 1 cm inside its workspace, and no DLO of the initial support reaches the cubes or leaves
    the image, so that observations depend smoothly on the DLO. The latter two were checked for seeds up to 8.

    Returns:
        Displacements dx, dz of the gripper's set-point, in m, shape [16, 2].
    """
    order, rng = np.arange(len(_ALONG_X)), np.random.default_rng(seed)
    while seed:  # 0 keeps the order
        order[2:] = rng.permutation(order[2:])
        path = START[0] + np.cumsum(np.array(_ALONG_X)[order])
        if _BACK <= path.min() and path.max() <= _FRONT:
            break
    return jnp.stack([jnp.array(_ALONG_X)[order], jnp.array(_ALONG_Z)], axis=-1)
