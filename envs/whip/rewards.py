"""Rewards of the whipping task: the paper's reward, and two that are stricter.

In all of them, leaving the workspace is a failure with reward -1, and an unstable simulation has reward 0.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlfi.envs.whip.aftermath import Aftermath
from jaxlfi.envs.whip.rules import PENALTIES, TOP

REWARDS = ("paper", "ordered", "settled")
"""Names of the rewards; the first is the default, `rules.reward`."""
FALLEN_COST = 0.25
"""Cost of each displaced cube below the target once the scene has settled.

All five cost less than the target is worth: toppling the stack is still better than leaving it alone, and so is what a
learner finds first.
"""


def ordered(
    hit: Bool[Array | np.ndarray, "*batch 6"], out: Bool[Array | np.ndarray, "*batch"]
) -> Float[Array, "*batch"]:
    """The paper's reward, except that a cube costs its penalty only if all above it have been hit as well.

    The penalties thus follow the order from the top down, as the discussion in section VI-G suggests. A cube cannot be
    struck out from under others that still stand, so a flag that says so is a detection error.

    Args:
        hit: cubes hit so far in the episode, bottom-up.
        out: whether the gripper is outside of its workspace.
    """
    from_top = jnp.cumprod(jnp.asarray(hit)[..., ::-1], axis=-1)[..., ::-1]
    return jnp.where(out, -1.0, 2.0 * from_top[..., TOP] - from_top[..., :TOP] @ jnp.asarray(PENALTIES))


def settled(left: Aftermath, out: Bool[Array | np.ndarray, "*batch"]) -> Float[Array, "*batch"]:
    """2 if the top cube is displaced once the scene has settled, minus `FALLEN_COST` for each other displaced cube.

    This reward is given once, in the step that ends the episode.

    Args:
        left: what the episode leaves behind.
        out: whether it ended because the gripper left its workspace.
    """
    fallen = jnp.sum(jnp.asarray(left.displaced)[..., :TOP], axis=-1)
    earned = 2.0 * jnp.asarray(left.displaced)[..., TOP] - FALLEN_COST * fallen
    return jnp.where(left.failed, 0.0, jnp.where(out, -1.0, earned))


def check(name: str) -> str:
    """Refuse an unknown reward.

    Raises:
        ValueError: listing the known ones.
    """
    if name not in REWARDS:
        raise ValueError(f"reward: expected one of {', '.join(REWARDS)}, got {name!r}")
    return name
