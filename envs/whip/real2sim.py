"""Real2Sim: the length and stiffness of a DLO from one whip, as an inference task (section VI-F)."""

import functools
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.envs.whip import parameters as ranges
from jaxlfi.envs.whip import recording as recordings
from jaxlfi.envs.whip.exploration import exploratory_actions
from jaxlfi.envs.whip.frames import COLOURS
from jaxlfi.envs.whip.parameters import WhipParameters, median, randomised
from jaxlfi.envs.whip.physics.engine import Engine
from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.envs.whip.trajectory import trajectory
from jaxlfi.envs.whip.vision.camera import side_camera
from jaxlfi.envs.whip.vision.keypoints import DETECTORS, Detector
from jaxlfi.summaries import cross_correlation
from jaxlfi.support import Support
from jaxlfi.task import Task

TRUTH = (0.23, 8e3)
"""Length (m) and Young's modulus (Pa) of the simulated DLO that is observed where no object is named."""
DATA = Path(__file__).parent / "data"
"""Recorded rollouts of stand-ins for real objects."""
MILLIMETRES = np.array([1e3, 1.0])
"""From (m, Pa) to the units that parameters are told in."""
NUISANCES: dict[str, Callable[..., WhipParameters]] = {
    "fixed": lambda key, length, young: median(length, young),
    "random": randomised,
}
"""What is assumed of all that is not inferred: that it is as in mu, or only its range."""
CHANNELS = (
    "gripper x (m)",
    "gripper z (m)",
    *(f"{name} {axis}" for name in [*(f"DLO {i + 1}" for i in range(4)), *COLOURS] for axis in "uv"),
    *(f"{colour} hit" for colour in COLOURS),
    "action dx (m)",
    "action dz (m)",
)
"""Columns of a trajectory: the state's, then the action's."""
SUMMARY_NAMES = (
    *(f"{state} · {action}" for state in CHANNELS[:-2] for action in ("dx", "dz")),
    *(f"mean {state}" for state in CHANNELS[:-2]),
    *(f"sd {state}" for state in CHANNELS[:-2]),
)
"""Names of the 112 numbers of the summary."""


def task(
    object: str | None = None,
    detector: str = "mask",
    nuisances: str = "fixed",
    engine: str = "auto",
) -> Task:
    """Infer length and Young's modulus of a DLO from keypoints of one whip.

    A trajectory is 16 rows: the state before each action (28 numbers) and the action. It is summarised by how states
    go with actions, their means and their standard deviations (112 numbers).

    Args:
        object: what is observed: a stand-in for a real object by name ("dlo-0" to "dlo-3"), or the path of a recorded
            rollout's .npz (`jaxlfi.envs.whip.recording`). The simulator applies its actions and looks from where its camera
            stood. Without one, a simulated DLO of 230 mm and 8 kPa is observed under the exploratory actions.
        detector: how simulated keypoints err (`jaxlfi.envs.whip.vision.keypoints.DETECTORS`): "clean", "mask", "noisy" or
            "transporter". It ought to be like the detector that made the observation; the stand-ins' is "mask".
        nuisances: "fixed": density, cubes and placement are as in mu; "random": only their ranges are known.
        engine: "native", "mjx" or "auto", the one that suits the platform.

    Raises:
        ValueError: for names that are not known and recordings that do not fit.
    """
    for name, choice, known in (("detector", detector, DETECTORS), ("nuisances", nuisances, NUISANCES)):
        if choice not in known:
            raise ValueError(f"{name}: expected one of {sorted(known)}, got {choice!r}")
    observed = None if object is None else recorded(object)
    actions = exploratory_actions() if observed is None else observed.actions
    camera = None if observed is None else observed.camera
    make = functools.partial(whip_task, pick(engine), DETECTORS[detector], NUISANCES[nuisances], actions, camera)
    if observed is None:
        return make(truth=TRUTH)
    return make(observation=recordings.trajectory(observed))


def recorded(object: str) -> recordings.Recording:
    """A stand-in's rollout by its name, or a rollout from a file.

    Raises:
        ValueError: where there is neither.
    """
    stand_ins = {path.stem: path for path in sorted(DATA.glob("dlo-*.npz"))}
    path = stand_ins.get(object, Path(object))
    if not path.exists():
        raise ValueError(f"object: expected one of {', '.join(stand_ins)} or a recorded rollout's .npz, got {object!r}")
    return recordings.read(path)


def whip_task(
    engine: Engine,
    detector: Detector,
    nuisances: Callable[..., WhipParameters],
    actions: Float[Array, "time 2"],
    camera=None,
    truth=None,
    observation=None,
) -> Task:
    """The task of its parts, for studies that choose them themselves.

    Args:
        engine: of the physics.
        detector: of simulated keypoints.
        nuisances: the scene of a key, a length (m) and a modulus (Pa).
        actions: that every rollout applies, shape [T, 2], in m.
        camera: through which every rollout is seen; by default each scene's own side camera.
        truth: length (m) and Young's modulus (Pa) of the observed DLO, where they are known.
        observation: the observed trajectory, shape [T, 30].
    """
    actions = jnp.asarray(actions, jnp.float32)

    def simulate(key: jax.Array, theta: Float[Array, "2"]):
        key_scene, key_keypoints = jax.random.split(key)
        length, young = theta / MILLIMETRES
        scene = nuisances(key_scene, length, young)
        view = side_camera(scene) if camera is None else camera
        return trajectory(key_keypoints, engine, detector, view, scene, actions)

    return Task(
        simulate,
        name="whip",
        names=("length", "young"),
        units=("mm", "Pa"),
        log=("young",),
        supports={"initial": _told(ranges.INITIAL), "feasible": _told(ranges.FEASIBLE)},
        feasible=_told(ranges.FEASIBLE),
        summary=functools.partial(cross_correlation, actions=2),
        truth=None if truth is None else np.asarray(truth) * MILLIMETRES,
        observation=observation,
        failures=("unstable",),
        summary_names=SUMMARY_NAMES,
        channels=CHANNELS,
        record_label="control step",
        settings={"rounds": 15, "batch_size": 10},
        hyperparameters={"edge": {"mass_threshold": (0.003, 0.005)}},
    )


def _told(box: Support) -> Support:
    return Support(np.asarray(box.low) * MILLIMETRES, np.asarray(box.high) * MILLIMETRES)
