"""Comparison of how well keypoints follow the DLO: learnt, geometric, and as simulated by the noise models."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.envs.whip.vision import detectors, scenes, training, weights
from jaxlfi.envs.whip.vision.camera import project, side_camera
from jaxlfi.envs.whip.vision.following import Following, follow
from jaxlfi.envs.whip.vision.keypoints import DETECTORS, detect
from jaxlfi.envs.whip.vision.raster import noisy, segmentation

ROLLOUTS, SEED = 100, 2001
"""Number of random held-out rollouts, and their seed."""
SHOWN = 6
"""Number of rollouts that pictures show, the first stable ones."""


def compared(folder: Path | None) -> tuple[list[dict], dict[str, np.ndarray]]:
    """A row for each detector, and places of its keypoints along the DLO; for a few rollouts, masks and keypoints."""
    key_rollouts, key_masks, key_noise = jax.random.split(jax.random.key(SEED), 3)
    rolled = scenes.rollouts(key_rollouts, pick("auto"), ROLLOUTS)
    rolled = jax.tree.map(lambda leaf: leaf[rolled.valid], rolled)
    masks, lines = training.dlo_masks(key_masks, rolled)
    path = weights.SHIPPED["transporter"] if folder is None else folder / "transporter.npz"
    learnt = training.keypoints_of(weights.load(path, "transporter"), masks)
    geometric = _geometric(key_noise, rolled, lines)
    found = {"transporter": follow(learnt, lines), "centreline": follow(geometric, lines)}
    for name in ("mask", "transporter"):
        found[f"noise model {name}"] = follow(_simulated(key_noise, DETECTORS[name], rolled), lines)
    rows = [_row(name, following) for name, following in found.items()]
    arrays = {f"{name}/{part}": getattr(one, part) for name, one in found.items() for part in ("arcs", "away")}
    shown = {"masks": masks[..., 0], "transporter": learnt, "centreline": geometric}
    return rows, arrays | {f"shown/{part}": array[:SHOWN] for part, array in shown.items()}


def _row(name: str, following: Following) -> dict:
    row = {"keypoints": name}
    for k in range(4):
        row[f"place {k + 1}"] = float(following.mean[k])
    return row | {
        "drift within a rollout": float(following.within.mean()),
        "drift between rollouts": float(following.between.mean()),
        "away (px of 256)": float(256 * np.nanmean(following.away)),
        "frames in another order": following.switched,
        "fraction covered": following.covered,
    }


def _geometric(key, rolled: scenes.Rollouts, lines) -> np.ndarray:
    """The quarters of the line along a noisy mask; if the DLO is not seen, keypoints stay where they were."""

    @jax.jit
    def one(key, camera, frame, side):
        labels = noisy(key, segmentation(camera, frame, side))
        x, z = frame.gripper
        return detectors.masks.keypoints(labels, project(camera, jnp.stack([x, jnp.zeros(()), z])))

    places = np.zeros((*lines.shape[:2], 4, 2))
    for i in range(len(lines)):
        parameters = jax.tree.map(lambda leaf, i=i: leaf[i], rolled.parameters)
        for t in range(lines.shape[1]):
            frame = jax.tree.map(lambda leaf, i=i, t=t: jnp.asarray(leaf[i, t]), rolled.frames)
            keypoints, seen = one(
                jax.random.fold_in(key, i * 100 + t), side_camera(parameters), frame, parameters.cube_side
            )
            places[i, t] = keypoints[:4] if seen[:4].all() else places[i, max(t - 1, 0)]
    return places


def _simulated(key, detector, rolled: scenes.Rollouts) -> np.ndarray:
    @jax.jit
    def one(key, parameters, frames):
        return detect(key, detector, side_camera(parameters), frames)[0][:, :4]

    places = []
    for i in range(len(rolled.valid)):
        parameters, frames = jax.tree.map(lambda leaf, i=i: jnp.asarray(leaf[i]), (rolled.parameters, rolled.frames))
        places.append(np.asarray(one(jax.random.fold_in(key, i), parameters, frames)))
    return np.stack(places)
