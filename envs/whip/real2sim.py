"""Real2Sim: the length and stiffness of a DLO from one whip or several, as an inference task (section VI-F)."""

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.envs.whip import designed, formats
from jaxlfi.envs.whip import parameters as ranges
from jaxlfi.envs.whip import recording as recordings
from jaxlfi.envs.whip.exploration import exploratory_actions
from jaxlfi.envs.whip.frames import COLOURS
from jaxlfi.envs.whip.parameters import MILLIMETRES, WhipParameters, in_task_units, median, randomised
from jaxlfi.envs.whip.physics.engine import Engine
from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.envs.whip.trajectory import trajectory
from jaxlfi.envs.whip.vision.camera import side_camera
from jaxlfi.envs.whip.vision.keypoints import DETECTORS, ON_DLO, PIXEL, Detector
from jaxlfi.tasks.summaries import cross_correlation
from jaxlfi.tasks.task import Task
from jaxlfi.tasks.trials import check_pooling, summarised_jointly, together

TRUTH = (0.23, 8e3)
"""Length (m) and Young's modulus (Pa) of the simulated DLO that is observed if no object is named."""
DATA = Path(__file__).parent / "data"
"""Folder of the recorded rollouts of the FEM reference objects."""
NUISANCES: dict[str, Callable[..., WhipParameters]] = {
    "fixed": lambda key, length, young: median(length, young),
    "random": randomised,
}
"""Assumptions about the parameters that are not inferred: the values of mu, or uniform in their ranges."""
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
    object: str | Sequence[str] | None = None,
    detector: Literal["clean", "mask", "noisy", "transporter", "learnt", "learnt-transporter"] = "mask",
    nuisances: Literal["fixed", "random"] = "fixed",
    engine: Literal["auto", "native", "mjx", "warp"] = "auto",
    pooling: Literal["mean", "all", "moments"] = "mean",
    stack: Literal["clear", "any"] = "clear",
) -> Task:
    """Infer length and Young's modulus of a DLO from keypoints of one whip, or of several.

    A trajectory is 16 rows: the state before each action (28 numbers) and the action. It is summarised by the
    cross-correlations of states and actions, and the means and standard deviations of the states (112 numbers). The
    rows of several rollouts follow one another, and `pooling` combines their summaries into one.

    Args:
        object: the observed object: an FEM reference object by name ("dlo-0" to "dlo-3"), or the path of a recorded
            rollout (`formats`): .npz, as `jaxlfi whip render` also writes it, .mcap, or the folder of a LeRobot data
            set, FOLDER#episode=3 if it has several. Simulations apply its actions and are seen through its camera.
            Several recorded rollouts of one object, a name or path each, are combined into one posterior (`whip_task`).
            By default, a simulated DLO of 230 mm and 8 kPa is observed under the exploratory actions.
        detector: the error model of simulated keypoints (`vision.keypoints.DETECTORS`). Its errors should resemble
            those of the detector that made the observation: "mask" for the recordings of the reference objects that
            come with the package, and for those of `jaxlfi whip record` the detector's own name, or "mask" for
            "centreline".
        nuisances: "fixed": density, cubes and placement are as in mu; "random": only their ranges are known.
        engine: the physics: "auto" is the one that suits the platform.
        pooling: how the summaries of several rollouts are combined. With few simulations, their "mean" serves as well
            as "all" of them, concatenated in the order of the objects (experiments/studies/whip-rollouts.md);
            "moments" are mean and standard deviation, for rollouts under the same actions.
        stack: whether whips that `jaxlfi design` chooses have to keep "clear" of the stack of cubes. Inference does not
            depend on it.

    Raises:
        ValueError: for unknown names, recordings that do not fit, and recordings that are given twice or have
            different control intervals.
    """
    for name, choice, known in (
        ("detector", detector, DETECTORS),
        ("nuisances", nuisances, NUISANCES),
        ("stack", stack, designed.STACKS),
    ):
        if choice not in known:
            raise ValueError(f"{name}: expected one of {sorted(known)}, got {choice!r}")
    check_pooling(pooling)
    make = functools.partial(whip_task, pick(engine), DETECTORS[detector], NUISANCES[nuisances], stack=stack)
    if object is None:
        return make(exploratory_actions(), truth=TRUTH)
    names = [object] if isinstance(object, str | Path) else list(object)
    observed = [recorded(name) for name in names]
    if len(observed) == 1:
        return make(observed[0].actions, observed[0].camera, observation=recordings.trajectory(observed[0]))
    _check_together(names, observed)
    return make(
        np.stack([one.actions for one in observed]),
        jax.tree.map(lambda *leaves: jnp.stack(leaves), *(one.camera for one in observed)),
        observation=together([recordings.trajectory(one) for one in observed]),
        pooling=pooling,
    )


def recorded(object: str) -> recordings.Recording:
    """The rollout of a reference object by its name, or a rollout from a file.

    Raises:
        ValueError: if there is no such object or file.
        ImportError: if the extra `robotics` is needed and not installed.
    """
    known = {path.stem: path for path in sorted(DATA.glob("dlo-*.npz"))}
    if object in known:
        return recordings.read(known[object])
    if not formats.located(object)[0].exists():
        raise ValueError(
            f"object: expected one of {', '.join(known)}, or a recorded rollout: {formats.FORMATS}, got {object!r}"
        )
    return formats.read(object)


