"""Physics by MuJoCo's own threaded rollouts, called from inside compiled programs: the fast engine on a processor.

The contacts within the stack of cubes take four fifths of a step. While the cubes are at rest they are left out; if
the gripper or the DLO comes near them in an interval, that interval is simulated again with them.
"""

import dataclasses
import functools
import threading
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.envs.mujoco.quiet import quietly
from jaxlfi.envs.whip.parameters import WhipParameters
from jaxlfi.envs.whip.physics.edits import edited_bare_model, edited_model
from jaxlfi.envs.whip.physics.engine import State, ramp, settled
from jaxlfi.envs.whip.physics.scene import CUBES, HAND, Scene, bare_model, base_model
from jaxlfi.envs.whip.rig import SECTION
from jaxlfi.io.host_devices import processors

CACHED_MODELS = 4096
"""Models that are cached, 65 kB each: more than the scenes of most batches, which are stepped many times."""
CHUNK = 256
"""Maximum number of scenes that are rolled out in one call, which bounds the memory of the substeps' states."""


class NativeEngine:
    """MuJoCo on all cores: one model per scene, built when the scene is first seen, and stepped outside of JAX."""

    def __init__(self, scene: Scene = Scene(), threads: int | None = None):
        """An engine.

        Args:
            scene: settings that all scenes of the engine share.
            threads: number of threads; by default that of the processors that this process may use.
        """
        self.scene = scene
        self._threads = threads or processors()

    def advance(self, parameters: WhipParameters, state: State, target: Float[Array, "2"]) -> State:
        """One control interval; see `Engine.advance`."""
        shapes = (
            jax.ShapeDtypeStruct(state.qpos.shape, jnp.float32),
            jax.ShapeDtypeStruct(state.qvel.shape, jnp.float32),
            jax.ShapeDtypeStruct((), jnp.bool_),
        )
        leave = functools.partial(_advance_many, self.scene, self._threads)
        qpos, qvel, failed = jax.pure_callback(leave, shapes, parameters, state, target, vmap_method="broadcast_all")
        return settled(state, qpos, qvel, target, failed)


def _advance_many(scene: Scene, threads: int, parameters: WhipParameters, state: State, target):
    """Advance all scenes of a batch of any number of axes; NumPy in, NumPy out."""
    batch = np.shape(target)[:-1]
    flat = lambda leaf: np.array(leaf).reshape((-1, *np.shape(leaf)[len(batch) :]))
    parameters, state, target = (jax.tree.map(flat, tree) for tree in (parameters, state, target))
    alive = np.flatnonzero(~state.failed)
    with _LOCK:
        for rows in np.split(alive, range(CHUNK, len(alive), CHUNK)) if len(alive) else ():
            _advance_rows(_rollout_pool(scene, threads), rows, parameters, state, target)
    return tuple(leaf.reshape((*batch, *leaf.shape[1:])) for leaf in (state.qpos, state.qvel, state.failed))


_LOCK = threading.Lock()
"""Held while a rollout pool is in use: each does one rollout at a time."""


def _advance_rows(pool: "_RolloutPool", rows: np.ndarray, parameters: WhipParameters, state: State, target) -> None:
    """Advance some scenes, in place; cubes at rest are left out unless something comes near them."""
    scene, still = pool.scene, np.all(state.qvel[rows, -6 * CUBES :] == 0, axis=1)
    first, last = scene.first_cube, state.qvel.shape[1] - 6 * CUBES
    control = np.stack([ramp(state.target[row], target[row], scene.substeps, np) for row in rows])
    pick = lambda row: jax.tree.map(lambda leaf: leaf[row], parameters)

    bare = rows[still]
    ends, failed, places = pool.bare.roll(
        [pick(row) for row in bare], state.qpos[bare, :first], state.qvel[bare, :last], control[still]
    )
    cubes = state.qpos[bare, first:].reshape(-1, CUBES, 7)[..., :3]
    alone = ~_near(scene, places, cubes, parameters.length[bare], parameters.cube_side[bare])
    state.qpos[bare[alone], :first], state.qvel[bare[alone], :last] = (end[alone] for end in ends)
    state.failed[bare[alone]] = failed[alone]

    together = np.setdiff1d(rows, bare[alone], assume_unique=True)
    ends, failed, _ = pool.whole.roll(
        [pick(row) for row in together],
        state.qpos[together],
        state.qvel[together],
        control[np.isin(rows, together)],
    )
    state.qpos[together], state.qvel[together] = ends
    state.failed[together] = failed


