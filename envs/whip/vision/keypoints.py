"""Keypoints by projection: where a learnt detector would see the cubes and the DLO, and its errors."""

import types
from collections.abc import Mapping

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.envs.whip.frames import Frames
from jaxlfi.envs.whip.rig import KEYPOINTS, ON_DLO
from jaxlfi.envs.whip.vision.camera import Camera, project

PIXEL = 1 / 256 / 12**0.5
"""Standard deviation of a place that is known to a pixel of a camera's image of 256, in normalised pixels."""


class Detector(struct.PyTreeNode):
    """The error model of a learnt detector of keypoints; its numbers can be vmapped over.

    It tracks four points of the DLO. Their positions are drawn once per trajectory, uniformly among all that lie
    between `nearest` and `farthest` and at least `spacing` apart; with a spacing of a third of that range they are
    fixed and equally spaced. The keypoints of cubes are the centroids of their masks: they have their own noise, and
    are never missing.

    Attributes:
        nearest: least distance from the grip, as a fraction of the DLO's length.
        farthest: greatest distance; 1 is the tip.
        spacing: least distance between neighbours.
        shuffled: probability that a trajectory's four come in a random order, the same in all its frames
            ("temporally consistent, but permutation invariance is not guaranteed", section VI-G).
        noise: standard deviation of each coordinate of the DLO's points in each frame, in normalised pixels.
        cube_noise: standard deviation of each coordinate of the cubes' points, whose centroids hardly move.
        missing: probability that a point of the DLO is not found in a frame; it then stays where it was last seen.
        bias: standard deviation of each coordinate's constant error in a trajectory, in normalised pixels.
        slip: standard deviation of the error of the gripper's measured x and z in each frame, in m.
        places: of the points, as fractions of the DLO's length, shape [4]; None where they are drawn as said above.
        moved: standard deviation of the points' places between trajectories, where there are `places`.
        slide: standard deviation of their places in each frame, where there are `places`.
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
    places: Float[Array, "4"] | tuple[float, ...] | None = None
    moved: Float[Array, ""] | float = 0.0
    slide: Float[Array, ""] | float = 0.0


CLEAN = Detector()
"""The truth at the quarters of the DLO, the last at its tip."""
MASK = Detector(noise=0.004, cube_noise=0.001, bias=0.005, slip=0.002)
"""The quarters of the DLO as found along its segmentation mask (`masks`), with errors of about a pixel, and a gripper
whose controller is not quite that of the simulation.

