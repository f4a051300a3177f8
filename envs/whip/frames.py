"""Frames: the visible geometry of the whipping scene, for all simulators."""

from flax import struct
from jaxtyping import Array, Float


class Frames(struct.PyTreeNode):
    """One or more frames of a scene, in m, in the world frame: x away from the robot, z up, the camera at negative y.

    Attributes:
        gripper: x and z of the end effector, shape [..., 2].
        dlo: points of the DLO's centreline from the grip to the tip, not necessarily equally spaced, shape [..., P, 3].
        cubes: the cubes' centres, bottom-up, shape [..., 6, 3].
        orientations: orientations of the cubes, as unit quaternions (w, x, y, z), shape [..., 6, 4].
    """

    gripper: Float[Array, "*time 2"]
    dlo: Float[Array, "*time points 3"]
    cubes: Float[Array, "*time 6 3"]
    orientations: Float[Array, "*time 6 4"]


COLOURS = ("red", "green", "blue", "orange", "purple", "yellow")
"""Colours of the cubes, bottom-up; the yellow one at the top is the target."""
