"""Training of the networks that the package comes with, and of a lab's own."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from jaxlfi.envs.whip.frames import Frames
from jaxlfi.envs.whip.vision import learning, segmenter, transporter, weights
from jaxlfi.envs.whip.vision.camera import Camera, project, side_camera
from jaxlfi.envs.whip.vision.detectors import downsized
from jaxlfi.envs.whip.vision.following import Following, follow
from jaxlfi.envs.whip.vision.keypoints import along
from jaxlfi.envs.whip.vision.learning import Training
from jaxlfi.envs.whip.vision.masks import despeckled
from jaxlfi.envs.whip.vision.pictures import Pictures
from jaxlfi.envs.whip.vision.raster import DLO, noisy, segmentation
from jaxlfi.envs.whip.vision.scenes import Rollouts
from jaxlfi.envs.whip.vision.segmenter import Segmenter
from jaxlfi.envs.whip.vision.transporter import Transporter
from jaxlfi.envs.whip.vision.weights import Weights

POINTS = 33
"""Points of the DLO that keypoints are compared with."""


@dataclasses.dataclass(frozen=True)
class Preset:
    """Settings for training both networks.

    Attributes:
        networks: the segmenter and the transporter.
        pictures: number that the segmenter learns from.
        segmenter: its training.
        parts: of pictures in a batch.
        crop: side of the parts, in pixels.
        rollouts: number that the transporter learns from.
        transporter: its training.
        pairs: of frames in a batch.
    """

    networks: tuple[Segmenter, Transporter]
    pictures: int
    segmenter: Training
    parts: int
    crop: int
    rollouts: int
    transporter: Training
    pairs: int


NETWORKS = Segmenter(), Transporter()
PRESETS: Mapping[str, Preset] = {
    "quick": Preset(NETWORKS, 2400, Training(3600, 3e-3), 16, 128, 500, Training(3000, 1e-3), 32),
    # 64 epochs of pictures, and 50 epochs of 1,500 rollouts of 17 frames (section VI-C).
    "paper": Preset(NETWORKS, 2400, Training(64 * 150, 3e-3), 16, 256, 1500, Training(50 * 797, 1e-3), 32),
}
"""Presets by name: on two cores, "quick" takes less than an hour, and "paper" a night."""
OnChunk = Callable[[int, np.ndarray], Any]


def train_segmenter(
    preset: Preset, data: Pictures, seed: int, checkpoint: Path | None, on_chunk: OnChunk
) -> tuple[Weights, Float[np.ndarray, " steps"]]:
    """A network that segments pictures, and the loss of each step of its training."""
    module, _ = preset.networks
    key_start, key_steps = jax.random.split(jax.random.key(seed))
    batches = segmenter.Batches(jnp.asarray(data.rgb), jnp.asarray(data.labels))
    loss = functools.partial(segmenter.loss, module=module, batch=preset.parts, crop=preset.crop)
    start = weights.initial(module, key_start)
    params, losses = learning.train(preset.segmenter, loss, start, key_steps, batches, checkpoint, on_chunk)
    return Weights(module, params, {}), losses


def train_transporter(
    preset: Preset, masks: UInt8[np.ndarray, "n time 64 64 1"], seed: int, checkpoint: Path | None, on_chunk: OnChunk
) -> tuple[Weights, Float[np.ndarray, " steps"]]:
    """A network that finds keypoints in masks of the DLO, and the loss of each step of its training."""
    _, module = preset.networks
    key_start, key_steps = jax.random.split(jax.random.key(seed))
    loss = functools.partial(transporter.loss, module=module, batch=preset.pairs)
    start, pairs = weights.initial(module, key_start), transporter.Pairs(jnp.asarray(masks))
    params, losses = learning.train(preset.transporter, loss, start, key_steps, pairs, checkpoint, on_chunk)
    return Weights(module, params, {}), losses


def dlo_masks(
    key: jax.Array, rollouts: Rollouts, on_rollout: Callable[[int], Any] = lambda count: None
) -> tuple[UInt8[np.ndarray, "n time 64 64 1"], Float[np.ndarray, "n time points 2"]]:
    """Masks of the DLO in all frames of rollouts, with a camera's noise, and where the DLO is in truth.

    Returns:
        Masks as the transporter sees them, and points of the DLO from the grip to the tip, in normalised pixels.
    """
    masks: list[np.ndarray] = []
    lines: list[np.ndarray] = []
    for i in range(len(rollouts.valid)):
        frames, parameters = jax.tree.map(lambda leaf, i=i: leaf[i], (rollouts.frames, rollouts.parameters))
        made = _masks(jax.random.fold_in(key, i), side_camera(parameters), frames, parameters.cube_side)
        for part, several in zip(jax.device_get(made), (masks, lines), strict=True):
            several.append(part)
        on_rollout(i + 1)
    return np.stack(masks), np.stack(lines)


@jax.jit
def _masks(key: jax.Array, camera: Camera, frames: Frames, cube_side):
    def one(at):
        frame, number = at
        labels = noisy(jax.random.fold_in(key, number), segmentation(camera, frame, cube_side))
        line = project(camera, along(frame.dlo, jnp.linspace(0.0, 1.0, POINTS)))
        return downsized(despeckled(labels) == DLO), line

    return jax.lax.map(one, (frames, jnp.arange(frames.gripper.shape[0])))


def keypoints_of(found: Weights, masks: UInt8[np.ndarray, "n time 64 64 1"]) -> Float[np.ndarray, "n time k 2"]:
    """The transporter's keypoints in the masks of rollouts, in normalised pixels."""
    places = [np.asarray(transporter.places(found.module, found.params, rollout)) for rollout in masks]
    return np.stack(places)


def followed(
    found: Weights, masks: UInt8[np.ndarray, "n time 64 64 1"], lines: Float[np.ndarray, "n time points 2"]
) -> Following:
    """How a transporter's keypoints follow the DLO in rollouts."""
    return follow(keypoints_of(found, masks), lines)


def from_grip_to_tip(
    found: Weights, masks: UInt8[np.ndarray, "n time 64 64 1"], lines: Float[np.ndarray, "n time points 2"]
) -> Weights:
    """A transporter whose keypoints are in their usual order along the DLO."""
    order = np.argsort(followed(found, masks, lines).mean)
    return dataclasses.replace(found, params=transporter.ordered(found.params, order))