def _near(scene: Scene, places, cubes, length, side) -> np.ndarray:
    """Whether the gripper or a link has come so near to a cube that their bounding spheres touch, shape [B].

    Args:
        scene: the scene.
        places: centres of the gripper and the links at each collision check, shape [B, time, 1 + links, 3].
        cubes: positions of the cubes at rest, shape [B, 6, 3].
        length: of the DLO, shape [B].
        side: of the cubes, shape [B].
    """
    links = scene.chain.fractions * length[:, None] / 2 + SECTION / 2
    hand = np.full((len(length), 1), np.linalg.norm(HAND))
    reach = np.concatenate([hand, links], axis=1) + side[:, None] / 2 * 3**0.5  # [B, 1 + links]
    middle = cubes.mean(axis=1)
    radius = np.linalg.norm(cubes - middle[:, None], axis=-1).max(axis=-1, initial=0.0)
    # Most links never come near the stack as a whole.
    suspects = np.any(
        np.linalg.norm(places - middle[:, None, None], axis=-1) < (reach + radius[:, None])[:, None], axis=(1, 2)
    )
    near = np.zeros(len(length), bool)
    for row in np.flatnonzero(suspects):
        distances = np.linalg.norm(places[row, :, :, None] - cubes[row], axis=-1)
        near[row] = np.any(distances < reach[row][:, None])
    return near


class _ModelCache:
    """The models of one kind that were built last, and the memory that threads simulate them in."""

    def __init__(self, scene: Scene, base: mujoco.MjModel, make: Callable, rollout, threads: int):
        self._scene, self._base, self._rollout = scene, base, rollout
        self._data = [mujoco.MjData(base) for _ in range(threads)]
        self._model = functools.lru_cache(CACHED_MODELS)(lambda parameters: make(scene, parameters, self._data[0]))

    def roll(self, parameters: Sequence[WhipParameters], qpos, qvel, control):
        """Simulate one control interval of each scene.

        Returns:
            Positions and velocities at its end; which scenes have failed; the sensors' points at all substeps.
        """
        if not parameters:
            return (qpos, qvel), np.zeros(0, bool), np.zeros((0, self._scene.substeps, self._base.nsensor, 3))
        models = [self._model(_hashable(scene)) for scene in parameters]
        start = np.concatenate([np.zeros((len(models), 1)), qpos, qvel], axis=1)
        with quietly():
            states, points = self._rollout.rollout(models, self._data, start, control)
        end = states[:, -1]
        # MuJoCo stops the clock of a simulation that has become unstable.
        stopped = np.abs(end[:, 0] - self._scene.control_interval) > self._scene.timestep / 2
        failed = stopped | ~np.isfinite(end).all(axis=1)
        after = np.where(failed[:, None], start, end)[:, 1:]
        points = points.reshape(*points.shape[:2], -1, 3)
        return np.split(after, [qpos.shape[1]], axis=1), failed, points


def _hashable(parameters: WhipParameters) -> WhipParameters:
    """The same in Python's numbers."""
    plain: dict[str, Any] = {
        name: tuple(leaf.tolist()) if leaf.ndim else leaf.item() for name, leaf in vars(parameters).items()
    }
    return WhipParameters(**plain)


@dataclasses.dataclass
class _RolloutPool:
    """The threads of a rollout, and the two caches of models: with the cubes and without."""

    scene: Scene
    whole: _ModelCache
    bare: _ModelCache


@functools.lru_cache(maxsize=8)
def _rollout_pool(scene: Scene, threads: int) -> _RolloutPool:
    rollout = mujoco.rollout.Rollout(nthread=threads)
    whole = _ModelCache(scene, base_model(scene), edited_model, rollout, threads)
    bare = _ModelCache(scene, bare_model(scene), edited_bare_model, rollout, threads)
    return _RolloutPool(scene, whole, bare)
