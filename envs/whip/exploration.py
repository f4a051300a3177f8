"""The exploratory actions that inference observes a DLO under, the same for every object and simulation."""

import jax.numpy as jnp
from jaxtyping import Array, Float

_ALONG_X = (-0.03, -0.05, 0.0, 0.055, 0.055, -0.03, -0.05, 0.0, 0.05, 0.03, -0.05, -0.03, 0.05, 0.03, -0.05, 0.0)
_ALONG_Z = (0.02, 0.02, 0.02, 0.02, *(0.0,) * 12)


def exploratory_actions() -> Float[Array, "16 2"]:
    """Draw back and up, then whip to and fro three times, at increasing frequency.

    The gripper keeps at least 1 cm within its workspace, and no DLO of the initial support reaches the cubes or leaves
    the image, so that observations depend smoothly on the DLO. The three frequencies excite the pendulum of
    a limp DLO as well as the first bending mode of a stiff one.

    Returns:
        Displacements dx, dz of the gripper's set-point, in m, shape [16, 2].
    """
    return jnp.stack([jnp.array(_ALONG_X), jnp.array(_ALONG_Z)], axis=-1)
