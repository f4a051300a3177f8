"""The scene after an episode: the gripper retracts, the cubes come to rest, and the displaced ones are counted.

An episode ends as soon as the top cube has moved, when those below may be about to fall. This module judges the scene
that the robot leaves behind, in addition to the paper's return.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from jaxlfi.envs.whip import rules
from jaxlfi.envs.whip.frames import COLOURS
from jaxlfi.envs.whip.rig import START

RETRACTING = 5
"""Number of control intervals in which the set-point returns to its start: 0.8 s, within the action limit."""
WAITING = 6
"""Number of control intervals for which it then waits: 0.96 s."""
FALLEN = 0.5
"""Distance of a cube from its place beyond which it counts as displaced, in sides."""


class Aftermath(struct.PyTreeNode):
    """The scene that an episode leaves behind.

    Attributes:
        displaced: whether each cube is out of its place, bottom-up, shape [6].
        failed: whether the simulation became unstable, in the episode or after it.
    """

    displaced: Bool[Array | np.ndarray, "*batch 6"]
    failed: Bool[Array | np.ndarray, "*batch"]

    @property
    def hit(self) -> Bool[Array | np.ndarray, "*batch"]:
        """Whether the top cube is displaced."""
        return self.displaced[..., rules.TOP] & ~self.failed

    @property
    def clean(self) -> Bool[Array | np.ndarray, "*batch"]:
        """Whether the top cube is displaced and no other."""
        return self.hit & ~self.displaced[..., : rules.TOP].any(axis=-1)


def retreat(target: Any, xp: Any = jnp) -> Any:
    """Displacements of the set-point, in m, [T, 2]: straight back to the start of episodes, then none."""
    back = (xp.asarray(START) - target) / RETRACTING
    return xp.concatenate([xp.tile(back, (RETRACTING, 1)), xp.zeros((WAITING, 2))])


def displaced(
    before: Float[Array | np.ndarray, "*batch 6 3"],
    after: Float[Array | np.ndarray, "*batch 6 3"],
    side: Float[Array | np.ndarray, "*batch"] | float,
) -> Bool[Array | np.ndarray, "*batch 6"]:
    """Which cubes are more than half a side from their places.

    Args:
        before: the cubes' centres at the start of the episode, in m.
        after: their centres at its end, at rest, in m.
        side: side length of the cubes, in m.
    """
    return ((after - before) ** 2).sum(axis=-1) ** 0.5 > FALLEN * side


def sentence(found: Aftermath) -> str:
    """What one episode left behind, in words.

    Example:
        >>> sentence(Aftermath(np.array([False, False, False, True, False, True]), np.array(False)))
        'once settled: orange and yellow out of place'
    """
    if found.failed:
        return "once settled: unstable"
    names = [name for name, own in zip(COLOURS, np.asarray(found.displaced), strict=True) if own]
    if not names:
        return "once settled: every cube in its place"
    listed = " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
    return f"once settled: {listed} out of place" + (", and no other" if names == [COLOURS[rules.TOP]] else "")
