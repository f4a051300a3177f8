"""The exploratory actions that inference observes a DLO under, and others of the same kind."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.envs.whip.rig import START

_ALONG_X = (-0.03, -0.05, 0.0, 0.055, 0.055, -0.03, -0.05, 0.0, 0.05, 0.03, -0.05, -0.03, 0.05, 0.03, -0.05, 0.0)
_ALONG_Z = (0.02, 0.02, 0.02, 0.02, *(0.0,) * 12)
_BACK, _FRONT = 0.315, 0.435
"""Between which the gripper whips, x in m: as far as the actions above take it."""


def exploratory_actions(seed: int = 0) -> Float[Array, "16 2"]:
    """Draw back and up, then whip to and fro.

    Seed 0, the same actions for every object and simulation where no others are recorded, whips three times at
    increasing frequency, which excites the pendulum of a limp DLO as well as the first bending mode of a stiff one.
    Other seeds take the same steps in a random order, but for the first two: the whips have other lengths and times.

    The gripper keeps at least 1 cm within its workspace, and no DLO of the initial support reaches the cubes or leaves
    the image, so that observations depend smoothly on the DLO. The last two were checked for seeds up to 8.

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
