"""Detectors: from a picture to ten keypoints and which of them were seen, by name."""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy import ndimage

from jaxlfi.envs.whip.vision import masks, transporter, weights
from jaxlfi.envs.whip.vision.keypoints import ON_DLO
from jaxlfi.envs.whip.vision.pictures import SIZE
from jaxlfi.envs.whip.vision.raster import DLO
from jaxlfi.envs.whip.vision.segmenter import segment
from jaxlfi.envs.whip.vision.transporter import Transporter

Found = tuple[Float[Array, "10 2"], Bool[Array, "10"]]
"""Keypoints in normalised pixels, four of the DLO and then the cubes bottom-up, NaN where not seen; and which were."""


class KeypointDetector(Protocol):
    """Finds keypoints in pictures.

    Attributes:
        reads: what a picture is to it: "labels", of pixels [256, 256] as in `raster.segmentation`, or "rgb", bytes
            [height, width, 3].
    """

    reads: Literal["labels", "rgb"]

    def __call__(self, picture: Array, grip: Float[Array, "2"]) -> Found:
        """Keypoints of one picture.

        Args:
            picture: as it `reads` it.
            grip: approximate position of the gripper, in normalised pixels.

        Raises:
            ValueError: for a picture of another kind or size.
        """


class Centreline:
    """The centroids of the cubes' labels, and the quarters of the line along the DLO's (`masks`)."""

    reads = "labels"

    def __call__(self, picture: Array, grip: Float[Array, "2"]) -> Found:
        """Keypoints of a segmentation image."""
        if np.shape(picture) != (SIZE, SIZE):
            raise ValueError(f"picture: expected labels of {SIZE} x {SIZE} pixels, got shape {np.shape(picture)}")
        return _along_labels(jnp.asarray(picture, jnp.int32), jnp.asarray(grip, jnp.float32))


class Learnt:
    """A picture is segmented by a network; the DLO's keypoints are those of a line along its mask, or of a transporter.

    Square pictures of other sizes than 256 x 256 pixels are resized, smoothly.

    Attributes:
        segmenter: the network that segments.
        transporter: the network that finds the DLO's keypoints in its mask; None for the line.
    """

    reads = "rgb"

    def __init__(self, segmenter: weights.Weights, transporter: weights.Weights | None = None):
        """A detector of trained networks."""
        self.segmenter, self.transporter = segmenter, transporter

    def __call__(self, picture: Array, grip: Float[Array, "2"]) -> Found:
        """Keypoints of a picture."""
        rgb, grip = checked(picture), jnp.asarray(grip, jnp.float32)
        labels = self.labels(rgb)
        if self.transporter is None:
            return _along_labels(labels, grip)
        return _transported(self.transporter.module, self.transporter.params, labels)

    def labels(self, picture: Array) -> Array:
        """The segmentation of a picture, without what lies apart from the objects."""
        return whole(segment(self.segmenter.module, self.segmenter.params, checked(picture)))


def checked(picture: Any) -> np.ndarray:
    """A picture as a detector takes it, of 256 x 256 pixels.

    Raises:
        ValueError: for what is not a square picture in bytes.
    """
    rgb = np.asarray(picture)
    square = rgb.ndim == 3 and rgb.shape[0] == rgb.shape[1] >= 64 and rgb.shape[2] == 3
    if not square or rgb.dtype != np.uint8:
        raise ValueError(
            "picture: expected a square picture of at least 64 x 64 pixels with three bytes each (crop it to a square "
            f"first), got shape {rgb.shape} of {rgb.dtype}"
        )
    if rgb.shape[0] == SIZE:
        return rgb
    from PIL import Image

    return np.asarray(Image.fromarray(rgb).resize((SIZE, SIZE), Image.Resampling.BILINEAR))


def whole(labels: Int[Array, "size size"]) -> Int[np.ndarray, "size size"]:
    """Labels without the pixels that networks strew about: of each cube, its largest connected part.

    Of the DLO, which may be hidden in its middle, all parts are kept that have a seventh of the largest one's pixels.
    """
    labels = np.asarray(labels)
    out = np.zeros_like(labels)
    for label in range(1, DLO + 1):
        parts, n = ndimage.label(labels == label, np.ones((3, 3)))
        if n:
            sizes = np.bincount(parts.ravel())
            sizes[0] = 0
            out[(sizes >= (sizes.max() / 7 if label == DLO else sizes.max()))[parts]] = label
    return out


def downsized(mask: Bool[Array, "size size"]) -> Array:
    """A mask as the transporter sees it, in bytes, shape [64, 64, 1]: fractions of pixels."""
    side = mask.shape[0] // transporter.SIZE
    fractions = mask.astype(jnp.float32).reshape(transporter.SIZE, side, transporter.SIZE, side).mean(axis=(1, 3))
    return jnp.round(255 * fractions).astype(jnp.uint8)[..., None]


_along_labels = jax.jit(masks.keypoints)


@functools.partial(jax.jit, static_argnums=0)
def _transported(module: Transporter, params: Any, labels: Array) -> Found:
    clean = masks.despeckled(labels)
    mask = clean == DLO
    dlo = transporter.places(module, params, downsized(mask)[None])[0]
    cubes, cubes_seen = masks.centroids(clean)
    seen = jnp.concatenate([jnp.broadcast_to(mask.sum() >= masks.MIN_COUNT, ON_DLO), cubes_seen])
    return jnp.where(seen[:, None], jnp.concatenate([dlo, cubes]), jnp.nan), seen


NETWORKS: Mapping[str, tuple[str, ...]] = {
    "centreline": (),
    "learnt": ("segmenter",),
    "learnt-transporter": ("segmenter", "transporter"),
}
"""Detectors by name, and the networks that they need."""


def pick(name: str, folder: Path | None = None) -> KeypointDetector:
    """A detector by its name, with the weights that come with the package, or those of a folder.

    Args:
        name: in `NETWORKS`.
        folder: that `jaxlfi whip train-vision` made.

    Raises:
        ValueError: for an unknown name, and weights that are missing or damaged.
    """
    if name not in NETWORKS:
        raise ValueError(f"detector: expected one of {', '.join(NETWORKS)}, got {name!r}")
    paths = {kind: weights.SHIPPED[kind] if folder is None else folder / f"{kind}.npz" for kind in NETWORKS[name]}
    return Learnt(*(weights.load(path, kind) for kind, path in paths.items())) if paths else Centreline()
