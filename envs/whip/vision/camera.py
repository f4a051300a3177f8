"""The side camera: projection of points in the world to the image."""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float

from jaxlfi.envs.whip.parameters import WhipParameters
from jaxlfi.envs.whip.quaternions import rotation


class Camera(struct.PyTreeNode):
    """A pinhole camera with a square image; written for one, vmap for many.

    Attributes:
        position: of the pinhole, in m, shape [3].
        orientation: a unit quaternion (w, x, y, z), shape [4]. It rotates the camera's own axes (x to the right of the
            image, y up, z backwards, out of its back) into the world's, as in MuJoCo and OpenGL.
        field_of_view: angle across the whole image, in degrees.
    """

    position: Float[Array, "3"]
    orientation: Float[Array, "4"]
    field_of_view: Float[Array, ""] | float

    @property
    def focal_length(self) -> Float[Array, ""]:
        """Distance from the pinhole to the image, in widths of the image."""
        return 0.5 / jnp.tan(0.5 * jnp.deg2rad(self.field_of_view))


PLACE = (0.45, -0.9, 0.25)
"""Position of the side camera, in m."""
FIELD_OF_VIEW = 36.87
"""Field of view of the side camera, in degrees: 0.6 m across at y = 0."""
ALONG_Y = (0.5**0.5, 0.5**0.5, 0.0, 0.0)
"""The orientation of a camera that looks along +y, with z up."""


def side_camera(parameters: WhipParameters) -> Camera:
    """The camera of one scene, displaced by `parameters.camera` (sections VI-A and VI-H)."""
    return Camera(
        position=jnp.asarray(PLACE) + jnp.asarray(parameters.camera),
        orientation=jnp.asarray(ALONG_Y),
        field_of_view=jnp.asarray(FIELD_OF_VIEW),
    )


def project(camera: Camera, points: Float[Array, "*n 3"]) -> Float[Array, "*n 2"]:
    """Positions in the image of points in the world, in m.

    Returns:
        Normalised pixels (u, v), shape [..., 2]: u to the right and v down, each 0 to 1 across the image and beyond
        that outside of it; NaN for points that are not in front of the camera.
    """
    # Highest precision: accelerators otherwise multiply matrices with 10 bits, an error of a pixel.
    local = jnp.matmul(points - camera.position, rotation(camera.orientation), precision="highest")
    depth = -local[..., 2:]
    sideways = local[..., :2] * jnp.array([1.0, -1.0])
    return jnp.where(depth > 0, 0.5 + camera.focal_length * sideways / depth, jnp.nan)
