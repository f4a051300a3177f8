"""Physics by MuJoCo's own threaded rollouts, called from inside compiled programs: the fast engine on a processor."""

import functools
import os
import threading
from collections import OrderedDict

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from jaxtyping import Array, Float

from envs.whip.edits import edited_model
from envs.whip.engine import State, ramp, settled
from envs.whip.parameters import WhipParameters
from envs.whip.scene import Scene, base_model

CACHED_MODELS = 2048
"""Models that are kept, of 65 kB each: more than there are scenes in most batches, which are stepped many times."""
CHUNK = 256
"""Scenes that are rolled out in one call, to bound the memory of the substeps' states."""


def processors() -> int:
    """Processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class NativeEngine:
    """MuJoCo on all cores: one model a scene, built where it is first seen, and stepped outside of JAX."""

    def __init__(self, scene: Scene = Scene(), threads: int | None = None):
        """An engine with its own pool of threads.

        Args:
            scene: what all its scenes have in common.
            threads: as many as there are processors for this process, by default.
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
    flat = lambda leaf: np.asarray(leaf).reshape(-1, *np.shape(leaf)[len(batch) :])
    parameters, state, target = (jax.tree.map(flat, tree) for tree in (parameters, state, target))
    qpos, qvel, failed = (np.array(leaf) for leaf in (state.qpos, state.qvel, state.failed))
    alive = np.flatnonzero(~failed)
    with _LOCK:
        for rows in np.split(alive, range(CHUNK, len(alive), CHUNK)) if len(alive) else ():
            models = [_models(scene, jax.tree.map(lambda leaf, row=row: leaf[row], parameters)) for row in rows]
            start = np.concatenate([np.zeros((len(rows), 1)), qpos[rows], qvel[rows]], axis=1)
            control = np.stack([ramp(state.target[row], target[row], scene.substeps, np) for row in rows])
            pool, data = _pool(scene, threads)
            states, _ = pool.rollout(models, data, start, control)
            last = states[:, -1]
            # MuJoCo stops the clock of a simulation that has become unstable.
            stopped = np.abs(last[:, 0] - scene.control_interval) > scene.timestep / 2
            failed[rows] = stopped | ~np.isfinite(last).all(axis=1)
            good = rows[~failed[rows]]
            qpos[good], qvel[good] = np.split(last[~failed[rows], 1:], [qpos.shape[1]], axis=1)
    return tuple(leaf.reshape(*batch, *leaf.shape[1:]) for leaf in (qpos, qvel, failed))


_LOCK = threading.Lock()
"""Around the pools, each of which runs one rollout at a time, and the models."""


@functools.lru_cache(maxsize=8)
def _pool(scene: Scene, threads: int) -> tuple[mujoco.rollout.Rollout, list[mujoco.MjData]]:
    """Threads, and the memory each of them works in."""
    return mujoco.rollout.Rollout(nthread=threads), [mujoco.MjData(base_model(scene)) for _ in range(threads)]


class _Models:
    """Models by their parameters, the least recently used forgotten first."""

    def __init__(self):
        self._kept: OrderedDict[tuple, mujoco.MjModel] = OrderedDict()

    def __call__(self, scene: Scene, parameters: WhipParameters) -> mujoco.MjModel:
        key = (scene, *(leaf.tobytes() for leaf in jax.tree.leaves(parameters)))
        if key not in self._kept:
            self._kept[key] = edited_model(scene, jax.tree.map(np.float64, parameters))
            if len(self._kept) > CACHED_MODELS:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]


_models = _Models()
