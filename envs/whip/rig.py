"""The whipping rig: the sizes, positions and times that all scenes and simulators have in common."""

SECTION = 0.015
"""Width and height of the DLO's square section, a, in m (section VI-C)."""
GRAVITY = 9.81
"""Gravitational acceleration, in m/s^2."""
START = (0.40, 0.36)
"""Initial x and z of the gripper, in m: the longest DLO just clears the table."""
STACK = 0.60
"""Nominal x of the stack of cubes, in m."""
HAND = (0.02, 0.015, 0.03)
"""Half the gripper's width, depth and height, in m; the DLO is held at the middle of its lower side."""
CONTROL_INTERVAL = 0.16
"""Time between two actions, in s."""
ON_DLO = 4
"""Number of keypoints of the DLO, which precede those of the cubes (section VI-C)."""
KEYPOINTS = ON_DLO + 6
"""Number of all keypoints."""
HIT_DISTANCE = 0.06
"""Displacement of a cube's keypoint from its start above which the cube counts as hit, in normalised pixels."""
RGBA = {
    "red": (0.85, 0.15, 0.15, 1),
    "green": (0.15, 0.65, 0.2, 1),
    "blue": (0.1, 0.2, 0.6, 1),
    "orange": (0.95, 0.55, 0.1, 1),
    "purple": (0.5, 0.2, 0.6, 1),
    "yellow": (0.95, 0.85, 0.1, 1),
    "dlo": (0.2, 0.5, 0.95, 1),
    "gripper": (0.4, 0.4, 0.4, 1),
    "table": (0.85, 0.8, 0.75, 1),
}
"""Colours of the objects in a scene, each channel from 0 to 1."""
