"""Scenes to take pictures of: frames of random rollouts, over a uniform prior of the DLO and of everything else."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.envs.whip import planner
from jaxlfi.envs.whip.exploration import exploratory_actions
from jaxlfi.envs.whip.frames import COLOURS, Frames
from jaxlfi.envs.whip.parameters import FEASIBLE, WhipParameters, randomised
from jaxlfi.envs.whip.physics.engine import Engine
from jaxlfi.envs.whip.quaternions import normalised
from jaxlfi.envs.whip.trajectory import seen

BATCH = 50
"""Rollouts that are simulated at a time."""
STREWN = (0.25, -0.08, 0.02), (0.74, 0.08, 0.4)
"""Between which cubes are strewn, in m."""


class Rollouts(struct.PyTreeNode):
    """Rollouts of N scenes, each of 17 frames.

    Attributes:
        parameters: of the scenes, stacked.
        frames: before each action and after the last.
        valid: whether the simulation was stable, shape [N].
    """

    parameters: WhipParameters
    frames: Frames
    valid: Bool[Array, " rollouts"]


def random_scene(key: jax.Array) -> WhipParameters:
    """A scene with length and the logarithm of the modulus uniform in Phi, and all nuisances in their ranges."""
    key_theta, key_rest = jax.random.split(key)
    fraction = jax.random.uniform(key_theta, (2,))
    low, high = jnp.asarray(FEASIBLE.low), jnp.asarray(FEASIBLE.high)
    length = low[0] + fraction[0] * (high[0] - low[0])
    return randomised(key_rest, length, low[1] * (high[1] / low[1]) ** fraction[1])


def random_actions(key: jax.Array) -> Float[Array, "16 2"]:
    """Actions of random policies: half of the time a random walk in the workspace, else whips in a random order."""
    key_kind, key_walk, key_order = jax.random.split(key, 3)
    walk = planner.random_walk(key_walk)
    whips = jnp.asarray(exploratory_actions())
    whips = planner.inside(jnp.concatenate([whips[:2], jax.random.permutation(key_order, whips[2:])]))
    return jnp.where(jax.random.bernoulli(key_kind), walk, whips)


def strewn(key: jax.Array, frame: Frames, cube_side: Float[Array, ""] | float) -> Frames:
    """The same frame with its cubes anywhere: half of them lie on the table, half are in flight.

    Of random actions few topple the stack, and a network that has not seen it toppled knows cubes by their neighbours.
    """
    key_place, key_flight, key_yaw, key_turn = jax.random.split(key, 4)
    n = len(COLOURS)
    places = jax.random.uniform(key_place, (n, 3), minval=jnp.array(STREWN[0]), maxval=jnp.array(STREWN[1]))
    flies = jax.random.bernoulli(key_flight, shape=(n, 1))
    yaw = jax.random.uniform(key_yaw, (n,), maxval=np.pi)
    lies = jnp.stack([jnp.cos(yaw / 2), 0 * yaw, 0 * yaw, jnp.sin(yaw / 2)], axis=-1)
    turned = normalised(jax.random.normal(key_turn, (n, 4)))
    heights = jnp.where(flies[:, 0], places[:, 2], 0.5 * cube_side)
    return frame.replace(cubes=places.at[:, 2].set(heights), orientations=jnp.where(flies, turned, lies))


@functools.partial(jax.jit, static_argnums=1)
def _rolled(keys: jax.Array, engine: Engine) -> Rollouts:
    def one(key):
        key_scene, key_actions = jax.random.split(key)
        parameters = random_scene(key_scene)
        frames, failed = seen(engine, parameters, random_actions(key_actions))
        return Rollouts(parameters, frames, ~failed)

    return jax.vmap(one)(keys)


def rollouts(key: jax.Array, engine: Engine, n: int, on_batch: Callable[[int], Any] = lambda count: None) -> Rollouts:
    """N random rollouts, as NumPy arrays; the i-th does not depend on N.

    Args:
        key: of them all.
        engine: the physics.
        n: their number.
        on_batch: called with the number of rollouts of each batch that is done.
    """
    parts = []
    for first in range(0, n, BATCH):
        keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(first + jnp.arange(BATCH))
        parts.append(jax.device_get(_rolled(keys, engine)))
        on_batch(min(BATCH, n - first))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:n], *parts)
