"""Read messages of ROS 2, encoded as CDR, as signals.

| type | numbers |
|---|---|
| `sensor_msgs/JointState` | `joint/NAME/qpos`, `joint/NAME/qvel`, `joint/NAME/effort`, by the names of its joints |
| `sensor_msgs/Imu` | `TOPIC/orientation[0]`, `TOPIC/angular_velocity[0]`, `TOPIC/linear_acceleration[0]` |
| `geometry_msgs/PoseStamped` | `TOPIC/pos[0]`, `TOPIC/quat[0]` |
| `std_msgs/Float64MultiArray`, `std_msgs/Float64` | `TOPIC[0]`, `TOPIC` |

Topics are named as words with dots between them: `/imu/data` is `imu.data`. Times are the stamps of headers, or the
recording times of messages without one; so each topic has a clock of its own. Quaternions, which ROS has as x, y, z, w,
are returned as w, x, y, z. If several nodes publish their joints on one topic, those of each node are a signal of their
own.

Needs the extra `robotics` (mcap-ros2-support).
"""

import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxlfi.io import clocks
from jaxlfi.io.rollout import Rollout, Signal

INSTALL = "MCAP files of ROS 2 need the package mcap-ros2-support: pip install 'jaxlfi[robotics]'"
APART = 1.0
"""Offset in s between stamps and recording times from which on they are taken for different clocks."""
Row = Mapping[str, tuple[float, str]]
"""Numbers of a message, and their units, by name."""


class RosWarning(UserWarning):
    """Time stamps of a bag are changed when they are read."""


class _Read(NamedTuple):
    """A message: its numbers, its stamp and its recording time, in ns; a stamp of 0 means none."""

    numbers: Row
    stamp: int
    logged: int


def rollout(messages: Iterable[tuple[Any, Any, Any]]) -> Rollout:
    """Signals of all topics whose types are known.

    Args:
        messages: schema, channel and message of each, as `mcap` reads them.

    Raises:
        ValueError: if no message has numbers, or one cannot be read; in one line.
        ImportError: without mcap-ros2-support.
    """
    messages = list(messages)
    types = _types(messages)
    try:
        from mcap_ros2.decoder import DecoderFactory
    except ImportError as error:
        raise ImportError(INSTALL) from error
    decoders, read = DecoderFactory(), dict[str, list[_Read]]()
    for schema, channel, message in messages:
        if types[channel.topic] in TYPES:
            several = read.setdefault(channel.topic, [])
            several.append(_read(decoders, schema, channel, message, len(several)))
    offset = _offset(one for several in read.values() for one in several)
    begin = min(_time(one, offset) for several in read.values() for one in several)
    signals: dict[str, Signal] = {}
    faults: list[str] = []
    for topic, several in read.items():
        for name, group in _by_names(topic, several).items():
            times = np.array([_time(one, offset) - begin for one in group], np.int64)
            rows, fault = clocks.order(times, "message", repeated=True)
            faults += [f"{topic}: expected stamps in order, got {fault} ns"] if fault else []
            values = np.array([[number for number, _ in one.numbers.values()] for one in group])
            units = tuple(unit for _, unit in group[0].numbers.values())
            signals[name] = Signal(1e-9 * times[rows], values[rows], tuple(group[0].numbers), units)
    if not signals:
        raise ValueError(f"{', '.join(read)}: expected messages with numbers, got none")
    return Rollout(signals, faults=tuple(faults))


def _types(messages: Iterable[tuple[Any, Any, Any]]) -> dict[str, str]:
    """The type of each topic's messages, named as in `TYPES`; "" without a schema."""
    types: dict[str, str] = {}
    for schema, channel, _ in messages:
        kind = _kind(schema)
        if (before := types.setdefault(channel.topic, kind)) != kind and TYPES.keys() & {before, kind}:
            raise ValueError(f"{channel.topic}: expected messages of one type, got {before} and {kind}")
    return types


def _kind(schema: Any) -> str:
    return "" if schema is None else schema.name.replace("/msg/", "/")


def is_known(schema: Any) -> bool:
    """Whether messages of a schema have one of the types that are read."""
    return _kind(schema) in TYPES


def topic_name(topic: str) -> str:
    """A topic as words with dots between them."""
    return topic.strip("/").replace("/", ".")


