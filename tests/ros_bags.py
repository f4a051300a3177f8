"""Shared by tests of ROS 2 bags: messages as CDR, encoded by hand, and bags of them."""

import io
import struct

from mcap.writer import Writer

HEADER = """\
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
VECTOR = """\
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x 0
float64 y 0
float64 z 0
float64 w 1
================================================================================
MSG: geometry_msgs/Pose
Point position
Quaternion orientation
"""
LAYOUT = """\
================================================================================
MSG: std_msgs/MultiArrayLayout
MultiArrayDimension[] dim
uint32 data_offset
================================================================================
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
"""
DEFINITIONS = {
    "sensor_msgs/msg/JointState": "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\n"
    f"float64[] effort\n{HEADER}",
    "sensor_msgs/msg/Imu": "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\n"
    "float64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\n"
    "float64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n"
    f"float64[9] linear_acceleration_covariance\n{HEADER}{VECTOR}",
    "geometry_msgs/msg/PoseStamped": f"std_msgs/Header header\nPose pose\n{HEADER}{VECTOR}",
    "std_msgs/msg/Float64MultiArray": f"MultiArrayLayout layout\nfloat64[] data\n{LAYOUT}",
    "std_msgs/msg/Float64": "float64 data\n",
    "tf2_msgs/msg/TFMessage": "string text\n",
}


class Cdr:
    """Little-endian CDR: numbers are aligned to their size, counted after the four bytes that name the encoding."""

    def __init__(self):
        self.body = b""

    def put(self, form, *values):
        for value in values:
            size = struct.calcsize(form)
            self.body += b"\0" * (-len(self.body) % size) + struct.pack(f"<{form}", value)
        return self

    def text(self, word):
        encoded = word.encode() + b"\0"
        self.put("I", len(encoded)).body += encoded
        return self

    def numbers(self, values):
        return self.put("I", len(values)).put("d", *values)

    def header(self, stamp):
        return self.put("i", stamp // 10**9).put("I", stamp % 10**9).text("base")

    @property
    def message(self):
        return b"\0\1\0\0" + self.body


def joints(stamp, names, position=(), velocity=(), effort=()):
    cdr = Cdr().header(stamp).put("I", len(names))
    for name in names:
        cdr.text(name)
    return cdr.numbers(position).numbers(velocity).numbers(effort).message


def imu(stamp, xyzw, rates, accelerations, without_orientation=False):
    covariance = [-1.0 if without_orientation else 0.01, *[0.0] * 8]
    cdr = Cdr().header(stamp).put("d", *xyzw, *covariance)
    return cdr.put("d", *rates, *[0.0] * 9, *accelerations, *[0.0] * 9).message


def pose(stamp, xyz, xyzw):
    return Cdr().header(stamp).put("d", *xyz, *xyzw).message


def array(values, label=""):
    cdr = Cdr().put("I", 1 if label else 0)
    if label:
        cdr.text(label).put("I", len(values), len(values))
    return cdr.put("I", 0).numbers(values).message


def bag(path, *messages, definitions=DEFINITIONS):
    """Write messages: (topic, type, time of recording in ns, bytes)."""
    stream = io.BytesIO()
    writer, schemas, channels = Writer(stream), {}, {}
    writer.start(profile="ros2")
    for topic, kind, logged, body in messages:
        if kind not in schemas:
            schemas[kind] = writer.register_schema(kind, "ros2msg", definitions[kind].encode())
        if (topic, kind) not in channels:
            channels[topic, kind] = writer.register_channel(topic, "cdr", schemas[kind])
        writer.add_message(channels[topic, kind], logged, body, logged)
    writer.finish()
    path.write_bytes(stream.getvalue())
    return path
