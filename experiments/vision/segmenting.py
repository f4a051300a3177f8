"""Comparison of segmentations of pictures: an upper bound, a simple baseline, and the network."""

import itertools
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np

from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.envs.whip.vision import detectors, looks, making, pictures, scores
from jaxlfi.envs.whip.vision.making import Asked
from jaxlfi.envs.whip.vision.pictures import Pictures
from jaxlfi.envs.whip.vision.renderers import RayCaster

PICTURES = 240
"""Number of pictures in each data set."""
SETS: Mapping[str, Mapping] = {
    "ray caster": {"renderer": "raycast", "seed": 1001, "objects": ()},
    "MuJoCo": {"renderer": "mujoco", "seed": 1001, "objects": ()},
    "MuJoCo, FEM objects": {"renderer": "mujoco", "seed": 1002, "objects": ("dlo-0", "dlo-1", "dlo-2", "dlo-3")},
}
"""Data sets that methods are judged on: the ray caster's has new scenes, the others also another renderer. The first
two have the same scenes and looks."""
TUNED_ON = {"renderer": "raycast", "seed": 1003, "objects": ()}
"""Data set on which the colour thresholds are chosen."""
Labels = Callable[[np.ndarray], np.ndarray]
"""Function from a picture to its labels."""


def compared(folder: Path, weights: Path | None) -> list[dict]:
    """A row for each method on each data set (`scores.summary`)."""
    data = {name: _data(folder / name.replace(" ", "-").replace(",", ""), **how) for name, how in SETS.items()}
    by_colour = tuned(_data(folder / "tuned-on", **TUNED_ON))
    learnt = detectors.pick("learnt", weights)
    rows = []
    for name, (asked, held_out) in data.items():
        true, grips = held_out.labels, [entry["grip"] for entry in held_out.entries]
        lines = _lines(true, grips)
        found = {
            "the ray caster's labels": ceiling(asked, true),
            "thresholds of colour": np.stack([by_colour(rgb) for rgb in held_out.rgb]),
            "network": np.stack([np.asarray(learnt.labels(rgb)) for rgb in held_out.rgb]),
        }
        for method, labels in found.items():
            rows.append(
                {"pictures": name, "method": method, **scores.summary(true, labels, lines, _lines(labels, grips))}
            )
    return rows


def _data(folder: Path, renderer: str, seed: int, objects: tuple[str, ...]) -> tuple[Asked, Pictures]:
    asked = Asked(PICTURES, seed, renderer, False, objects)
    try:
        pictures.check(folder)
    except pictures.PicturesError:
        making.make(asked, folder, pick("auto"))
    return asked, pictures.read(folder)


def _lines(labels: np.ndarray, grips: list) -> np.ndarray:
    """Keypoints of the DLO along its label, in pixels, shape [N, 4, 2]."""
    line = detectors.Centreline()
    found = [np.asarray(line(one, grip)[0])[:4] for one, grip in zip(labels, grips, strict=True)]
    return pictures.SIZE * np.stack(found)


def ceiling(asked: Asked, true: np.ndarray) -> np.ndarray:
    """The ray caster's labels of the same scenes."""
    out = np.zeros_like(true)
    with RayCaster() as caster:
        for number, view in making.views(asked, pick("auto"), 0):
            look = making.look(asked, number, view)
            out[number] = caster.render(view.camera, view.frame, view.cube_side, look)[1]
    return out


# -------------------------------------------------------------------------------------------- thresholds of colours


def by_thresholds(spread: int, saturation: int, value: int) -> Labels:
    """Label hues near the objects' that are saturated and bright, opened by 3 x 3 pixels; keep the largest parts."""
    names = (255 * looks.PALETTE).astype(np.uint8)
    hues = cv2.cvtColor(names[None], cv2.COLOR_RGB2HSV)[0, :, 0].astype(int)
    kernel = np.ones((3, 3), np.uint8)

    def labels(rgb: np.ndarray) -> np.ndarray:
        hsv = cv2.cvtColor(cv2.medianBlur(rgb, 3), cv2.COLOR_RGB2HSV)
        strong = (hsv[..., 1] >= saturation) & (hsv[..., 2] >= value)
        away = np.abs(hsv[..., 0].astype(int)[..., None] - hues)
        away = np.minimum(away, 180 - away)
        nearest = np.argmin(away, axis=-1)
        out = np.zeros(rgb.shape[:2], int)
        for i in range(len(hues)):
            mask = (strong & (nearest == i) & (away[..., i] <= spread)).astype(np.uint8)
            out[cv2.morphologyEx(mask, cv2.MORPH_OPEN, kernel) > 0] = i + 1
        return detectors.whole(out)

    return labels


def tuned(data: tuple[Asked, Pictures]) -> Labels:
    """The thresholds with the highest mean overlap on some pictures."""
    _, held = data
    best, chosen = -1.0, None
    for spread, saturation, value in itertools.product((6, 10, 15, 25), (60, 100, 140), (30, 60, 100)):
        labels = by_thresholds(spread, saturation, value)
        overlap = np.nanmean(scores.overlaps(held.labels[:60], np.stack([labels(rgb) for rgb in held.rgb[:60]])))
        if overlap > best:
            best, chosen = overlap, labels
    return chosen
