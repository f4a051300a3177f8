"""Observations of the whipping task (section VI-E) from simulations, recordings, and a robot's measurements.

Like `jaxlfi.robots`, this module needs only NumPy; its functions also work on JAX arrays.
"""

import numpy as np

from jaxlfi.envs.whip.rig import HIT_DISTANCE, KEYPOINTS, ON_DLO

FLAGS = 2 + 2 * KEYPOINTS
"""Index of the first flag in an observation; before it come the gripper's x and z, and the keypoints."""
OBSERVATION = FLAGS + 6
"""Length of an observation."""


def observation(gripper, keypoints, hit):
    """Proprioception, keypoints and flags.

    Args:
        gripper: its x and z, in m, shape [..., 2].
        keypoints: four on the DLO and six cubes bottom-up, in normalised pixels, shape [..., 10, 2].
        hit: cubes hit so far, shape [..., 6].

    Returns:
        Single precision, shape [..., 28].
    """
    xp = keypoints.__array_namespace__()
    flat = keypoints.reshape(*keypoints.shape[:-2], 2 * KEYPOINTS)
    return xp.concatenate([gripper, flat, hit.astype(xp.float32)], axis=-1)


def moved(start, cubes):
    """Which cubes count as hit: those whose keypoints, shape [..., 6, 2], are far enough from their start."""
    return cubes.__array_namespace__().linalg.norm(cubes - start, axis=-1) > HIT_DISTANCE


def hits_so_far(keypoints):
    """Cubes hit in a whole trajectory of keypoints, shape [T, 10, 2], up to each time, shape [T, 6]."""
    cubes = keypoints[:, ON_DLO:]
    return moved(cubes[0], cubes).cumsum(axis=0) > 0


class Observer:
    """Memory of an episode: where each keypoint was seen last, and which cubes have been hit.

    Attributes:
        keypoints: last seen position of each keypoint, in normalised pixels, shape [10, 2].
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
        # Keypoints that were never seen are assumed to be in the middle of the image.
        self.keypoints = np.full((KEYPOINTS, 2), 0.5, np.float32)
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
        cubes = self.keypoints[ON_DLO:]
        first = seen[ON_DLO:] & np.isnan(self._start[:, 0])
        self._start[first] = cubes[first]
        self.hit = self.hit | moved(self._start, cubes)
        return observation(np.asarray(gripper, np.float32), self.keypoints, self.hit)
