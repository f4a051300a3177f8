"""Keypoints by projection: where a learnt detector would see the cubes and the DLO, and how it errs."""

import types
from collections.abc import Mapping

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.envs.whip.frames import Frames
from jaxlfi.envs.whip.vision.camera import Camera, project

ON_DLO = 4
"""Keypoints of the DLO; they come before those of the cubes (section VI-C)."""
KEYPOINTS = ON_DLO + 6
"""All keypoints."""


@struct.dataclass
class Detector:
    """What a learnt detector of keypoints does to the truth; its numbers can be vmapped over.

    It tracks four points of the DLO. Where they lie is drawn once a trajectory, uniformly among all places from
    `nearest` to `farthest` that are at least `spacing` apart: a spacing of a third of that range leaves one choice, so
    they are then fixed and equally spaced. Cubes come from their masks: they have a noise of their own, and are never
    missing.

    Attributes:
        nearest: least distance from the grip, as a fraction of the DLO's length.
        farthest: greatest distance; 1 is the tip.
        spacing: least distance between neighbours.
        shuffled: probability that a trajectory's four come in a random order, the same in all its frames
            ("temporally consistent, but permutation invariance is not guaranteed", section VI-G).
        noise: standard deviation of each coordinate of the DLO's points in each frame, in normalised pixels.
        cube_noise: the same of the cubes', whose masks have centroids that hardly move.
        missing: probability that a point of the DLO is not found in a frame; it then stays where it was last seen.
        bias: standard deviation of each coordinate's error that lasts through a trajectory, in normalised pixels.
        slip: standard deviation of what the gripper's measured x and z are off in each frame, in m.
    """

    nearest: Float[Array, ""] | float = 0.25
    farthest: Float[Array, ""] | float = 1.0
    spacing: Float[Array, ""] | float = 0.25
    shuffled: Float[Array, ""] | float = 0.0
    noise: Float[Array, ""] | float = 0.0
    cube_noise: Float[Array, ""] | float = 0.0
    missing: Float[Array, ""] | float = 0.0
    bias: Float[Array, ""] | float = 0.0
    slip: Float[Array, ""] | float = 0.0


CLEAN = Detector()
"""The truth at the quarters of the DLO, the last at its tip."""
MASK = Detector(noise=0.004, cube_noise=0.001, bias=0.005, slip=0.002)
"""The same as it is found along the DLO's segmentation mask (`jaxlfi.envs.whip.vision.masks`), a pixel off here and there, beside a
gripper that follows its set-point as well as another controller does.

Errors that are not simulated make an observation unlike all simulations, and a network's answer to it arbitrary.
"""
NOISY = Detector(noise=0.01, cube_noise=0.001)
"""The same with 2.6 pixels of 256 of noise."""
TRANSPORTER = Detector(nearest=0.1, spacing=0.1, shuffled=1.0, noise=0.01, cube_noise=0.001, missing=0.02)
"""Unknown places in an unknown order, as unsupervised keypoints are."""
DETECTORS: Mapping[str, Detector] = types.MappingProxyType(
    {"clean": CLEAN, "mask": MASK, "noisy": NOISY, "transporter": TRANSPORTER}
)
"""Detectors by name."""


@struct.dataclass
class Tracking:
    """What a detector keeps through a trajectory.

    Attributes:
        arcs: the fractions of the DLO's length at which it sees, in its own order, shape [4].
        bias: each keypoint's lasting error, in normalised pixels, shape [10, 2].
        last: where each keypoint was last seen, in normalised pixels, shape [10, 2].
        begun: whether there has been a frame.
    """

    arcs: Float[Array, "4"]
    bias: Float[Array, "10 2"]
    last: Float[Array, "10 2"]
    begun: Bool[Array, ""]


