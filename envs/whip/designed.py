"""The whips that `jaxlfi design` chooses from: where the gripper's set-point goes, and what must not happen.

The set-point goes to eight points one after another, for two control steps each, as fast as the action limit allows.
Every design can therefore be executed. Simulations check that the gripper itself stays in its workspace and that the
stack of cubes is left alone.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.exploration import exploratory_actions
from jaxlfi.envs.whip.parameters import MILLIMETRES, WhipParameters
from jaxlfi.envs.whip.physics.engine import Engine
from jaxlfi.envs.whip.rig import CONTROL_INTERVAL, KEYPOINTS, ON_DLO, START
from jaxlfi.envs.whip.trajectory import as_seen, seen
from jaxlfi.envs.whip.vision.camera import Camera, project, side_camera
from jaxlfi.envs.whip.vision.keypoints import PIXEL, Detector, along
from jaxlfi.tasks.design import Design
from jaxlfi.tasks.equality import same
from jaxlfi.tasks.host import HostSimulator
from jaxlfi.tasks.task import Task

MOVES = 8
"""Number of points that the set-point goes to, one after another, in equally many control steps each."""
REACH = {"x": (0.29, 0.52), "z": (START[1], 0.49)}
"""Ranges of these points, in m: within the workspace, and no lower than the start, where long DLOs clear the table."""
VARIABLES = {f"{axis} {i + 1}": (*bounds, "m") for axis, bounds in REACH.items() for i in range(MOVES)}
"""Design variables of a whip: bounds and unit, by name."""
TOUCHED = 0.002
"""Displacement of a cube above which the stack counts as touched, in m: cubes at rest move by a tenth of it."""
FAILURES = ("unstable", "outside", "touched")
"""Reasons why a simulation of a design fails; "touched" is none if the stack may be touched."""
STACKS = {"clear": True, "any": False}
"""Whether designs have to leave the stack of cubes alone, by the value of the whip's option `stack`."""
CHUNK = 8
"""Number of rollouts per call of the engine, always the same, so that one compiled program serves all."""
HEADINGS = ("time [s]", "dx [m]", "dz [m]")
"""Columns of the table of actions."""


