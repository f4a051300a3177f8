"""Deployment of policies on the FEM objects, at the paper's repetitions of the nominal place and at displaced ones."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.policies.simulation import Performed, lowest
from experiments.policies.study import DISPLACED, NOMINAL, STILLS
from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.reference_objects.deployment import Deployed, deploy, places
from jaxlfi.envs.whip.reference_objects.objects import load
from jaxlfi.envs.whip.reference_objects.observation import in_every_frame
from jaxlfi.envs.whip.reference_objects.repetitions import acting, episodes
from jaxlfi.envs.whip.reference_objects.scene import PLACE
from jaxlfi.envs.whip.render import SIZE
from jaxlfi.envs.whip.vision.camera import Camera, side_camera
from jaxlfi.envs.whip.vision.raster import segmentation


def scenes(displaced: int = DISPLACED, nominal: int = NOMINAL, seed: int = 0) -> list[tuple[jax.Array, Any, Camera]]:
    """The noise key, scene and camera of each episode, the same for all policies and objects."""
    key_places, key_noise = jax.random.split(jax.random.key(seed))
    there, cameras = places(key_places, displaced + 1)
    order = [0] * nominal + list(range(1, displaced + 1))
    keys = jax.random.split(key_noise, len(order))
    return [(key, there[place], cameras[place]) for key, place in zip(keys, order, strict=True)]


def on_object(words: list[str], dlo: str, where: list[tuple[jax.Array, Any, Camera]]) -> Performed:
    """Run policies, as named by `jaxlfi whip deploy`, on an object; shape [S, P]."""

    def episode(case: tuple[Callable, tuple]) -> dict[str, Any]:
        begin, (key, scene, camera) = case
        return _row(deploy(key, load(dlo), begin(), scene, camera), camera)

    cases = [(acting(word), place) for word in words for place in where]
    rows = episodes(cases, episode)
    arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    return Performed(**{name: row.reshape(len(words), len(where), *row.shape[1:]) for name, row in arrays.items()})


def _row(one: Deployed, camera: Camera) -> dict[str, Any]:
    seen = np.asarray(one.observations[1:], np.float32)
    late = rules.STEPS - len(seen)
    pad = lambda rows: np.pad(
        np.asarray(rows, np.float32), ((0, late), *[(0, 0)] * (np.ndim(rows) - 1)), constant_values=np.nan
    )
    return {
        "value": np.float32(one.value),
        "hit": bool(one.hit[rules.TOP]),
        "clean": one.clean_hit,
        "outside": one.outside,
        "failed": one.failed,
        "steps": one.steps,
        "actions": pad(one.actions[: len(seen)]),
        "gripper": pad(seen[:, 1]),
        "lowest": pad([float(lowest(camera, row)) for row in seen]),
    }


def stills(policy: Path, dlo: str, key: jax.Array) -> Mapping[str, np.ndarray]:
    """An episode at the nominal place as a film strip: segmentation labels, shape [8, H, W], and its return and length.

    Raises:
        ValueError: if the simulation became unstable.
    """
    made = deploy(key, load(dlo), acting(str(policy))(), whole=True)
    if made.frames is None:
        raise ValueError(f"{policy}: expected an episode that can be drawn, got an unstable simulation")
    camera = side_camera(PLACE)
    pieces = (len(made.frames.gripper) - 1) // rules.STEPS
    frames = jax.tree.map(lambda leaf: leaf[[pieces * step for step in STILLS]], made.frames)
    labels = in_every_frame(_labels, jax.random.key(0), camera, frames, PLACE.cube_side)
    return {"labels": np.asarray(labels, np.uint8), "value": np.float32(made.value), "steps": np.int32(made.steps)}


def _labels(key, camera, frame, cube_side):
    return segmentation(camera, frame, cube_side, size=SIZE)
