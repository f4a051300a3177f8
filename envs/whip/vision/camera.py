"""The camera that watches from the side: from points in the world to places in the image."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.envs.whip.parameters import WhipParameters


@struct.dataclass
class Camera:
    """A pinhole camera with a square image; written for one, vmap for many.

    Attributes:
        position: of the pinhole, in m, shape [3].
        turn: its orientation as a unit quaternion (w, x, y, z), shape [4]. It turns the camera's own axes (x to the
            right of the image, y up, z backwards, out of its back) into the world's, as MuJoCo and OpenGL have it.
        field_of_view: angle across the whole image, in degrees.
    """

    position: Float[Array, "3"]
    turn: Float[Array, "4"]
    field_of_view: Float[Array, ""] | float

    @property
    def focal_length(self) -> Float[Array, ""]:
        """Distance from the pinhole to the image, in widths of the image."""
        return 0.5 / jnp.tan(0.5 * jnp.deg2rad(self.field_of_view))


PLACE = (0.45, -0.9, 0.25)
"""Where the side camera stands, in m."""
FIELD_OF_VIEW = 36.87
"""Of the side camera, in degrees: 0.6 m across at y = 0."""
ALONG_Y = (0.5**0.5, 0.5**0.5, 0.0, 0.0)
"""The orientation of a camera that looks along +y, with z up."""


def side_camera(parameters: WhipParameters) -> Camera:
    """The camera of one scene, in its place displaced by `parameters.camera` (sections VI-A and VI-H)."""
    return Camera(
        position=jnp.asarray(PLACE) + jnp.asarray(parameters.camera),
        turn=jnp.asarray(ALONG_Y),
        field_of_view=jnp.asarray(FIELD_OF_VIEW),
    )


def rotation(turn: Float[Array, "*n 4"]) -> Float[Array, "*n 3 3"]:
    """The rotation matrix of a unit quaternion (w, x, y, z); its columns are the turned axes."""
    w, x, y, z = jnp.moveaxis(turn, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def project(camera: Camera, points: Float[Array, "*n 3"]) -> Float[Array, "*n 2"]:
    """Where points of the world, in m, are seen.

    Returns:
        Normalised pixels (u, v), shape [..., 2]: u to the right and v down, each 0 to 1 across the image and beyond
        that outside of it; NaN for points that are not in front of the camera.
    """
    # Highest precision, as accelerators otherwise multiply matrices with 10 bits, which is a pixel.
    local = jnp.matmul(points - camera.position, rotation(camera.turn), precision="highest")
    depth = -local[..., 2:]
    sideways = local[..., :2] * jnp.array([1.0, -1.0])
    return jnp.where(depth > 0, 0.5 + camera.focal_length * sideways / depth, jnp.nan)