def actions(design: Float[np.ndarray, "16"]) -> Float[np.ndarray, "16 2"]:
    """The displacements of the set-point that a design stands for, in m, within the limits of actions.

    Args:
        design: values of `VARIABLES`.

    Example:
        >>> actions(np.array([0.45] * 8 + [0.36] + [0.40] * 7))[:4].round(3).tolist()
        [[0.05, 0.0], [0.0, 0.0], [0.0, 0.04], [0.0, 0.0]]
    """
    at, found = np.array(START), []
    for point in np.repeat(np.reshape(np.asarray(design, float), (2, MOVES)).T, rules.STEPS // MOVES, axis=0):
        found.append(np.clip(point - at, -rules.ACTION_LIMIT, rules.ACTION_LIMIT))
        at = at + found[-1]
    return np.stack(found)


def nominal() -> list[float]:
    """The set-point of the exploratory actions after every other step, clipped to `REACH`."""
    path = np.array(START) + np.cumsum(np.asarray(exploratory_actions(), float), axis=0)
    low, high = np.array(list(REACH.values())).T
    return np.clip(path[rules.STEPS // MOVES - 1 :: rules.STEPS // MOVES], low, high).T.ravel().tolist()


def table(design: Float[np.ndarray, "16"]) -> tuple[list[str], Float[np.ndarray, "16 3"]]:
    """Headings and rows of the table of actions: when each begins, and its displacements."""
    return list(HEADINGS), np.column_stack([CONTROL_INTERVAL * np.arange(rules.STEPS), actions(design)])


@dataclasses.dataclass(frozen=True, eq=False)
class Whipping:
    """Simulates whips by their designs; `jaxlfi.HostSimulator` calls it.

    Attributes:
        engine: the physics.
        detector: error model of the simulated keypoints.
        nuisances: function that makes a scene from a key, a length (m) and a modulus (Pa).
        camera: camera that sees the simulations; by default the side camera of each scene.
        clear: whether the stack of cubes has to be left alone.
    """

    engine: Engine
    detector: Detector
    nuisances: Callable[..., WhipParameters]
    camera: Camera | None
    clear: bool

    def __call__(self, rng: np.random.Generator, theta: Float[np.ndarray, "n 2"], design: np.ndarray) -> Any:
        """Trajectories [N, 16, 30], and their failure codes: 0, or one plus the index in `FAILURES`."""
        keys = jax.random.split(jax.random.key(int(rng.integers(2**31))), len(theta))
        return _in_chunks(self._seen, keys, theta, actions(design))

    def response(self, theta: Float[np.ndarray, "n 2"], design: np.ndarray) -> Float[np.ndarray, "n 16 20"]:
        """Keypoints without noise, transformed such that the detector's errors are independent (`independent`).

        They are NaN if a simulation becomes unstable.
        """
        return self.played(theta, actions(design))

    def played(
        self, theta: Float[np.ndarray, "n 2"], actions: Float[np.ndarray, "16 2"]
    ) -> Float[np.ndarray, "n 16 20"]:
        """The same for any actions."""
        keys = jax.random.split(jax.random.key(0), len(theta))  # nothing is drawn
        return _in_chunks(self._clean, keys, theta, actions)

    @functools.cached_property
    def _seen(self) -> Callable:
        def one(key: Array, theta: Array, played: Array) -> tuple[Array, Array]:
            key_scene, key_keypoints = jax.random.split(key)
            scene = self.nuisances(key_scene, *(theta / MILLIMETRES))
            view, failed = seen(self.engine, scene, played)
            before = jax.tree.map(lambda leaf: leaf[:-1], view)
            found = as_seen(key_keypoints, self.detector, self._view(scene), before, played)
            moved = jnp.linalg.norm(view.cubes - view.cubes[0], axis=-1).max()
            reasons = jnp.stack([failed, rules.outside(view.gripper).any(), (moved > TOUCHED) & self.clear])
            return found, jnp.where(reasons.any(), jnp.argmax(reasons) + 1, 0)

        return jax.jit(jax.vmap(one, (0, 0, None)))

    @functools.cached_property
    def _clean(self) -> Callable:
        fractions = jnp.asarray(places(self.detector))

        def one(key: Array, theta: Array, played: Array) -> Array:
            scene = self.nuisances(key, *(theta / MILLIMETRES))
            view, failed = seen(self.engine, scene, played[:-1])
            points = jax.vmap(lambda line, cubes: jnp.concatenate([along(line, fractions), cubes]))(
                view.dlo, view.cubes
            )
            clean = project(self._view(scene), points).reshape(len(points), -1)
            return jnp.where(failed, jnp.nan, independent(self.detector, clean))

        return jax.jit(jax.vmap(one, (0, 0, None)))

    @property
    def certain(self) -> bool:
        """Whether nothing is random but the detector's errors, which are independent."""
        first, second = (self.nuisances(jax.random.key(seed), 0.25, 2.5e4) for seed in (0, 1))
        return places(self.detector) is not None and same(jax.device_get(first), jax.device_get(second))

    def _view(self, scene: WhipParameters) -> Camera:
        return side_camera(scene) if self.camera is None else self.camera


def _in_chunks(function: Callable, keys: Array, theta: np.ndarray, actions: np.ndarray) -> Any:
    """Apply a function of `CHUNK` parameter vectors to any number of them."""
    played, parts = jnp.asarray(actions, jnp.float32), []
    for first in range(0, len(theta), CHUNK):
        rows = np.minimum(np.arange(first, first + CHUNK), len(theta) - 1)
        done = function(keys[rows], jnp.asarray(theta[rows], jnp.float32), played)
        parts.append(jax.tree.map(lambda leaf, n=len(theta) - first: np.asarray(leaf)[:n], done))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def places(detector: Detector) -> Float[np.ndarray, "4"] | None:
    """Positions of a detector's keypoints on the DLO, as fractions of its length; None if they are random."""
    drawn = detector.places is not None or float(detector.shuffled) or float(detector.missing)
    slack = float(detector.farthest) - float(detector.nearest) - (ON_DLO - 1) * float(detector.spacing)
    return None if drawn or abs(slack) > 1e-6 else float(detector.nearest) + float(detector.spacing) * np.arange(ON_DLO)


def noise_of(detector: Detector) -> Float[np.ndarray, "20"]:
    """Standard deviation of a detector's errors in each frame, at least that of an image's resolution (`PIXEL`)."""
    own = np.repeat([float(detector.noise), float(detector.cube_noise)], [2 * ON_DLO, 2 * (KEYPOINTS - ON_DLO)])
    return np.maximum(own, PIXEL)


def independent(detector: Detector, keypoints: Float[Array, "time 20"]) -> Float[Array, "time 20"]:
    """Keypoints transformed such that a detector's errors are independent between frames, with those of `noise_of`.

    The errors of one coordinate in T frames have the covariance n^2 I + b^2 11', as the bias b is the same in all
    frames; their mean has the standard deviation sqrt(n^2 / T + b^2). Subtracting a fraction of the coordinates' mean
    gives errors of covariance n^2 I, with no loss of information.
    """
    noise = jnp.asarray(noise_of(detector), jnp.float32)
    kept = noise / jnp.sqrt(noise**2 + len(keypoints) * jnp.asarray(detector.bias) ** 2)
    return keypoints - (1 - kept) * jnp.mean(keypoints, axis=0)


def with_design(task: Task, whipping: Whipping) -> Task:
    """The task of some recordings, together with the whips that may be chosen next.

    Args:
        task: task of the recordings.
        whipping: simulates the whips. If nothing is random but its detector's known errors, designs are rated by Fisher
            information, and otherwise by contrasts.
    """
    known: dict[str, Any] = {"response": whipping.response, "noise": noise_of(whipping.detector)}
    with jax.ensure_compile_time_eval():  # tasks are also made while a function of their actions is traced
        design = Design(VARIABLES, nominal(), controls=table, **(known if whipping.certain else {}))
    one = dataclasses.replace(
        task,
        name="whip",
        simulate=HostSimulator(whipping),
        failures=FAILURES,
        observation=None,
        truth=None,
        design=design,
    )
    return dataclasses.replace(task, design=dataclasses.replace(design, of=one))
