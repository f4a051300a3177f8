"""How consistently keypoints follow the material points of the DLO."""

import dataclasses

import numpy as np
from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Following:
    """Where keypoints are along the DLO, as fractions of its length from the grip.

    Attributes:
        arcs: the nearest point of the DLO to each keypoint in each frame of each rollout, shape [N, T, K].
        away: the distance from it, in widths of the image, shape [N, T, K].
    """

    arcs: Float[np.ndarray, "n time k"]
    away: Float[np.ndarray, "n time k"]

    @property
    def mean(self) -> Float[np.ndarray, " k"]:
        """Mean place of each keypoint."""
        return self.arcs.mean(axis=(0, 1))

    @property
    def within(self) -> Float[np.ndarray, " k"]:
        """Drift within a rollout: the mean over rollouts of the standard deviation over time."""
        return self.arcs.std(axis=1).mean(axis=0)

    @property
    def between(self) -> Float[np.ndarray, " k"]:
        """Drift between rollouts: the standard deviation of the rollouts' means."""
        return self.arcs.mean(axis=1).std(axis=0)

    @property
    def switched(self) -> float:
        """Share of frames in which the keypoints are not in their usual order along the DLO."""
        usual = np.argsort(self.mean)
        return float(np.mean((np.diff(self.arcs[..., usual], axis=-1) <= 0).any(axis=-1)))

    @property
    def covered(self) -> float:
        """Mean fraction of the DLO's length that lies between the first and the last keypoint."""
        return float(np.mean(self.arcs.max(axis=-1) - self.arcs.min(axis=-1)))


def follow(places: Float[np.ndarray, "n time k 2"], lines: Float[np.ndarray, "n time points 2"]) -> Following:
    """Where keypoints are along the projected DLO.

    Args:
        places: of the keypoints, in normalised pixels.
        lines: points of the DLO from the grip to the tip, equally far apart on the DLO, in normalised pixels.
    """
    start, step = lines[:, :, None, :-1], np.diff(lines, axis=2)[:, :, None]
    to = places[:, :, :, None] - start
    part = np.clip(np.sum(to * step, axis=-1) / np.maximum(np.sum(step**2, axis=-1), 1e-12), 0.0, 1.0)
    away = np.linalg.norm(to - part[..., None] * step, axis=-1)
    nearest = np.argmin(away, axis=-1)[..., None]
    along = (nearest + np.take_along_axis(part, nearest, axis=-1))[..., 0] / (lines.shape[2] - 1)
    return Following(along, np.take_along_axis(away, nearest, axis=-1)[..., 0])