def _read(decoders: Any, schema: Any, channel: Any, message: Any, number: int) -> _Read:
    try:
        decode = decoders.decoder_for(channel.message_encoding, schema)
        if decode is None:
            raise ValueError(f"schema in {schema.encoding} and messages in {channel.message_encoding}")
        found = decode(message.data)
    except Exception as error:  # the decoder has no exception of its own
        raise ValueError(
            f"{channel.topic}: expected {schema.name} as ros2msg and CDR, got another in message {number + 1}: "
            f"{' '.join(str(error).split())[:100]}"
        ) from error
    try:
        numbers = TYPES[_kind(schema)](topic_name(channel.topic), found)
    except ValueError as error:
        raise ValueError(f"{channel.topic}: message {number + 1}: {error}") from error
    header = getattr(found, "header", None)
    stamp = 0 if header is None else header.stamp.sec * 10**9 + header.stamp.nanosec
    return _Read(numbers, stamp, message.log_time)


def _by_names(topic: str, several: list[_Read]) -> dict[str, list[_Read]]:
    """Messages of one topic, grouped by the names of their numbers, by signal name; those without any are left out."""
    groups: dict[tuple[str, ...], list[_Read]] = {}
    for one in several:
        if one.numbers:
            groups.setdefault(tuple(one.numbers), []).append(one)
    own = topic_name(topic)
    return {own if not place else f"{own}.{place + 1}": group for place, group in enumerate(groups.values())}


def _offset(several: Iterable[_Read]) -> int:
    """Offset in ns from recording times to stamps; 0 if both have the same clock."""
    ahead, without = [], 0
    for one in several:
        if one.stamp:
            ahead.append(one.stamp - one.logged)
        else:
            without += 1
    offset = sorted(ahead)[len(ahead) // 2] if ahead else 0
    if not without or abs(offset) < APART * 1e9:
        return 0
    warnings.warn(
        f"{without} messages have no stamp, and stamps of others are {abs(offset) / 1e9:.6g} s "
        f"{'ahead of' if offset > 0 else 'behind'} the recorder's clock: times of the former are moved by that",
        RosWarning,
        stacklevel=2,
    )
    return offset


def _time(one: _Read, offset: int) -> int:
    return one.stamp or one.logged + offset


def _joint_state(topic: str, message: Any) -> Row:
    names, row = list(message.name), dict[str, tuple[float, str]]()
    if len(set(names)) < len(names):
        raise ValueError(f"expected each joint once, got {', '.join(names)}")
    for key, field in (("qpos", "position"), ("qvel", "velocity"), ("effort", "effort")):
        values = list(getattr(message, field))
        if values and len(values) != len(names):
            raise ValueError(f"expected no {field} or one for each of {len(names)} joints, got {len(values)}")
        row |= {f"joint/{name}/{key}": (float(value), "") for name, value in zip(names, values, strict=bool(values))}
    return row


def _imu(topic: str, message: Any) -> Row:
    row: dict[str, tuple[float, str]] = {}
    for field, unit in (("orientation", "1"), ("angular_velocity", "rad/s"), ("linear_acceleration", "m/s^2")):
        if getattr(message, f"{field}_covariance")[0] != -1:  # -1 says that there is no such measurement
            vector = getattr(message, field)
            row |= _vector(f"{topic}/{field}", _wxyz(vector) if field == "orientation" else _xyz(vector), unit)
    return row


def _pose(topic: str, message: Any) -> Row:
    pose = message.pose
    return _vector(f"{topic}/pos", _xyz(pose.position), "m") | _vector(f"{topic}/quat", _wxyz(pose.orientation), "1")


def _numbers(topic: str, message: Any) -> Row:
    return _vector(topic, message.data, "")


def _number(topic: str, message: Any) -> Row:
    return {topic: (float(message.data), "")}


def _vector(name: str, values: Iterable[float], unit: str) -> dict[str, tuple[float, str]]:
    return {f"{name}[{place}]": (float(value), unit) for place, value in enumerate(values)}


def _xyz(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def _wxyz(quaternion: Any) -> tuple[float, float, float, float]:
    return quaternion.w, quaternion.x, quaternion.y, quaternion.z


TYPES: Mapping[str, Callable[[str, Any], Row]] = {
    "sensor_msgs/JointState": _joint_state,
    "sensor_msgs/Imu": _imu,
    "geometry_msgs/PoseStamped": _pose,
    "std_msgs/Float64MultiArray": _numbers,
    "std_msgs/Float64": _number,
}
"""Types of messages that are read, without the "msg" between package and type."""