def whip_task(
    engine: Engine,
    detector: Detector,
    nuisances: Callable[..., WhipParameters],
    actions: Float[Array, "time 2"] | Float[Array, "rollouts time 2"],
    camera=None,
    truth=None,
    observation=None,
    pooling: str = "mean",
    stack: str = "clear",
) -> Task:
    """The task assembled from its parts, for studies that choose them.

    A simulation of several rollouts simulates each of them, the i-th with the key `fold_in(key, i)`. They share length,
    modulus and nuisances, except for the position of the stack of cubes, which is rebuilt for each. The simulation
    fails if any rollout fails.

    Args:
        engine: the physics.
        detector: error model of simulated keypoints; errors drawn once per trajectory are drawn once per rollout.
        nuisances: function that makes a scene from a key, a length (m) and a modulus (Pa).
        actions: actions of every simulation, shape [T, 2], in m; for several rollouts shape [n, T, 2].
        camera: camera that sees every simulation; for several rollouts one each, stacked. By default the side camera of
            each scene.
        truth: length (m) and Young's modulus (Pa) of the observed DLO, if they are known.
        observation: the observed trajectory, shape [T, 30]; for several rollouts concatenated, shape [n T, 30].
        pooling: how the summaries of several rollouts are combined; see `task`.
        stack: restriction of the designs; see `task`. Designs are seen through the first of several cameras.

    Raises:
        ValueError: for actions of another shape, and an unknown pooling.
    """
    actions = jnp.asarray(actions, jnp.float32)
    if actions.ndim not in (2, 3) or actions.shape[-1] != 2 or 0 in actions.shape:
        raise ValueError(f"actions: expected shape [T, 2], or [n, T, 2] of rollouts, got {list(actions.shape)}")

    def one(key: jax.Array, theta: Float[Array, "2"]):
        key_scene, key_keypoints = jax.random.split(key)
        scene = nuisances(key_scene, *(theta / MILLIMETRES))
        view = side_camera(scene) if camera is None else camera
        return trajectory(key_keypoints, engine, detector, view, scene, actions)

    def several(key: jax.Array, theta: Float[Array, "2"]):
        def scene_of(key):
            return nuisances(key, *(theta / MILLIMETRES))

        first = scene_of(jax.random.split(jax.random.fold_in(key, 0))[0])

        def rollout(i):
            key_scene, key_keypoints = jax.random.split(jax.random.fold_in(key, i))
            scene = first.replace(stack=scene_of(key_scene).stack)
            view = side_camera(scene) if camera is None else jax.tree.map(lambda leaf: leaf[i], camera)
            return trajectory(key_keypoints, engine, detector, view, scene, actions[i])

        # Not vmap: JAX copies callback arguments of 100 kB and more in a thread of its pool, and if the callbacks of
        # all devices hold these threads, all wait forever. Batches therefore stay as small as for one rollout.
        rows, valid = jax.lax.map(rollout, jnp.arange(len(actions)))
        return rows.reshape(-1, rows.shape[-1]), jnp.all(valid)

    made = Task(
        one if actions.ndim == 2 else several,
        name="whip",
        names=("length", "young"),
        units=("mm", "Pa"),
        log=("young",),
        supports={"initial": in_task_units(ranges.INITIAL), "feasible": in_task_units(ranges.FEASIBLE)},
        feasible=in_task_units(ranges.FEASIBLE),
        summary=functools.partial(cross_correlation, actions=2),
        truth=None if truth is None else np.asarray(truth) * MILLIMETRES,
        observation=observation,
        failures=("unstable",),
        summary_names=SUMMARY_NAMES,
        channels=CHANNELS,
        channel_noise=channel_noise(detector),
        record_label="control step",
        settings={"rounds": 15, "min_rounds": 15, "batch_size": 10},
        hyperparameters={"edge": {"mass_threshold": (0.003, 0.005), "uninformed_factor": 1.0}},
    )
    one_camera = camera if camera is None or actions.ndim == 2 else jax.tree.map(lambda leaf: leaf[0], camera)
    whipping = designed.Whipping(engine, detector, nuisances, one_camera, designed.STACKS[stack])
    made = designed.with_design(made, whipping)
    return made if actions.ndim == 2 else summarised_jointly(made, len(actions), pooling, "rollout")


def channel_noise(detector: Detector) -> Float[np.ndarray, "30"]:
    """Standard deviation of a detector's errors in each of `CHANNELS`, at least that of an image's resolution."""
    on_dlo, cube = (np.hypot(detector.bias, own) for own in (detector.noise, detector.cube_noise))
    keypoints = np.maximum(np.repeat([on_dlo, cube], [2 * ON_DLO, 2 * len(COLOURS)]), PIXEL)
    return np.concatenate([[detector.slip] * 2, keypoints, np.zeros(len(COLOURS) + 2)])


def _check_together(names: Sequence[str], observed: Sequence[recordings.Recording]) -> None:
    """Refuse recordings that cannot be several rollouts of one rig."""
    if not observed:
        raise ValueError("object: expected at least one, got none")
    if len(set(names)) < len(names):
        raise ValueError(f"object: expected different recordings, got {', '.join(map(str, names))}")
    intervals = [one.control_interval for one in observed]
    if len(set(intervals)) > 1:
        raise ValueError(f"object: expected recordings of one control interval, got {', '.join(map(str, intervals))} s")
