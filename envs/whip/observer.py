"""Observations of the whipping task (section VI-E) from what a camera finds and the gripper measures, as on a robot.

Like `jaxlfi.robots`, this module needs NumPy only.
"""

import numpy as np
from jaxtyping import Bool, Float

from jaxlfi.envs.whip.rig import HIT_DISTANCE

CUBES = 4
"""Place of the first cube's keypoint, after those of the DLO."""


class Observer:
    """What is remembered in an episode: where each keypoint was seen last, and which cubes have been hit.

    Attributes:
        keypoints: where each was seen last, in normalised pixels, shape [10, 2].
        hit: cubes that have been further than 0.06 from where they were first, bottom-up, shape [6].

    Example:
        >>> observer = Observer()
        >>> keypoints = np.full((10, 2), 0.3)
        >>> observer.observe([0.4, 0.36], keypoints, np.ones(10, bool)).shape
        (28,)
        >>> keypoints[9] += 0.1
        >>> observer.observe([0.4, 0.36], keypoints, np.ones(10, bool))[22:].tolist()
        [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    """

    def __init__(self):
        """Nothing has been seen."""
        # What was never seen is taken to be in the middle of the image.
        self.keypoints = np.full((10, 2), 0.5, np.float32)
        self.hit = np.zeros(6, bool)
        self._start: np.ndarray | None = None

    def observe(
        self, gripper: Float[np.ndarray, "2"], keypoints: Float[np.ndarray, "10 2"], seen: Bool[np.ndarray, "10"]
    ) -> Float[np.ndarray, "28"]:
        """The observation of a frame.

        Args:
            gripper: its measured x and z, in m.
            keypoints: four on the DLO and six cubes bottom-up, in normalised pixels; those not seen may be NaN.
            seen: which of them were found.
        """
        self.keypoints = np.where(np.asarray(seen)[:, None], np.asarray(keypoints, np.float32), self.keypoints)
        cubes = self.keypoints[CUBES:]
        self._start = cubes if self._start is None else self._start
        self.hit = self.hit | (np.linalg.norm(cubes - self._start, axis=-1) > HIT_DISTANCE)
        return np.concatenate([np.asarray(gripper, np.float32), self.keypoints.ravel(), self.hit], dtype=np.float32)
