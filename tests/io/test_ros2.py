"""ROS 2 bags in MCAP: messages encoded by hand are read with names, units and clocks, quaternions as w, x, y, z."""

import sys

import numpy as np
import pytest
from ros_bags import Cdr, array, bag, imu, joints, pose

from jaxlfi.envs.mujoco.logs import read
from jaxlfi.io import mcap, ros2

JOINTS, IMU, POSE = "sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu", "geometry_msgs/msg/PoseStamped"
ARRAY, NUMBER, OTHER = "std_msgs/msg/Float64MultiArray", "std_msgs/msg/Float64", "tf2_msgs/msg/TFMessage"
BEGIN = 1_700_000_000_123_456_789
STEP = 10_000_000


@pytest.fixture
def decoder():
    pytest.importorskip("mcap_ros2", reason="messages of ROS 2 are decoded by mcap-ros2-support, of the extra robotics")


def test_each_type_and_each_topic_by_its_own_clock(tmp_path, decoder):
    """Stamps of headers, in all their digits, and the recorder's time where there is none."""
    half = np.sqrt(0.5)
    path = bag(
        tmp_path / "a.mcap",
        *[
            ("/joint_states", JOINTS, BEGIN + k * STEP + 900_000, joints(BEGIN + k * STEP, ["hip", "knee"],
              [0.25 + k, -1.5], [2.0, 3.0 - k], [-0.5, 4.0 * k])) for k in range(4)
        ],
        *[
            ("/imu/data", IMU, BEGIN + k * 4_000_000 + 900_000, imu(BEGIN + k * 4_000_000 + 1, (0.0, half, 0.0, half),
              (1.0, 2.0, 3.0 + k), (0.5, -0.5, 9.81))) for k in range(3)
        ],
        ("/box/pose", POSE, BEGIN + 900_000, pose(BEGIN + 500_000, (1.0, 2.0, 3.0), (half, 0.0, 0.0, -half))),
        *[("/commands", ARRAY, BEGIN + k * STEP + 7, array([1.0, -2.0 * k], "motors" * k)) for k in range(2)],
        ("/mode", NUMBER, BEGIN + 11, Cdr().put("d", 3.5).message),
        ("/tf", OTHER, BEGIN, Cdr().text("x").message),
    )  # fmt: skip
    read_signals = mcap.read(path).signals
    assert set(read_signals) == {"joint_states", "imu.data", "box.pose", "commands", "mode"}
    state = read_signals["joint_states"]
    assert state.names == tuple(
        f"joint/{name}/{what}" for what in ("qpos", "qvel", "effort") for name in ("hip", "knee")
    )
    np.testing.assert_array_equal(state.values[2], [2.25, -1.5, 2.0, 1.0, -0.5, 8.0])
    np.testing.assert_allclose(state.times, [0, 0.01, 0.02, 0.03], atol=1e-12)
    moved = read_signals["imu.data"]
    np.testing.assert_allclose(moved.values[1], [half, 0, half, 0, 1, 2, 4, 0.5, -0.5, 9.81])  # w, x, y, z
    np.testing.assert_allclose(moved.times, [1e-9, 0.004 + 1e-9, 0.008 + 1e-9], rtol=0, atol=1e-13)
    assert moved.names[0] == "imu.data/orientation[0]" and moved.units[4:] == ("rad/s",) * 3 + ("m/s^2",) * 3
    box = read_signals["box.pose"]
    np.testing.assert_allclose(box.values[0], [1, 2, 3, -half, half, 0, 0])
    assert box.names[2:4] == ("box.pose/pos[2]", "box.pose/quat[0]") and box.times[0] == pytest.approx(5e-4, abs=1e-12)
    sent = read_signals["commands"]
    assert sent.names == ("commands[0]", "commands[1]") and sent.values.tolist() == [[1.0, 0.0], [1.0, -2.0]]
    np.testing.assert_allclose(sent.times, [7e-9, 0.01 + 7e-9], rtol=0, atol=1e-13)
    assert read_signals["mode"].values.tolist() == [[3.5]]
    log = read(path)
    assert len(log.times) == 4 + 3 + 1 + 2 + 1
    np.testing.assert_allclose(log.samples("joint/knee/effort")[1], [0, 4, 8, 12])
    assert log.units["box.pose/pos[0]"] == "m"