Errors that are not simulated make an observation unlike all simulations, and the network's posterior for it arbitrary.
"""
NOISY = Detector(noise=0.01, cube_noise=0.001)
"""The quarters of the DLO with noise of 2.6 pixels of 256."""
TRANSPORTER = Detector(nearest=0.1, spacing=0.1, shuffled=1.0, noise=0.01, cube_noise=0.001, missing=0.02)
"""Unknown positions in an unknown order, like unsupervised keypoints."""
LEARNT = Detector(noise=0.0015, cube_noise=0.0002, bias=0.0009, slip=MASK.slip)
"""The errors of `detectors`' "learnt" in pictures by MuJoCo (`python -m experiments.vision errors`), but for the few
keypoints that are far away."""
LEARNT_TRANSPORTER = LEARNT.replace(places=(0.045, 0.47, 0.65, 0.91), moved=0.034, slide=0.041, noise=0.016, bias=0.0)
"""Those of "learnt-transporter", likewise."""
DETECTORS: Mapping[str, Detector] = types.MappingProxyType(
    {
        "clean": CLEAN,
        "mask": MASK,
        "noisy": NOISY,
        "transporter": TRANSPORTER,
        "learnt": LEARNT,
        "learnt-transporter": LEARNT_TRANSPORTER,
    }
)
"""Detectors by name."""


class Tracking(struct.PyTreeNode):
    """State of a detector in a trajectory.

    Attributes:
        arcs: positions of its points as fractions of the DLO's length, in the detector's order, shape [4].
        bias: each keypoint's constant error, in normalised pixels, shape [10, 2].
        last: where each keypoint was last seen, in normalised pixels, shape [10, 2].
        begun: whether there has been a frame.
    """

    arcs: Float[Array, "4"]
    bias: Float[Array, "10 2"]
    last: Float[Array, "10 2"]
    begun: Bool[Array, ""]


def along(centreline: Float[Array, "points dim"], fractions: Float[Array, " k"]) -> Float[Array, "k dim"]:
    """Points of a polyline at fractions of its length; its segments may have any lengths."""
    lengths = jnp.linalg.norm(jnp.diff(centreline, axis=0), axis=-1)
    arc = jnp.concatenate([jnp.zeros(1), jnp.cumsum(lengths)])
    return jax.vmap(lambda x: jnp.interp(fractions * arc[-1], arc, x), in_axes=1, out_axes=1)(centreline)


def begin(key: jax.Array, detector: Detector) -> Tracking:
    """Start a trajectory: draw the positions and the order of the keypoints on the DLO."""
    key_arcs, key_order, key_shuffled, key_bias = jax.random.split(key, 4)
    slack = detector.farthest - detector.nearest - (ON_DLO - 1) * detector.spacing
    if detector.places is None:
        steps = jnp.sort(jax.random.uniform(key_arcs, (ON_DLO,))) * slack + jnp.arange(ON_DLO) * detector.spacing
        arcs = detector.nearest + steps
    else:
        arcs = jnp.asarray(detector.places) + detector.moved * jax.random.normal(key_arcs, (ON_DLO,))
    shuffled = jax.random.bernoulli(key_shuffled, detector.shuffled)
    order = jnp.where(shuffled, jax.random.permutation(key_order, ON_DLO), jnp.arange(ON_DLO))
    bias = detector.bias * jax.random.normal(key_bias, (KEYPOINTS, 2))
    nowhere = jnp.zeros((KEYPOINTS, 2))
    return Tracking(arcs[order], bias, last=nowhere, begun=jnp.asarray(False))


def track(
    key: jax.Array, detector: Detector, camera: Camera, tracking: Tracking, frames: Frames
) -> tuple[Float[Array, "10 2"], Bool[Array, "10"], Tracking]:
    """Keypoints of one frame.

    Returns:
        The keypoints in normalised pixels, four of the DLO and then the cubes bottom-up, shape [10, 2]; which of them
        were seen in this frame, shape [10]; the detector's next state. In the first frame all are seen. Keypoints may
        lie outside of the image, where `project` puts them.
    """
    arcs = tracking.arcs
    if detector.places is None:
        key_noise, key_missing = jax.random.split(key)
    else:
        key_noise, key_missing, key_slide = jax.random.split(key, 3)
        arcs = jnp.clip(arcs + detector.slide * jax.random.normal(key_slide, (ON_DLO,)), 0.0, 1.0)
    points = jnp.concatenate([along(frames.dlo, arcs), frames.cubes])
    deviation = jnp.where(jnp.arange(KEYPOINTS) < ON_DLO, detector.noise, detector.cube_noise)
    noise = deviation[:, None] * jax.random.normal(key_noise, (KEYPOINTS, 2))
    found = project(camera, points) + tracking.bias + noise
    missing = jax.random.bernoulli(key_missing, detector.missing, (ON_DLO,)) & tracking.begun
    seen = jnp.concatenate([~missing, jnp.ones(KEYPOINTS - ON_DLO, bool)])
    keypoints = jnp.where(seen[:, None], found, tracking.last)
    return keypoints, seen, tracking.replace(last=keypoints, begun=jnp.asarray(True))


def measured(key: jax.Array, detector: Detector, gripper: Float[Array, "*time 2"]) -> Float[Array, "*time 2"]:
    """The measured x and z of the gripper, in m."""
    return gripper + detector.slip * jax.random.normal(key, gripper.shape)


def detect(
    key: jax.Array, detector: Detector, camera: Camera, frames: Frames
) -> tuple[Float[Array, "time 10 2"], Bool[Array, "time 10"]]:
    """Keypoints of a whole trajectory of frames, as `track` gives them one by one.

    Args:
        key: of the trajectory; frame t is tracked with `fold_in(key, t + 1)`, the start with `fold_in(key, 0)`.
        detector: the error model.
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
