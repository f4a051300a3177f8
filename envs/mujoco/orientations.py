"""Orientations as quaternions, which are compared as rotations, whatever their sign and norm."""

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
from jaxtyping import Array, Float

SENSORS = (mujoco.mjtSensor.mjSENS_FRAMEQUAT, mujoco.mjtSensor.mjSENS_BALLQUAT)
Columns = tuple[int, ...]
"""Where w, x, y and z of an orientation are among the signals."""


def groups(model: mujoco.MjModel, places: Sequence[int]) -> dict[str, Columns]:
    """The orientations of which all numbers are measured, by their sensors.

    Args:
        model: with a sensor for each signal.
        places: of the signals among the model's sensor data.
    """
    whole = {sensor: first for sensor, first, count in _measured(model, places) if count == 4}
    return {sensor: tuple(list(places).index(first + k) for k in range(4)) for sensor, first in whole.items()}


def parts(model: mujoco.MjModel, places: Sequence[int]) -> dict[str, int]:
    """The number of measured components of partly measured orientations, by their sensors."""
    return {sensor: count for sensor, _, count in _measured(model, places) if 0 < count < 4}


def _measured(model: mujoco.MjModel, places: Sequence[int]) -> Iterator[tuple[str, int, int]]:
    """Each orientation's sensor, where it begins in the sensor data, and how many of its numbers are measured."""
    for sensor in range(model.nsensor):
        if mujoco.mjtSensor(model.sensor_type[sensor]) in SENSORS:
            first = int(model.sensor_adr[sensor])
            yield model.sensor(sensor).name, first, len(set(places) & set(range(first, first + 4)))


def aligned(
    rows: Float[Array | np.ndarray, "*n time signals"],
    recorded: Float[np.ndarray, "time signals"],
    orientations: Sequence[Columns],
) -> Float[Array | np.ndarray, "*n time signals"]:
    """Signals whose orientations have norm 1 and the sign nearer to the recording.

    Works on JAX's arrays and on NumPy's. An orientation of norm 0 stays what it is.
    """
    for columns in orientations:
        own = rows[..., list(columns)]
        other = (own * recorded[:, list(columns)]).sum(-1, keepdims=True) < 0
        norm = (own**2).sum(-1, keepdims=True) ** 0.5
        factor = (1.0 - 2.0 * other) / (norm + (norm == 0))
        mask = np.isin(np.arange(rows.shape[-1]), columns)
        rows = rows * (~mask + mask * factor)
    return rows


def continuous(
    quaternions: Float[np.ndarray, "time 4"], start: Float[np.ndarray, " 4"] | None = None
) -> Float[np.ndarray, "time 4"]:
    """Quaternions of norm 1 without changes of sign; those of norm 0, or with missing numbers, are missing.

    Args:
        quaternions: of any norm.
        start: quaternion whose sign the first one gets; None for its own.
    """
    norms = np.linalg.norm(quaternions, axis=1, keepdims=True)
    found = np.where(norms > 0, quaternions / np.where(norms > 0, norms, 1.0), np.nan)
    there = np.flatnonzero(np.isfinite(found).all(axis=1))
    found[np.setdiff1d(np.arange(len(found)), there)] = np.nan
    own = found[there]
    before = own[:1] if start is None else np.asarray(start)[None]
    flips = np.sum(own * np.concatenate([before, own[:-1]]), axis=1) < 0
    found[there] = own * np.where(np.cumsum(flips) % 2, -1.0, 1.0)[:, None]
    return found


def angle(one: Float[np.ndarray, " 4"], other: Float[np.ndarray, " 4"]) -> float:
    """The angle of the rotation between two orientations, in rad."""
    cosine = abs(float(np.dot(one, other))) / (float(np.linalg.norm(one)) * float(np.linalg.norm(other)))
    return 2 * float(np.arccos(min(cosine, 1.0)))
