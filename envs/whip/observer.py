"""Observations of the whipping task (section VI-E) from what a camera finds and the gripper measures, as on a robot.

Like `jaxlfi.robots`, this module needs NumPy only.
"""

import numpy as np

from jaxlfi.envs.whip.rig import HIT_DISTANCE

CUBES = 4
"""Place of the first cube's keypoint, after those of the DLO."""


class Observer:
    """Memory of an episode: where each keypoint was seen last, and which cubes have been hit.

    Attributes:
        keypoints: where each was seen last, in normalised pixels, shape [10, 2].
        hit: cubes that have been further than 0.06 from where they were first seen, bottom-up, shape [6].

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
        self._start = np.full((6, 2), np.nan)  # NaN is never far away

    def observe(self, gripper: np.ndarray, keypoints: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """The observation of a frame, shape [28].

        Args:
            gripper: its measured x and z, in m, shape [2].
            keypoints: four on the DLO and six cubes bottom-up, in normalised pixels; those not seen may be NaN. Shape
                [10, 2].
            seen: which of them were found, shape [10].
        """
        seen = np.asarray(seen, bool)
        self.keypoints = np.where(seen[:, None], np.asarray(keypoints, np.float32), self.keypoints)
        cubes = self.keypoints[CUBES:]
        first = seen[CUBES:] & np.isnan(self._start[:, 0])
        self._start[first] = cubes[first]
        self.hit = self.hit | (np.linalg.norm(cubes - self._start, axis=-1) > HIT_DISTANCE)
        return np.concatenate([np.asarray(gripper, np.float32), self.keypoints.ravel(), self.hit], dtype=np.float32)
