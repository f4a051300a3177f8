"""The rules of the whipping task: actions, workspace, hits and rewards (sections VI-E to VI-G)."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

STEPS = 16
"""Control steps in an episode."""
ACTION_LIMIT = 0.06
"""The furthest that an action moves the set-point along x or z, in m."""
WORKSPACE = np.array([[0.275, 0.1], [0.6, 0.5]], np.float32)
"""Lower and upper limits of the gripper's x and z, in m."""
HIT_DISTANCE = 0.06
"""How far a cube's keypoint must have moved from its start to count as hit, in normalised pixels."""
TOP = 5
"""Index of the target, the yellow cube."""
PENALTIES = np.array([0.05 * 2 ** (4 - i) for i in range(TOP)], np.float32)
"""For hitting a cube below the target, from the red one at the bottom up."""


def moved_target(target: Float[Array, "*batch 2"], action: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
    """The set-point after an action (dx, dz) in m; what is beyond the limit of an action is clipped."""
    return target + jnp.clip(action, -ACTION_LIMIT, ACTION_LIMIT)


def outside(gripper: Float[Array, "*batch 2"]) -> Bool[Array, "*batch"]:
    """Whether the gripper has left its workspace, which ends the episode as a failure."""
    return jnp.any((gripper < WORKSPACE[0]) | (gripper > WORKSPACE[1]), axis=-1)


def hits(
    before: Bool[Array, "*batch 6"], start: Float[Array, "*batch 6 2"], cubes: Float[Array, "*batch 6 2"]
) -> Bool[Array, "*batch 6"]:
    """Which cubes have been hit so far: a cube that falls back to its place stays hit.

    Args:
        before: cubes hit before.
        start: the cubes' keypoints at the start of the episode, in normalised pixels.
        cubes: and now.
    """
    return before | (jnp.linalg.norm(cubes - start, axis=-1) > HIT_DISTANCE)


def reward(hit: Bool[Array, "*batch 6"], out: Bool[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The reward of one step (section VI-G).

    2 where the top cube has been hit, less a penalty for each of the others that has been, whichever came first and
    again at every step; -1 for leaving the workspace.

    Args:
        hit: cubes hit so far in the episode, bottom-up.
        out: whether the gripper is outside of its workspace.
    """
    return jnp.where(out, -1.0, 2.0 * hit[..., TOP] - hit[..., :TOP] @ jnp.asarray(PENALTIES))
