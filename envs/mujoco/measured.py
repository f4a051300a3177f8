"""Measured signals of a model: its sensors, and positions of joints and bodies that have none."""

import re
from collections.abc import Sequence

import mujoco

from jaxlfi.envs.mujoco.columns import INDEXED, sensor_names
from jaxlfi.envs.mujoco.parameters import near

JOINT = re.compile(r"joint/(?P<joint>.+)/(?P<what>qpos|qvel|effort)")
BODY = re.compile(r"body/(?P<body>.+)/(?P<what>pos|quat)\[(?P<index>\d)\]")
_OF_JOINTS = {
    "qpos": mujoco.mjtSensor.mjSENS_JOINTPOS,
    "qvel": mujoco.mjtSensor.mjSENS_JOINTVEL,
    "effort": mujoco.mjtSensor.mjSENS_JOINTACTFRC,
}
"""Sensors by quantity; "effort", as in ROS, is the total force or torque of a joint's actuators."""
_OF_BODIES = {"pos": mujoco.mjtSensor.mjSENS_FRAMEPOS, "quat": mujoco.mjtSensor.mjSENS_FRAMEQUAT}

_UNITS = {
    "s": ("CLOCK",),
    "m": ("FRAMEPOS", "GEOMDIST", "GEOMFROMTO", "RANGEFINDER", "SUBTREECOM"),
    "m/s": ("FRAMELINVEL", "VELOCIMETER", "SUBTREELINVEL"),
    "rad/s": ("FRAMEANGVEL", "GYRO", "BALLANGVEL"),
    "m/s^2": ("ACCELEROMETER", "FRAMELINACC"),
    "rad/s^2": ("FRAMEANGACC",),
    "N": ("FORCE", "TOUCH"),
    "N m": ("TORQUE",),
    "1": ("FRAMEQUAT", "BALLQUAT", "FRAMEXAXIS", "FRAMEYAXIS", "FRAMEZAXIS", "GEOMNORMAL"),
}
_PER_JOINT = {
    mujoco.mjtSensor.mjSENS_JOINTPOS: ("rad", "m"),
    mujoco.mjtSensor.mjSENS_JOINTLIMITPOS: ("rad", "m"),
    mujoco.mjtSensor.mjSENS_JOINTVEL: ("rad/s", "m/s"),
    mujoco.mjtSensor.mjSENS_JOINTLIMITVEL: ("rad/s", "m/s"),
    mujoco.mjtSensor.mjSENS_JOINTACTFRC: ("N m", "N"),
    mujoco.mjtSensor.mjSENS_JOINTLIMITFRC: ("N m", "N"),
}
"""Units of sensors of hinges and of slides."""
_PER_ACTUATOR = {mujoco.mjtSensor.mjSENS_ACTUATORPOS: "", mujoco.mjtSensor.mjSENS_ACTUATORVEL: "/s"}
"""Units of actuators' sensors, to be appended to that of the actuator's length."""
_UNIT = {getattr(mujoco.mjtSensor, f"mjSENS_{kind}"): unit for unit, kinds in _UNITS.items() for kind in kinds}


def add_sensors(spec: mujoco.MjSpec, names: Sequence[str]) -> None:
    """Add sensors to a specification for signals such as "joint/hinge/qpos" and "body/puck/pos[0]".

    Raises:
        ValueError: for joints and bodies that the model does not have.
    """
    for name in names:
        if match := JOINT.fullmatch(name):
            _check(spec.joint(match["joint"]), match["joint"], [one.name for one in spec.joints], name)
            _add(spec, name, _OF_JOINTS[match["what"]], mujoco.mjtObj.mjOBJ_JOINT, match["joint"])
        elif match := BODY.fullmatch(name):
            _check(spec.body(match["body"]), match["body"], [one.name for one in spec.bodies], name)
            sensor = name.rpartition("[")[0]
            _add(spec, sensor, _OF_BODIES[match["what"]], mujoco.mjtObj.mjOBJ_XBODY, match["body"])


def signals_of(model: mujoco.MjModel) -> list[str]:
    """All numbers of a model's sensors by name, as `places` knows them, in the order of the sensor data."""
    found = []
    for name, size in zip(_sensors(model), model.sensor_dim, strict=True):
        found += [name] if size == 1 else [f"{name}[{k}]" for k in range(size)]
    return found


