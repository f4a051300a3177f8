"""Errors of learnt detectors, in the form of the noise models of simulations (`vision.keypoints.Detector`)."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.envs.whip.vision import detectors, scenes
from jaxlfi.envs.whip.vision.camera import project, side_camera
from jaxlfi.envs.whip.vision.following import follow
from jaxlfi.envs.whip.vision.keypoints import ON_DLO, along
from jaxlfi.envs.whip.vision.masks import EVEN
from jaxlfi.envs.whip.vision.photographer import Photographer
from jaxlfi.envs.whip.vision.renderers import RENDERERS
from jaxlfi.envs.whip.vision.training import POINTS

ROLLOUTS, SEED = 40, 3001
"""Number of random rollouts, each with its own look, in pictures by MuJoCo; and their seed."""


def measured(weights: Path | None, renderer: str = "mujoco") -> tuple[list[dict], dict[str, np.ndarray]]:
    """A row for each learnt detector, and the arrays of found and true keypoints."""
    key_rollouts, key_looks, key_noise = jax.random.split(jax.random.key(SEED), 3)
    rolled = scenes.rollouts(key_rollouts, pick("auto"), ROLLOUTS)
    rolled = jax.tree.map(lambda leaf: leaf[rolled.valid], rolled)
    true, lines = _truth(rolled)
    rows, arrays = [], {"true": true, "lines": lines}
    with RENDERERS[renderer]() as taking:
        for name in ("learnt", "learnt-transporter"):
            detector = detectors.pick(name, weights)
            found = np.stack([_found(key_looks, key_noise, taking, detector, rolled, i) for i in range(len(true))])
            arrays[name] = found
            rows.append(
                {"detector": name, **(_quarters(found, true) if name == "learnt" else _along(found, true, lines))}
            )
    return rows, arrays


def _truth(rolled: scenes.Rollouts) -> tuple[np.ndarray, np.ndarray]:
    """True keypoints, shape [N, T, 10, 2], and points of the DLO from the grip to the tip, [N, T, P, 2]."""

    @jax.jit
    @jax.vmap
    def of(parameters, frames):
        camera = side_camera(parameters)

        def one(frame):
            points = jnp.concatenate([along(frame.dlo, jnp.asarray(EVEN)), frame.cubes])
            return project(camera, points), project(camera, along(frame.dlo, jnp.linspace(0.0, 1.0, POINTS)))

        return jax.vmap(one)(frames)

    return jax.device_get(of(rolled.parameters, rolled.frames))


def _found(key_looks, key_noise, renderer, detector, rolled: scenes.Rollouts, i: int) -> np.ndarray:
    """Keypoints of a rollout, NaN where not seen, shape [T, 10, 2]."""
    photographer = Photographer(jax.random.fold_in(key_looks, i), renderer, detector)
    parameters, frames = jax.tree.map(lambda leaf: leaf[i], (rolled.parameters, rolled.frames))
    camera, side = side_camera(parameters), float(parameters.cube_side)
    found = []
    for t in range(len(frames.gripper)):
        frame = jax.tree.map(lambda leaf, t=t: leaf[t], frames)
        found.append(photographer(jax.random.fold_in(key_noise, 100 * i + t), camera, frame, side)[0])
    return np.stack(found)


def _quarters(found: np.ndarray, true: np.ndarray) -> dict:
    """Robust noise and bias of keypoints that should be at the quarters, as a few are far away."""
    inside = (np.abs(true - 0.5) < 0.5).all(axis=-1, keepdims=True)
    off = np.where(inside, found - true, np.nan)
    dlo, cubes = off[:, :, :ON_DLO], off[:, :, ON_DLO:]
    return {
        "noise": _within(dlo),
        "bias": _between(dlo),
        "cube_noise": _within(cubes),
        "cube_bias": _between(cubes),
        "missing": float(np.mean(np.isnan(found[:, :, :ON_DLO, 0])[inside[:, :, :ON_DLO, 0]])),
    }


def _along(found: np.ndarray, true: np.ndarray, lines: np.ndarray) -> dict:
    """Places along the DLO, their variation within a rollout and between rollouts, and the noise across the DLO."""
    dlo = found[:, :, :ON_DLO]
    missing = np.isnan(dlo[..., 0])
    following = follow(np.where(missing[..., None], 0.5, dlo), lines)
    arcs = np.where(missing, np.nan, following.arcs)
    away = np.where(missing, np.nan, following.away)
    return {
        **{f"place {k + 1}": float(np.nanmedian(arcs[..., k])) for k in range(ON_DLO)},
        "slide": _within(arcs),
        "moved": _between(arcs),
        "noise": float(1.4826 * np.nanmedian(away)),
        "missing": float(missing.mean()),
    }


def _within(off: np.ndarray) -> float:
    """Robust standard deviation over time about the rollout's median, by medians."""
    return float(1.4826 * np.nanmedian(np.abs(off - np.nanmedian(off, axis=1, keepdims=True))))


def _between(off: np.ndarray) -> float:
    """Robust standard deviation of the rollouts' medians about each keypoint's own, by medians."""
    medians = np.nanmedian(off, axis=1)
    return float(1.4826 * np.nanmedian(np.abs(medians - np.nanmedian(medians, axis=0))))
