"""What an episode of the whipping task is rewarded for: the paper's reward, and two that are stricter.

All of them take leaving the workspace for a failure that is worth -1, and an unstable simulation for nothing.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlfi.envs.whip.aftermath import Aftermath
from jaxlfi.envs.whip.rules import PENALTIES, TOP

REWARDS = ("paper", "ordered", "settled")
"""Names; the first is the default, `rules.reward`."""
FALLEN_COST = 0.25
"""What each displaced cube below the target costs once the scene has settled.

All five cost less than the target is worth: toppling the stack is still better than leaving it alone, and so is what a
learner finds first.
"""


def ordered(
    hit: Bool[Array | np.ndarray, "*batch 6"], out: Bool[Array | np.ndarray, "*batch"]
) -> Float[Array, "*batch"]:
    """The paper's reward, but that a cube costs its penalty only where all above it have been hit as well.

    So the penalties follow the order from the top down, as the discussion in section VI-G suggests: a cube cannot have
    been struck out from under others that stand, so that a flag which says so is a missed detection.

    Args:
        hit: cubes hit so far in the episode, bottom-up.
        out: whether the gripper is outside of its workspace.
    """
    from_top = jnp.cumprod(jnp.asarray(hit)[..., ::-1], axis=-1)[..., ::-1]
    return jnp.where(out, -1.0, 2.0 * from_top[..., TOP] - from_top[..., :TOP] @ jnp.asarray(PENALTIES))


def settled(left: Aftermath, out: Bool[Array | np.ndarray, "*batch"]) -> Float[Array, "*batch"]:
    """2 for the top cube once the scene has settled, less `FALLEN_COST` for each other cube out of its place.

    It is given once, in the step that ends the episode.

    Args:
        left: what the episode leaves behind.
        out: whether it ended because the gripper left its workspace.
    """
    fallen = jnp.sum(jnp.asarray(left.displaced)[..., :TOP], axis=-1)
    earned = 2.0 * jnp.asarray(left.displaced)[..., TOP] - FALLEN_COST * fallen
    return jnp.where(left.failed, 0.0, jnp.where(out, -1.0, earned))


def check(name: str) -> str:
    """Refuse the name of no reward.

    Raises:
        ValueError: listing those that are.
    """
    if name not in REWARDS:
        raise ValueError(f"reward: expected one of {', '.join(REWARDS)}, got {name!r}")
    return name