def places(model: mujoco.MjModel, names: Sequence[str]) -> list[int]:
    """Where each signal is among a model's sensor data: "angle", or "accelerometer[2]" of a sensor of several numbers.

    Raises:
        ValueError: for a sensor that is not in the model, and an index that it does not have.
    """
    sensors, found = _sensors(model), []
    for name in names:
        match = INDEXED.fullmatch(name)
        sensor, index = (name, 0) if match is None or name in sensors else (match["sensor"], int(match["index"]))
        if sensor not in sensors:
            raise ValueError(f"measured: expected a sensor {near(sensor, sensors)}, got {name!r}")
        own = model.sensor(sensors.index(sensor))
        size = own.dim[0]
        if index >= size or (size > 1 and sensor == name):
            raise ValueError(f"measured: expected {sensor}[0] to {sensor}[{size - 1}], got {name!r}")
        found.append(int(own.adr[0]) + index)
    return found


def unit(model: mujoco.MjModel, name: str) -> str:
    """The unit that a signal is measured in; "1" of orientations, and "" where its sensor does not say."""
    kind, item = of_sensor(model, name)
    if kind in _PER_JOINT:
        of_hinge, of_slide = _PER_JOINT[kind]
        return of_hinge if model.jnt_type[item] == mujoco.mjtJoint.mjJNT_HINGE else of_slide
    if kind in _PER_ACTUATOR:
        return length + _PER_ACTUATOR[kind] if (length := _length(model, item)) else ""
    return _UNIT.get(kind, "")


def of_sensor(model: mujoco.MjModel, name: str) -> tuple[mujoco.mjtSensor, int]:
    """The type of a signal's sensor, and the number of its joint, site or other element."""
    sensor = _sensor(model, name)
    return mujoco.mjtSensor(int(sensor.type[0])), int(sensor.objid[0])


def joint_limits(model: mujoco.MjModel, name: str) -> tuple[float, float] | None:
    """The limits of the joint whose position a signal is; None where there are none."""
    kind, joint = of_sensor(model, name)
    if kind != _OF_JOINTS["qpos"] or not model.jnt_limited[joint]:
        return None
    return tuple(model.jnt_range[joint].tolist())


def kinematic(model: mujoco.MjModel, name: str) -> bool:
    """Whether a signal depends on positions and velocities only, and not on forces."""
    stage = mujoco.mjtStage(_sensor(model, name).needstage[0])
    return stage in (mujoco.mjtStage.mjSTAGE_POS, mujoco.mjtStage.mjSTAGE_VEL)


def control_units(model: mujoco.MjModel, actuator: int) -> tuple[str, ...]:
    """The units that an actuator's control may have; none if the model does not say.

    A servo's control has the unit of what it controls. A motor may be driven by a force, a voltage or a current.
    """
    gain, bias = model.actuator_gainprm[actuator], model.actuator_biasprm[actuator]
    kinds = model.actuator_gaintype[actuator], model.actuator_biastype[actuator], model.actuator_dyntype[actuator]
    of_gain, of_bias, dynamics = mujoco.mjtGain(kinds[0]), mujoco.mjtBias(kinds[1]), mujoco.mjtDyn(kinds[2])
    if of_gain != mujoco.mjtGain.mjGAIN_FIXED:
        return ()
    if of_bias == mujoco.mjtBias.mjBIAS_NONE:
        return ("N m", "N", "V", "A", "1", "count") if dynamics == mujoco.mjtDyn.mjDYN_NONE else ()
    length = _length(model, actuator)
    if of_bias != mujoco.mjtBias.mjBIAS_AFFINE or not length or not gain[0]:
        return ()
    if bias[1] == -gain[0]:
        return (f"{length}/s",) if dynamics == mujoco.mjtDyn.mjDYN_INTEGRATOR else (length,)
    return (f"{length}/s",) if not bias[1] and bias[2] == -gain[0] else ()


def _length(model: mujoco.MjModel, actuator: int) -> str:
    """The unit of an actuator's length, "rad" or "m"; "" where it acts on no joint."""
    of_joints = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    if mujoco.mjtTrn(model.actuator_trntype[actuator]) not in of_joints:
        return ""
    kind = mujoco.mjtJoint(model.jnt_type[model.actuator_trnid[actuator, 0]])
    return {mujoco.mjtJoint.mjJNT_HINGE: "rad", mujoco.mjtJoint.mjJNT_SLIDE: "m"}.get(kind, "")


def _sensor(model: mujoco.MjModel, name: str):
    match, sensors = INDEXED.fullmatch(name), _sensors(model)
    return model.sensor(sensors.index(name if match is None or name in sensors else match["sensor"]))


def _sensors(model: mujoco.MjModel) -> list[str]:
    return sensor_names([model.sensor(i).name for i in range(model.nsensor)])


def _add(spec: mujoco.MjSpec, name: str, kind, object_kind, own: str) -> None:
    if spec.sensor(name) is None:
        spec.add_sensor(name=name, type=kind, objtype=object_kind, objname=own)


def _check(found, own: str, known: Sequence[str], name: str) -> None:
    if found is None:
        raise ValueError(f"measured: {name!r}: expected one {near(own, [one for one in known if one])}, got {own!r}")