def along(centreline: Float[Array, "points dim"], fractions: Float[Array, " k"]) -> Float[Array, "k dim"]:
    """Points of a polyline at fractions of its length, its segments being of any lengths."""
    lengths = jnp.linalg.norm(jnp.diff(centreline, axis=0), axis=-1)
    arc = jnp.concatenate([jnp.zeros(1), jnp.cumsum(lengths)])
    return jax.vmap(lambda x: jnp.interp(fractions * arc[-1], arc, x), in_axes=1, out_axes=1)(centreline)


def begin(key: jax.Array, detector: Detector) -> Tracking:
    """Start a trajectory: draw where on the DLO, and in which order, its keypoints will be."""
    key_arcs, key_order, key_shuffled, key_bias = jax.random.split(key, 4)
    slack = detector.farthest - detector.nearest - (ON_DLO - 1) * detector.spacing
    steps = jnp.sort(jax.random.uniform(key_arcs, (ON_DLO,))) * slack + jnp.arange(ON_DLO) * detector.spacing
    shuffled = jax.random.bernoulli(key_shuffled, detector.shuffled)
    order = jnp.where(shuffled, jax.random.permutation(key_order, ON_DLO), jnp.arange(ON_DLO))
    bias = detector.bias * jax.random.normal(key_bias, (KEYPOINTS, 2))
    nowhere = jnp.zeros((KEYPOINTS, 2))
    return Tracking((detector.nearest + steps)[order], bias, last=nowhere, begun=jnp.asarray(False))


def track(
    key: jax.Array, detector: Detector, camera: Camera, tracking: Tracking, frames: Frames
) -> tuple[Float[Array, "10 2"], Bool[Array, "10"], Tracking]:
    """Keypoints of one frame.

    Returns:
        The keypoints in normalised pixels, four of the DLO and then the cubes bottom-up, shape [10, 2]; which of them
        were seen in this frame, shape [10]; what the next frame needs. In the first frame all are seen. Keypoints may
        lie outside of the image, where `project` puts them.
    """
    key_noise, key_missing = jax.random.split(key)
    points = jnp.concatenate([along(frames.dlo, tracking.arcs), frames.cubes])
    spread = jnp.where(jnp.arange(KEYPOINTS) < ON_DLO, detector.noise, detector.cube_noise)
    noise = spread[:, None] * jax.random.normal(key_noise, (KEYPOINTS, 2))
    found = project(camera, points) + tracking.bias + noise
    missing = jax.random.bernoulli(key_missing, detector.missing, (ON_DLO,)) & tracking.begun
    seen = jnp.concatenate([~missing, jnp.ones(KEYPOINTS - ON_DLO, bool)])
    keypoints = jnp.where(seen[:, None], found, tracking.last)
    return keypoints, seen, tracking.replace(last=keypoints, begun=jnp.asarray(True))


def measured(key: jax.Array, detector: Detector, gripper: Float[Array, "*time 2"]) -> Float[Array, "*time 2"]:
    """Where the gripper says it is, x and z in m."""
    return gripper + detector.slip * jax.random.normal(key, gripper.shape)


def detect(
    key: jax.Array, detector: Detector, camera: Camera, frames: Frames
) -> tuple[Float[Array, "time 10 2"], Bool[Array, "time 10"]]:
    """Keypoints of a whole trajectory of frames, as `track` gives them one by one.

    Args:
        key: of the trajectory; frame t is tracked with `fold_in(key, t + 1)`, the start with `fold_in(key, 0)`.
        detector: what it does to the truth.
        camera: through which the scene is seen.
        frames: T of them, stacked.

    Returns:
        Keypoints, shape [T, 10, 2], and which were seen, shape [T, 10].
    """

    def step(tracking: Tracking, at: tuple[Array, Frames]):
        time, frame = at
        keypoints, seen, tracking = track(jax.random.fold_in(key, time + 1), detector, camera, tracking, frame)
        return tracking, (keypoints, seen)

    start = begin(jax.random.fold_in(key, 0), detector)
    return jax.lax.scan(step, start, (jnp.arange(frames.gripper.shape[0]), frames))[1]
