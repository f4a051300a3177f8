"""Positions of a model's joints as they were recorded, where the recording measures them."""

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from jaxlfi.envs.mujoco.effects import sizes
from jaxlfi.envs.mujoco.measured import places
from jaxlfi.envs.mujoco.orientations import continuous

_OF_JOINTS = (mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtSensor.mjSENS_BALLQUAT)
_OF_BODIES = {mujoco.mjtSensor.mjSENS_FRAMEPOS: 0, mujoco.mjtSensor.mjSENS_FRAMEQUAT: 3}
"""Where a free joint's positions have what sensors of its body's frame measure."""


def measured_positions(model: mujoco.MjModel, signals: Sequence[str]) -> dict[int, int]:
    """The places of `qpos` that are measured, and the signals that measure them.

    Hinges, slides and balls are measured by sensors of the joint, a free joint by sensors of its body's frame.

    Args:
        model: with a sensor for each signal.
        signals: that are measured.
    """
    found = {}
    for number, place in enumerate(places(model, signals)):
        sensor = int(np.searchsorted(model.sensor_adr, place, side="right")) - 1
        first = _first_position(model, sensor)
        if first is not None:
            found[first + place - int(model.sensor_adr[sensor])] = number
    return found


def unmeasured_joints(model: mujoco.MjModel, signals: Sequence[str]) -> list[str]:
    """Names of the joints whose position, or a part of it, is not measured."""
    known = measured_positions(model, signals)
    joints = [model.joint(i) for i in range(model.njnt)]
    return [joint.name or f"joint[{joint.id}]" for joint in joints if not known.keys() >= set(_positions(joint))]


def recorded_positions(
    model: mujoco.MjModel,
    signals: Sequence[str],
    times: Float[np.ndarray, " rows"],
    rows: Float[np.ndarray, "rows signals"],
    when: Float[np.ndarray, " frames"],
) -> Float[np.ndarray, "frames qpos"]:
    """Positions of all joints, linear between samples.

    Args:
        model: whose joints are all measured, with a sensor for each signal.
        signals: that are measured.
        times: of the rows, in s.
        rows: what was recorded, NaN where there is no sample; at least one of each signal.
        when: times of the positions, in s.
    """
    numbers = measured_positions(model, signals)
    samples = np.empty((len(times), model.nq))
    for place, number in numbers.items():
        there = np.isfinite(rows[:, number])
        samples[:, place] = np.interp(times, times[there], rows[there, number])
    for i in range(model.njnt):
        if len(own := _positions(model.joint(i))) > 1:
            # A quaternion and its negative are the same rotation, and what lies between the two is none.
            turns = continuous(rows[:, [numbers[place] for place in own[-4:]]])
            there = np.isfinite(turns).all(axis=1)
            for place, values in zip(own[-4:], turns[there].T, strict=True):
                samples[:, place] = np.interp(times, times[there], values)
    positions = np.stack([np.interp(when, times, column) for column in samples.T], axis=1)
    for qpos in positions:
        mujoco.mj_normalizeQuat(model, qpos)
    return positions


def _positions(joint) -> range:
    """Places of a joint in `qpos`."""
    first = int(joint.qposadr[0])
    return range(first, first + sizes(joint)[0])


def _first_position(model: mujoco.MjModel, sensor: int) -> int | None:
    """The place in `qpos` of what a sensor measures; None if there is none."""
    kind, thing = mujoco.mjtSensor(model.sensor_type[sensor]), int(model.sensor_objid[sensor])
    if kind in _OF_JOINTS:
        return int(model.jnt_qposadr[thing])
    if kind in _OF_BODIES and model.sensor_objtype[sensor] == mujoco.mjtObj.mjOBJ_XBODY:
        joint = int(model.body_jntadr[thing])
        free = joint >= 0 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
        if free and model.sensor_refid[sensor] < 0:
            return int(model.jnt_qposadr[joint]) + _OF_BODIES[kind]
    return None
