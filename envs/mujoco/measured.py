"""What is measured of a model: its sensors, and positions of joints and bodies that have none."""

import re
from collections.abc import Sequence

import mujoco

from jaxlfi.envs.mujoco.columns import INDEXED, sensor_names
from jaxlfi.envs.mujoco.parameters import near

JOINT = re.compile(r"joint/(?P<joint>.+)/(?P<what>qpos|qvel)")
BODY = re.compile(r"body/(?P<body>.+)/(?P<what>pos|quat)\[(?P<index>\d)\]")
_OF_JOINTS = {"qpos": mujoco.mjtSensor.mjSENS_JOINTPOS, "qvel": mujoco.mjtSensor.mjSENS_JOINTVEL}
_OF_BODIES = {"pos": mujoco.mjtSensor.mjSENS_FRAMEPOS, "quat": mujoco.mjtSensor.mjSENS_FRAMEQUAT}

_UNITS = {
    "m": ("FRAMEPOS", "GEOMDIST", "RANGEFINDER"),
    "m/s": ("FRAMELINVEL", "VELOCIMETER"),
    "rad/s": ("FRAMEANGVEL", "GYRO", "BALLANGVEL"),
    "m/s^2": ("ACCELEROMETER", "FRAMELINACC"),
    "rad/s^2": ("FRAMEANGACC",),
    "N": ("FORCE", "TOUCH"),
    "N m": ("TORQUE",),
}
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
    """The unit that a signal is measured in; "" where its sensor does not say."""
    match, sensors = INDEXED.fullmatch(name), _sensors(model)
    sensor = model.sensor(sensors.index(name if match is None or name in sensors else match["sensor"]))
    kind = mujoco.mjtSensor(int(sensor.type[0]))
    if kind in _OF_JOINTS.values():
        hinge = model.jnt_type[int(sensor.objid[0])] == mujoco.mjtJoint.mjJNT_HINGE
        return ("rad" if hinge else "m") + ("/s" if kind == _OF_JOINTS["qvel"] else "")
    return _UNIT.get(kind, "")


def _sensors(model: mujoco.MjModel) -> list[str]:
    return sensor_names([model.sensor(i).name for i in range(model.nsensor)])


def _add(spec: mujoco.MjSpec, name: str, kind, object_kind, own: str) -> None:
    if spec.sensor(name) is None:
        spec.add_sensor(name=name, type=kind, objtype=object_kind, objname=own)


def _check(found, own: str, known: Sequence[str], name: str) -> None:
    if found is None:
        raise ValueError(f"measured: {name!r}: expected one {near(own, [one for one in known if one])}, got {own!r}")
