"""Renderers: from a frame and a look to a picture and its labels, by name."""

import contextlib
import functools
from collections.abc import Callable, Mapping
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8

from jaxlfi.envs.whip.frames import Frames
from jaxlfi.envs.whip.vision.camera import Camera
from jaxlfi.envs.whip.vision.looks import Look
from jaxlfi.envs.whip.vision.shading import shaded


class Renderer(Protocol):
    """Takes pictures; to be used in `with`."""

    def render(
        self, camera: Camera, frame: Frames, cube_side: float, look: Look
    ) -> tuple[UInt8[np.ndarray, "size size 3"], UInt8[np.ndarray, "size size"]]:
        """The picture of a frame, and the labels of its pixels as in `raster.segmentation`."""

    def __enter__(self) -> "Renderer":
        """Itself."""

    def __exit__(self, *_) -> None:
        """Close it."""


class RayCaster(contextlib.AbstractContextManager):
    """The renderer of `shading`: there is always one.

    Attributes:
        size: of the pictures, in pixels.
    """

    def __init__(self, size: int = 256):
        """Nothing is compiled yet."""
        self.size = size

    def __exit__(self, *_) -> None:
        """Nothing is held."""

    def render(self, camera: Camera, frame: Frames, cube_side: float, look: Look) -> tuple[np.ndarray, np.ndarray]:
        """The picture of a frame, and its labels."""
        single = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), frame)
        rgb, labels = _shaded(camera, single, jnp.float32(cube_side), look, self.size)
        return np.stack(rgb, axis=-1), np.asarray(labels)


@functools.partial(jax.jit, static_argnums=4)
def _shaded(camera, frame, cube_side, look, size):
    rgb, labels = shaded(camera, frame, cube_side, look, size)
    return tuple(jnp.round(255 * channel).astype(jnp.uint8) for channel in rgb), labels.astype(jnp.uint8)


def mujoco_renderer(size: int = 256) -> Renderer:
    """MuJoCo's (`gl`), imported when it is asked for, as it needs libraries of the system."""
    from jaxlfi.envs.whip.vision.gl import MuJoCoRenderer

    return MuJoCoRenderer(size)


RENDERERS: Mapping[str, Callable[..., Renderer]] = {"raycast": RayCaster, "mujoco": mujoco_renderer}
"""Renderers by name."""
