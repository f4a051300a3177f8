"""Scores of segmentations and keypoints."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from jaxlfi.envs.whip.vision.masks import MIN_COUNT
from jaxlfi.envs.whip.vision.pictures import LABELS
from jaxlfi.envs.whip.vision.raster import DLO


def overlaps(true: Int[np.ndarray, "n size size"], found: Int[np.ndarray, "n size size"]) -> Float[np.ndarray, "n 7"]:
    """Intersection over union of each object in each picture, the cubes bottom-up and the DLO.

    It is NaN for what is not in the picture.
    """
    out = np.full((len(true), len(LABELS) - 1), np.nan)
    for label in range(1, len(LABELS)):
        is_true, is_found = true == label, found == label
        both = np.sum(is_true & is_found, axis=(1, 2))
        either = np.sum(is_true | is_found, axis=(1, 2))
        there = is_true.sum(axis=(1, 2)) >= MIN_COUNT
        out[there, label - 1] = both[there] / either[there]
    return out


def centroids(labels: Int[np.ndarray, "n size size"]) -> Float[np.ndarray, "n 6 2"]:
    """Centroids of the cubes, in pixels; NaN for those of which there are too few pixels to count as seen."""
    out = np.full((len(labels), DLO - 1, 2), np.nan)
    for places, picture in zip(out, labels, strict=True):
        seen = np.flatnonzero(np.bincount(picture.ravel(), minlength=DLO)[1:DLO] >= MIN_COUNT)
        middles = ndimage.center_of_mass(picture > 0, picture, 1 + seen)
        places[seen] = np.reshape(middles, (-1, 2))[:, ::-1]
    return out


def summary(
    true: Int[np.ndarray, "n size size"],
    found: Int[np.ndarray, "n size size"],
    lines_true: Float[np.ndarray, "n 4 2"],
    lines_found: Float[np.ndarray, "n 4 2"],
) -> Mapping[str, float]:
    """A segmentation's row in a table.

    Args:
        true: labels.
        found: labels.
        lines_true: keypoints of the DLO along the true labels, in pixels, NaN where it is not in the picture.
        lines_found: likewise of the labels that were found.

    Returns:
        Mean overlaps of the DLO and of cubes; median and 99th percentile of the distances of cubes' centroids and of
        the DLO's keypoints from the true ones, in pixels; fractions of cubes and of DLOs in the pictures that were
        missed, and of pictures in which something was seen that is not there.
    """
    overlap = overlaps(true, found)
    at, seen_at = centroids(true), centroids(found)
    away = np.linalg.norm(seen_at - at, axis=-1)
    there = ~np.isnan(at[..., 0])
    off = np.linalg.norm(lines_found - lines_true, axis=-1)
    in_picture = ~np.isnan(lines_true[:, 0, 0])
    not_there = (~there & ~np.isnan(seen_at[..., 0])).any(axis=1) | (~in_picture & ~np.isnan(lines_found[:, 0, 0]))
    return {
        "DLO overlap": float(np.nanmean(overlap[:, -1])),
        "cubes overlap": float(np.nanmean(overlap[:, :-1])),
        "worst cube overlap": min(float(np.nanmean(one)) for one in overlap[:, :-1].T if not np.isnan(one).all()),
        "centroid median (px)": float(np.nanmedian(away)),
        "centroid 99 % (px)": float(np.nanquantile(away, 0.99)),
        "keypoint median (px)": float(np.nanmedian(off)),
        "keypoint 99 % (px)": float(np.nanquantile(off, 0.99)),
        "cubes missed": float(np.mean(np.isnan(seen_at[..., 0])[there])),
        "DLOs missed": float(np.mean(np.isnan(lines_found[in_picture, 0, 0]))),
        "seen but not there": float(np.mean(not_there)),
    }
