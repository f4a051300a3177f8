"""Pictures of a policy on a reference object: a sheet of control steps, and an animation."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.envs.whip import figures
from jaxlfi.envs.whip.reference_objects.deployment import Deployed
from jaxlfi.envs.whip.reference_objects.observation import in_every_frame
from jaxlfi.envs.whip.reference_objects.simulation import FRAME_INTERVAL
from jaxlfi.envs.whip.render import PALETTE, SIZE, SLOWNESS, keypoints_of, lines
from jaxlfi.envs.whip.rig import CONTROL_INTERVAL
from jaxlfi.envs.whip.vision.camera import project
from jaxlfi.envs.whip.vision.keypoints import ON_DLO
from jaxlfi.envs.whip.vision.raster import segmentation

EVERY = 2
"""Frames of the camera to a frame of the animation."""


def save_pictures(folder: Path, deployed: Deployed, cube_side: float, title: str) -> list[Path]:
    """Draw sheet.png and film.gif, with the keypoints that the policy saw.

    Args:
        folder: of the files.
        deployed: a whole episode.
        cube_side: of the cubes, in m.
        title: of both.

    Returns:
        The files that were written.
    """
    camera, frames = deployed.recording.camera, deployed.frames
    labels = in_every_frame(_labels, jax.random.key(0), camera, frames, cube_side)
    pieces = round(CONTROL_INTERVAL / FRAME_INTERVAL)
    at = np.arange(len(labels))
    step = at // pieces
    gripper = np.stack([frames.gripper[:, 0], np.zeros(len(at)), frames.gripper[:, 1]], axis=1)
    keypoints = keypoints_of(deployed.observations)[step]
    film = figures.Film(
        labels=labels,
        dlo=keypoints[:, :ON_DLO],
        cubes=keypoints[:, ON_DLO:],
        seen=deployed.recording.seen[step][:, :ON_DLO],
        gripper=np.asarray(project(camera, jnp.asarray(gripper, jnp.float32))),
        captions=[f"{i * FRAME_INTERVAL:.2f} s" for i in at],
        over=step > deployed.steps,
        palette=PALETTE,
        lines=jax.device_get(lines(camera)),
    )
    interval, freshness = SLOWNESS * EVERY * FRAME_INTERVAL, 0.6 ** (at % pieces)
    return [
        figures.save_sheet(folder / "sheet.png", film.every(pieces), title),
        figures.save_animation(folder / "film.gif", film.every(EVERY), title, interval, freshness[::EVERY]),
    ]


def _labels(key, camera, frame, cube_side):
    return segmentation(camera, frame, cube_side, size=SIZE).astype(jnp.uint8)
