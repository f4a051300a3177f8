"""Observations of a reference object: segmentation images with a camera's noise, and keypoints found in them."""

import dataclasses
import functools
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxlfi.envs.whip.frames import COLOURS, Frames
from jaxlfi.envs.whip.recording import Recording, hit_flags
from jaxlfi.envs.whip.reference_objects.scene import SIMULATOR
from jaxlfi.envs.whip.reference_objects.simulation import FRAME_INTERVAL, ReferenceRig
from jaxlfi.envs.whip.rig import CONTROL_INTERVAL, RGBA
from jaxlfi.envs.whip.vision import masks
from jaxlfi.envs.whip.vision.camera import Camera, project, side_camera
from jaxlfi.envs.whip.vision.raster import noisy, segmentation

IMAGE_SIZE = 256
"""Side of the segmentation images, in pixels (section VI-C)."""
HEX = {name: "#" + "".join(f"{round(255 * channel):02X}" for channel in RGBA[name][:3]) for name in (*COLOURS, "dlo")}
"""Colours of the cubes and the DLO."""


SEEN_THROUGH = "noisy segmentation images"
"""How recordings say that an object was seen by `found`."""


class Perception(Protocol):
    """Finds keypoints in frames of one scene, as `found` does.

    Attributes:
        words: through what it sees, as recordings say it.
    """

    words: str

    def __call__(
        self, key: jax.Array, camera: Camera, frame: Frames, cube_side: Float[Array, ""] | float
    ) -> tuple[Float[np.ndarray, "10 2"], Bool[np.ndarray, "10"]]:
        """Keypoints of a frame, NaN where not seen, and which were seen."""


def look(key: jax.Array, camera: Camera, frame: Frames, cube_side: Float[Array, ""] | float) -> Int[Array, "size size"]:
    """The segmentation image of one frame, with noise; labels as in `jaxlfi.envs.whip.vision.raster`."""
    return noisy(key, segmentation(camera, frame, cube_side, size=IMAGE_SIZE))


def found(
    key: jax.Array, camera: Camera, frame: Frames, cube_side: Float[Array, ""] | float
) -> tuple[Float[Array, "10 2"], Bool[Array, "10"]]:
    """Keypoints found in the segmentation image of one frame, NaN where not seen, and which were seen."""
    grip = project(camera, jnp.stack([frame.gripper[0], jnp.zeros(()), frame.gripper[1]]))
    return masks.keypoints(look(key, camera, frame, cube_side), grip)


def in_every_frame(function, key: jax.Array, camera: Camera, frames: Frames, cube_side: Float[Array, ""] | float):
    """The result of `function` (`look` or `found`) for each frame, with a key per frame; NumPy arrays [F, ...]."""
    frames = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), frames)
    return jax.tree.map(np.asarray, _mapped(function, key, camera, frames, jnp.asarray(cube_side, jnp.float32)))


@functools.partial(jax.jit, static_argnums=0)
def _mapped(function, key, camera, frames, cube_side):
    def one(i):  # not vmap: the images of all frames at once would be large
        frame = jax.tree.map(lambda leaf: leaf[i], frames)
        return function(jax.random.fold_in(key, i), camera, frame, cube_side)

    return jax.lax.map(one, jnp.arange(frames.gripper.shape[0]))


def record(
    key: jax.Array, rig: ReferenceRig, actions: Float[Array, "16 2"], perception: Perception | None = None
) -> tuple[Recording, Frames]:
    """One rollout as a camera sees it, and its true frames.

    Args:
        key: of the camera's noise.
        rig: with the object in its gripper.
        actions: displacements of the gripper's set-point, in m, shape [16, 2].
        perception: what finds keypoints in a frame; by default `found`.
    """
    actions, camera, dlo = np.asarray(actions, float), side_camera(rig.place), rig.dlo
    times, frames = rig.rollout(actions)
    if perception is None:
        keypoints, seen = in_every_frame(found, key, camera, frames, rig.place.cube_side)
    else:
        several = [jax.tree.map(lambda leaf, i=i: leaf[i], frames) for i in range(len(times))]
        keys = [jax.random.fold_in(key, i) for i in range(len(times))]
        looked = [perception(key, camera, frame, rig.place.cube_side) for key, frame in zip(keys, several, strict=True)]
        keypoints, seen = (np.stack(part) for part in zip(*looked, strict=True))
    recording = Recording(
        times=times,
        gripper=frames.gripper,
        keypoints=keypoints,
        seen=seen,
        actions=actions,
        camera=camera,
        source="simulated",
        description=(
            f"FEM reference object for a DLO of silicone, {1e3 * dlo.length:.0f} mm long, Shore {dlo.hardness}: "
            f"seen through {SEEN_THROUGH if perception is None else perception.words}"
        ),
        frame_rate=1 / FRAME_INTERVAL,
        control_interval=CONTROL_INTERVAL,
        image_size=IMAGE_SIZE,
        colours=HEX,
        facts={
            "length (m)": dlo.length,
            "mass (kg)": dlo.mass,
            "Shore hardness": dlo.hardness,
            "effective Young's modulus (Pa)": dlo.effective_young,
            "effective Young's modulus of a DLO of 75 kg/m^3 that moves alike (Pa)": round(dlo.light_young),
        },
        provenance={"simulator": SIMULATOR},
    )
    return dataclasses.replace(recording, hits=hit_flags(recording)), frames
