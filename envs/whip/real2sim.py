"""Real2Sim: the length and stiffness of a DLO from one whip, as an inference task (section VI-F)."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.distributions.support import Support
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
from jaxlfi.tasks.summaries import cross_correlation
from jaxlfi.tasks.task import Task

TRUTH = (0.23, 8e3)
"""Length (m) and Young's modulus (Pa) of the simulated DLO that is observed where no object is named."""
DATA = Path(__file__).parent / "data"
"""Folder of the recorded rollouts of the FEM reference objects."""
MILLIMETRES = np.array([1e3, 1.0])
"""Factors from (m, Pa) to the units of the task's parameters, (mm, Pa)."""
NUISANCES: dict[str, Callable[..., WhipParameters]] = {
    "fixed": lambda key, length, young: median(length, young),
    "random": randomised,
}
"""Assumptions on the parameters that are not inferred: the values of mu, or uniform in their ranges."""
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
    detector: Literal["clean", "mask", "noisy", "transporter"] = "mask",
    nuisances: Literal["fixed", "random"] = "fixed",
    engine: Literal["auto", "native", "mjx", "warp"] = "auto",
) -> Task:
    """Infer length and Young's modulus of a DLO from keypoints of one whip.

    A trajectory is 16 rows: the state before each action (28 numbers) and the action. It is summarised by the
    cross-correlations of states and actions, and the means and standard deviations of the states (112 numbers).

    Args:
        object: the observed object: an FEM reference object by name ("dlo-0" to "dlo-3"), or the path of a recorded
            rollout's .npz (`recording`), which `jaxlfi whip render` writes, too. Simulations apply its actions and are
            seen through its camera. By default, a simulated DLO of 230 mm and 8 kPa is observed under the exploratory
            actions.
        detector: the errors of simulated keypoints (`vision.keypoints.DETECTORS`). They should resemble those of the
            detector that the observation was made with; for the reference objects, that is "mask".
        nuisances: "fixed": density, cubes and placement are as in mu; "random": only their ranges are known.
        engine: the physics: "auto" is the one that suits the platform.

    Raises:
        ValueError: for unknown names and recordings that do not fit.
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
    """The rollout of a reference object by its name, or a rollout from a file.

    Raises:
        ValueError: if there is no such object or file.
    """
    known = {path.stem: path for path in sorted(DATA.glob("dlo-*.npz"))}
    path = known.get(object, Path(object))
    if not path.exists():
        raise ValueError(f"object: expected one of {', '.join(known)} or a recorded rollout's .npz, got {object!r}")
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
    """The task made of its parts, for studies that choose them.

    Args:
        engine: the physics.
        detector: of simulated keypoints.
        nuisances: makes a scene of a key, a length (m) and a modulus (Pa).
        actions: of every rollout, shape [T, 2], in m.
        camera: through which every rollout is seen; by default the side camera of each scene.
        truth: length (m) and Young's modulus (Pa) of the observed DLO, if they are known.
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
        supports={"initial": _in_task_units(ranges.INITIAL), "feasible": _in_task_units(ranges.FEASIBLE)},
        feasible=_in_task_units(ranges.FEASIBLE),
        summary=functools.partial(cross_correlation, actions=2),
        truth=None if truth is None else np.asarray(truth) * MILLIMETRES,
        observation=observation,
        failures=("unstable",),
        summary_names=SUMMARY_NAMES,
        channels=CHANNELS,
        record_label="control step",
        settings={"rounds": 15, "min_rounds": 15, "batch_size": 10},
        hyperparameters={"edge": {"mass_threshold": (0.003, 0.005)}},
    )


def _in_task_units(box: Support) -> Support:
    return Support(np.asarray(box.low) * MILLIMETRES, np.asarray(box.high) * MILLIMETRES)