def test_messages_as_another_program_wrote_them(tmp_path, decoder):
    """Our encoding by hand is what the library's own encoder makes of the same numbers."""
    from mcap.reader import make_reader
    from mcap_ros2.writer import Writer
    from ros_bags import DEFINITIONS

    path = tmp_path / "theirs.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        schema = writer.register_msgdef(JOINTS, DEFINITIONS[JOINTS])
        stamp = {"sec": BEGIN // 10**9, "nanosec": BEGIN % 10**9}
        body = {"name": ["hip", "an_arm"], "position": [0.5, -2.0], "velocity": [], "effort": [1.5, 0.25]}
        writer.write_message("/joints", schema, {"header": {"stamp": stamp, "frame_id": "base"}, **body}, BEGIN)
        writer.finish()
    with path.open("rb") as stream:
        ((_, _, message),) = make_reader(stream).iter_messages()
    own = joints(BEGIN, ["hip", "an_arm"], [0.5, -2.0], [], [1.5, 0.25])
    assert message.data == own[: len(message.data)]
    assert mcap.read(path).signals["joints"].values.tolist() == [[0.5, -2.0, 1.5, 0.25]]


def test_joints_of_several_publishers_and_parts_of_a_bag(tmp_path, decoder):
    """A hand and an arm that publish on one topic have clocks of their own; the files of a bag are read together."""
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    for part in range(2):
        first = BEGIN + 2 * part * STEP
        bag(
            folder / f"bag_{part}.mcap",
            *[("/joint_states", JOINTS, first + k * STEP, joints(first + k * STEP, ["elbow"], [10.0 * part + k]))
              for k in range(2)],
            *[("/joint_states", JOINTS, first + k * STEP + 1, joints(first + k * STEP - 3_000_000, ["finger"], [k]))
              for k in range(2)],
        )  # fmt: skip
    log = read(folder)
    times, elbow = log.samples("joint/elbow/qpos")
    assert elbow.tolist() == [0.0, 1.0, 10.0, 11.0] and list(log.signals) == ["joint/elbow/qpos", "joint/finger/qpos"]
    np.testing.assert_allclose(times, 0.003 + 0.01 * np.arange(4), atol=1e-12)
    assert log.samples("joint/finger/qpos")[1].tolist() == [0.0, 1.0, 0.0, 1.0]


def test_one_joint_of_two_topics_is_called_by_the_topic(tmp_path, decoder):
    path = bag(
        tmp_path / "a.mcap",
        *[(topic, JOINTS, BEGIN + k * STEP, joints(BEGIN + k * STEP, ["hip"], [sign * k]))
          for topic, sign in (("/joint_states", 1.0), ("/arm/command", -2.0)) for k in range(3)],
    )  # fmt: skip
    log = read(path)
    assert log.signals["joint_states/joint/hip/qpos"].tolist() == [0.0, 1.0, 2.0]
    assert log.signals["arm.command/joint/hip/qpos"].tolist() == [0.0, -2.0, -4.0]


def test_an_imu_without_an_orientation_has_none(tmp_path, decoder):
    path = bag(tmp_path / "a.mcap", ("/imu", IMU, BEGIN, imu(BEGIN, (0, 0, 0, 0), (1, 2, 3), (4, 5, 6), True)))
    assert mcap.read(path).signals["imu"].values.tolist() == [[1, 2, 3, 4, 5, 6]]


def test_stamps_of_a_simulated_clock_beside_topics_without_stamps(tmp_path, decoder):
    """The recorder's time is moved to the clock of the stamps, so that both are of one time."""
    path = bag(
        tmp_path / "a.mcap",
        *[("/joint_states", JOINTS, BEGIN + k * STEP, joints(5 * 10**9 + k * STEP, ["hip"], [k])) for k in range(3)],
        *[("/command", ARRAY, BEGIN + k * STEP + 2_000_000, array([k])) for k in range(3)],
    )
    with pytest.warns(ros2.RosWarning, match=r"3 messages have no stamp, and .* s behind the recorder's clock"):
        signals = mcap.read(path).signals
    np.testing.assert_allclose(signals["command"].times - signals["joint_states"].times, 0.002, atol=1e-12)


def test_stamps_that_go_back_or_repeat_are_refused_with_their_messages(tmp_path, decoder):
    stamps = [0, 1, 3, 2, 4, 4]
    path = bag(
        tmp_path / "a.mcap",
        *[("/joint_states", JOINTS, BEGIN + k * STEP, joints(BEGIN + own * STEP, ["hip"], [own]))
          for k, own in enumerate(stamps)],
    )  # fmt: skip
    with pytest.raises(ValueError, match=r"/joint_states: expected stamps in order, got 20000000 in message 4 after"):
        read(path)
    assert mcap.read(path).signals["joint_states"].values.ravel().tolist() == sorted(stamps)
    twice = bag(
        tmp_path / "b.mcap",
        *[("/joint_states", JOINTS, BEGIN + k * STEP, joints(BEGIN + (k // 2) * STEP, ["hip"], [k])) for k in range(6)],
    )
    with pytest.raises(ValueError, match=r"got 0 in sample 2 after 0; samples 2, 4 and 6 repeat a time$"):
        read(twice)


SPOILED = {
    "two types on a topic": (
        [("/x", ARRAY, BEGIN, array([1.0])), ("/x", NUMBER, BEGIN + 1, Cdr().put("d", 1.0).message)],
        "/x: expected messages of one type, got std_msgs/Float64MultiArray and std_msgs/Float64",
    ),
    "sizes": (
        [("/j", JOINTS, BEGIN, joints(BEGIN, ["a", "b"], [1.0]))],
        "/j: message 1: expected no position or one for each of 2 joints, got 1",
    ),
    "a joint twice": ([("/j", JOINTS, BEGIN, joints(BEGIN, ["a", "a"], [1.0, 2.0]))], "expected each joint once"),
    "cut off": (
        [("/j", JOINTS, BEGIN, joints(BEGIN, ["a"], [1.0])), ("/j", JOINTS, BEGIN, joints(BEGIN, ["a"], [1.0])[:30])],
        "/j: expected sensor_msgs/msg/JointState as ros2msg and CDR, got another in message 2",
    ),
    "no known type": ([("/tf", OTHER, BEGIN, b"")], r"of the types .*, got /tf \(tf2_msgs/msg/TFMessage, cdr\)"),
    "nothing in them": ([("/j", JOINTS, BEGIN, joints(BEGIN, []))], "expected messages with numbers, got none"),
}


@pytest.mark.parametrize(("messages", "expected"), SPOILED.values(), ids=SPOILED)
def test_bags_that_cannot_be_read_are_refused_in_one_line(tmp_path, decoder, messages, expected):
    path = bag(tmp_path / "a.mcap", *messages)
    with pytest.raises(ValueError, match=expected) as caught:
        mcap.read(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


def test_a_schema_that_is_no_definition(tmp_path, decoder):
    definitions = {JOINTS: "module sensor_msgs { struct JointState { }; };"}
    path = bag(tmp_path / "a.mcap", ("/j", JOINTS, BEGIN, joints(BEGIN, ["a"])), definitions=definitions)
    with pytest.raises(ValueError, match="/j: expected sensor_msgs/msg/JointState as ros2msg and CDR") as caught:
        mcap.read(path)
    assert "\n" not in str(caught.value)


def test_a_folder_without_mcap_files(tmp_path):
    (tmp_path / "metadata.yaml").write_text("")
    (tmp_path / "bag_0.db3").write_text("")
    with pytest.raises(ValueError, match="expected a bag of MCAP files, got none: `ros2 bag convert`"):
        read(tmp_path)


def test_without_the_decoder_it_says_what_to_install(tmp_path, monkeypatch):
    path = bag(tmp_path / "a.mcap", ("/joint_states", JOINTS, BEGIN, joints(BEGIN, ["hip"], [1.0])))
    monkeypatch.setitem(sys.modules, "mcap_ros2.decoder", None)
    with pytest.raises(ImportError, match=r"mcap-ros2-support: pip install 'jaxlfi\[robotics\]'"):
        mcap.read(path)
