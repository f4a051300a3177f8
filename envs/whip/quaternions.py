"""Unit quaternions (w, x, y, z), as MuJoCo describes orientations."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def product(a: Float[Array, "*n 4"], b: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
    """The Hamilton product a b: the rotation b followed by the rotation a.

    Example:
        >>> import jax.numpy as jnp
        >>> i, j = jnp.eye(4)[1], jnp.eye(4)[2]
        >>> product(i, j).tolist()
        [0.0, 0.0, 0.0, 1.0]
    """
    (s, u), (t, v) = ((q[..., :1], q[..., 1:]) for q in (a, b))
    scalar = s * t - jnp.sum(u * v, axis=-1, keepdims=True)
    return jnp.concatenate([scalar, s * v + t * u + jnp.cross(u, v)], axis=-1)


def normalised(quaternions: Float[Array, "*n 4"]) -> Float[Array, "*n 4"]:
    """The same orientations as quaternions of length 1."""
    return quaternions / jnp.linalg.norm(quaternions, axis=-1, keepdims=True)


def rotation(quaternions: Float[Array, "*n 4"]) -> Float[Array, "*n 3 3"]:
    """The rotation matrices of unit quaternions; their columns are the rotated axes."""
    w, x, y, z = jnp.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
