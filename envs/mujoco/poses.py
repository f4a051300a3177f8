"""Positions of a model's joints over time: as they were recorded, where the recording measures all of them."""

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from jaxlfi.envs.mujoco.measured import places

_SIZES = {mujoco.mjtJoint.mjJNT_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}
"""Numbers of the positions of joints that have more than one."""
_OF_JOINTS = (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_BALLQUAT)
_OF_BODIES = {mujoco.mjtSensor.mjSENS_FRAMEPOS: 0, mujoco.mjtSensor.mjSENS_FRAMEQUAT: 3}
"""Where a free joint has what sensors of its body's frame measure."""


def measured_positions(model: mujoco.MjModel, signals: Sequence[str]) -> dict[int, int]:
    """Which places of `qpos` are measured, and by which signal.

    Those of hinges, slides and balls by sensors of the joint, those of a free joint by sensors of its body's frame.

    Args:
        model: with a sensor for each signal.
        signals: that are measured.
    """
    sensors = np.searchsorted(model.sensor_adr, places(model, signals), side="right") - 1
    found = {}
    for number, (sensor, place) in enumerate(zip(sensors, places(model, signals), strict=True)):
        first, own = _first_position(model, int(sensor)), place - model.sensor_adr[sensor]
        if first is not None:
            found[first + int(own)] = number
    return found


def unmeasured_joints(model: mujoco.MjModel, signals: Sequence[str]) -> list[str]:
    """Names of the joints whose position, or a part of it, is not measured."""
    known = measured_positions(model, signals)
    own = lambda joint: range(joint.qposadr[0], joint.qposadr[0] + _SIZES.get(mujoco.mjtJoint(joint.type[0]), 1))
    joints = [model.joint(i) for i in range(model.njnt)]
    return [joint.name or f"joint[{joint.id}]" for joint in joints if any(place not in known for place in own(joint))]


def recorded_positions(
    model: mujoco.MjModel,
    signals: Sequence[str],
    times: Float[np.ndarray, " rows"],
    rows: Float[np.ndarray, "rows signals"],
    when: Float[np.ndarray, " frames"],
) -> Float[np.ndarray, "frames qpos"] | None:
    """Positions of all joints, linear between samples; None where a joint is not measured.

    Args:
        model: with a sensor for each signal.
        signals: that are measured.
        times: of the rows, in s.
        rows: what was recorded, NaN where there is no sample.
        when: times of the positions, in s.
    """
    if unmeasured_joints(model, signals):
        return None
    positions = np.empty((len(when), model.nq))
    for place, signal in measured_positions(model, signals).items():
        there = np.isfinite(rows[:, signal])
        positions[:, place] = np.interp(when, times[there], rows[there, signal])
    for qpos in positions:
        mujoco.mj_normalizeQuat(model, qpos)
    return positions


def _first_position(model: mujoco.MjModel, sensor: int) -> int | None:
    """Where `qpos` has what a sensor measures; None where it has not."""
    kind, thing = mujoco.mjtSensor(model.sensor_type[sensor]), int(model.sensor_objid[sensor])
    if kind in _OF_JOINTS:
        return int(model.jnt_qposadr[thing])
    if kind in _OF_BODIES and model.sensor_objtype[sensor] == mujoco.mjtObj.mjOBJ_XBODY:
        joint = int(model.body_jntadr[thing])
        free = joint >= 0 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
        if free and model.sensor_refid[sensor] < 0:
            return int(model.jnt_qposadr[joint]) + _OF_BODIES[kind]
    return None
