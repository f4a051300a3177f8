"""A camera that is pointed at a scene: pictures of its frames, and the keypoints that a detector finds in them."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from jaxlfi.envs.whip.frames import Frames
from jaxlfi.envs.whip.vision import looks, photograph
from jaxlfi.envs.whip.vision.camera import Camera, project
from jaxlfi.envs.whip.vision.detectors import KeypointDetector
from jaxlfi.envs.whip.vision.looks import Look
from jaxlfi.envs.whip.vision.raster import noisy
from jaxlfi.envs.whip.vision.renderers import Renderer


class Photographer:
    """Sees one scene, whose look and whose camera's faults are drawn at random and stay the same; noise does not.

    Attributes:
        renderer: takes the pictures.
        detector: finds keypoints in them.
        words: through what the scene is seen, as recordings say it.
    """

    def __init__(self, key: jax.Array, renderer: Renderer, detector: KeypointDetector, words: str = "pictures"):
        """The look is drawn with the first frame."""
        self.renderer, self.detector, self.words = renderer, detector, words
        self._key_look, key_shot = jax.random.split(key)
        self._shot = photograph.draw(key_shot)
        self._look: Look | None = None

    def __call__(
        self, key: jax.Array, camera: Camera, frame: Frames, cube_side: Float[Array, ""] | float
    ) -> tuple[Float[np.ndarray, "10 2"], Bool[np.ndarray, "10"]]:
        """Keypoints of a frame in normalised pixels, NaN where not seen, and which were seen.

        Args:
            key: of the noise.
            camera: that sees the frame.
            frame: what is seen.
            cube_side: side of the cubes, in m.
        """
        x, z = frame.gripper
        grip = project(camera, jnp.array([x, 0.0, z], jnp.float32))
        keypoints, seen = self.detector(self.picture(key, camera, frame, cube_side), grip)
        return np.asarray(keypoints), np.asarray(seen)

    def picture(
        self, key: jax.Array, camera: Camera, frame: Frames, cube_side: Float[Array, ""] | float
    ) -> UInt8[np.ndarray, "size size 3"] | UInt8[np.ndarray, "size size"]:
        """What the detector is given: a picture, or labels with their noise (`raster.noisy`) where it reads these."""
        if self._look is None:
            drawn = looks.draw(self._key_look, jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), frame))
            hand = drawn.clutter.there.at[-1].set(False)  # a momentary occlusion must not last
            self._look = jax.device_get(drawn.replace(clutter=drawn.clutter.replace(there=hand)))
        rgb, labels = self.renderer.render(camera, frame, float(cube_side), self._look)
        return np.asarray(
            _mislabelled(key, labels) if self.detector.reads == "labels" else _taken(key, self._shot, rgb)
        )


_mislabelled = jax.jit(lambda key, labels: noisy(key, labels.astype(jnp.int32)))


@jax.jit
def _taken(key, shot, rgb):
    taken = photograph.taken(key, shot, rgb.astype(jnp.float32) / 255)
    return jnp.round(255 * taken).astype(jnp.uint8)
