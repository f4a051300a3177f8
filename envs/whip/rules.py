"""The rules of the whipping task: actions, workspace, hits and rewards (sections VI-E to VI-G)."""

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.envs.whip.observer import moved

STEPS = 16
"""Number of control steps in an episode."""
ACTION_LIMIT = 0.06
"""Maximum displacement of the set-point by an action, along x and along z, in m."""
WORKSPACE = np.array([[0.275, 0.1], [0.6, 0.5]], np.float32)
"""Lower and upper limits of the gripper's x and z, in m."""
TOP = 5
"""Index of the target, the yellow cube."""
PENALTIES = np.array([0.05 * 2 ** (4 - i) for i in range(TOP)], np.float32)
"""Penalties for hitting the cubes below the target, from the red one at the bottom up."""


def moved_target(target: Float[Array, "*batch 2"], action: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
    """The set-point after an action (dx, dz) in m, which is clipped to its limit."""
    return target + jnp.clip(action, -ACTION_LIMIT, ACTION_LIMIT)


def outside(gripper: Float[Array, "*batch 2"]) -> Bool[Array, "*batch"]:
    """Whether the gripper has left its workspace, which ends the episode as a failure."""
    return ((gripper < WORKSPACE[0]) | (gripper > WORKSPACE[1])).any(axis=-1)


def hits(
    before: Bool[Array, "*batch 6"], start: Float[Array, "*batch 6 2"], cubes: Float[Array, "*batch 6 2"]
) -> Bool[Array, "*batch 6"]:
    """Which cubes have been hit so far: a cube that falls back to its place stays hit.

    Args:
        before: cubes hit before.
        start: the cubes' keypoints at the start of the episode, in normalised pixels.
        cubes: the cubes' keypoints now.
    """
    return before | moved(start, cubes)


def reward(hit: Bool[Array, "*batch 6"], out: Bool[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The reward of one step (section VI-G).

    At every step, 2 if the top cube has been hit, minus a penalty for each other cube that has been hit, in whichever
    order; -1 for leaving the workspace.

    Args:
        hit: cubes hit so far in the episode, bottom-up.
        out: whether the gripper is outside of its workspace.
    """
    return jnp.where(out, -1.0, 2.0 * hit[..., TOP] - hit[..., :TOP] @ jnp.asarray(PENALTIES))


class Verdict(struct.PyTreeNode):
    """The rules applied to one step.

    Attributes:
        hit: cubes hit so far, bottom-up, shape [6].
        outside: whether the gripper has left its workspace.
        reward: see `reward`; 0 if the simulation has become unstable.
        over: whether the episode ends: the top cube is hit, the gripper is outside, or the simulation is unstable.
    """

    hit: Bool[Array, "*batch 6"]
    outside: Bool[Array, "*batch"]
    reward: Float[Array, "*batch"]
    over: Bool[Array, "*batch"]


def judge(
    before: Bool[Array, "6"],
    start: Float[Array, "6 2"],
    cubes: Float[Array, "6 2"],
    gripper: Float[Array, "2"],
    failed: Bool[Array, ""],
) -> Verdict:
    """Apply all rules to the state after a step.

    Args:
        before: cubes hit before the step.
        start: the cubes' keypoints at the start of the episode, in normalised pixels.
        cubes: the cubes' keypoints after the step.
        gripper: its x and z after the step, in m.
        failed: whether the simulation has become unstable.
    """
    hit, out = hits(before, start, cubes), outside(gripper)
    return Verdict(hit, out, reward=jnp.where(failed, 0.0, reward(hit, out)), over=hit[TOP] | out | failed)
