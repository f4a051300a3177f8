"""Matching signals to a model by the names that laboratories and other programs use."""

import pytest

mujoco = pytest.importorskip("mujoco")

from jaxlfi.envs.mujoco import matching

ROBOT = """
<mujoco>
  <worldbody>
    <body name="base">
      <geom size="0.1" mass="2"/>
      <site name="imu"/>
      <body name="upper">
        <joint name="shoulder_pan" axis="0 1 0"/>
        <geom size="0.05" pos="0.3 0 0"/>
        <body name="fore" pos="0.3 0 0">
          <joint name="elbow_flex" axis="0 1 0"/>
          <geom size="0.05" pos="0.2 0 0"/>
        </body>
      </body>
    </body>
    <body name="box" pos="3 0 0"><freejoint/><geom size="0.1"/></body>
  </worldbody>
  <actuator>
    <position name="servo1" joint="shoulder_pan" kp="3"/>
    <motor name="elbow_motor" joint="elbow_flex"/>
  </actuator>
  <sensor>
    <gyro name="g" site="imu"/>
    <accelerometer name="a" site="imu"/>
    <framequat name="attitude" objtype="site" objname="imu"/>
    <jointvel name="elbow_speed" joint="elbow_flex"/>
  </sensor>
</mujoco>
"""


@pytest.fixture(scope="module")
def robot():
    return mujoco.MjModel.from_xml_string(ROBOT)


def matched(model, *names, units=()):
    """Names in the model, with a question mark after guesses; None for nothing."""
    found = matching.places(model, dict(zip(names, [*units, *[""] * len(names)], strict=False)))
    return [place and place.name + "?" * (not place.sure) for place in found.values()]


def test_names_that_stand_for_themselves_are_taken_as_they_are(robot):
    names = ["servo1", "actuator/elbow_motor", "g[1]", "joint/elbow_flex/qpos", "body/box/quat[2]", "elbow_speed_rpm"]
    expected = ["servo1", "elbow_motor", "g[1]", "joint/elbow_flex/qpos", "body/box/quat[2]", "elbow_speed"]
    assert matched(robot, *names) == expected
    assert matching.places(robot, {"elbow_speed_rpm": ""})["elbow_speed_rpm"].unit == "rpm"


CASES = {
    "LeRobot": {
        "action/shoulder_pan.pos": "servo1?",
        "observation.state/shoulder_pan.pos": "joint/shoulder_pan/qpos?",
        "action/elbow_flex.pos": "elbow_motor?",
        "observation.state/elbow_flex.pos": "joint/elbow_flex/qpos?",
        "box.position/x": "body/box/pos[0]?",
        "box.position/y": "body/box/pos[1]?",
        "box.position/z": "body/box/pos[2]?",
        "box.quaternion/x": "body/box/quat[1]?",
        "box.quaternion/y": "body/box/quat[2]?",
        "box.quaternion/z": "body/box/quat[3]?",
        "box.quaternion/w": "body/box/quat[0]?",
        "next.reward": None,
    },
    "ROS": {
        "joint/shoulder_pan/qpos": "joint/shoulder_pan/qpos",
        "joint/elbow_flex/effort": "joint/elbow_flex/effort",
        "imu.data/orientation[0]": "attitude[0]?",
        "imu.data/orientation[1]": "attitude[1]?",
        "imu.data/orientation[2]": "attitude[2]?",
        "imu.data/orientation[3]": "attitude[3]?",
        "imu.data/angular_velocity[0]": "g[0]?",
        "imu.data/angular_velocity[1]": "g[1]?",
        "imu.data/angular_velocity[2]": "g[2]?",
        "imu.data/linear_acceleration[0]": "a[0]?",
        "imu.data/linear_acceleration[1]": "a[1]?",
        "imu.data/linear_acceleration[2]": "a[2]?",
        "box.pose/pos[0]": "body/box/pos[0]?",
        "box.pose/pos[1]": "body/box/pos[1]?",
        "box.pose/pos[2]": "body/box/pos[2]?",
        "arm.commands[0]": "servo1?",
        "arm.commands[1]": "elbow_motor?",
    },
    "vectors": {
        "ctrl[0]": "servo1?",
        "ctrl[1]": "elbow_motor?",
        **{f"qpos[{i}]": f"joint/{joint}/qpos?" for i, joint in enumerate(("shoulder_pan", "elbow_flex"))},
        **{f"qpos[{2 + k}]": f"body/box/pos[{k}]?" for k in range(3)},
        **{f"qpos[{5 + k}]": f"body/box/quat[{k}]?" for k in range(4)},
        **{f"qvel[{i}]": f"joint/{joint}/qvel?" for i, joint in enumerate(("shoulder_pan", "elbow_flex"))},
        **{f"qvel[{2 + k}]": None for k in range(6)},
        "tau[0]": None,  # as the controls are there already
        "tau[1]": None,
    },
    "words": {
        "qShoulderPan": "joint/shoulder_pan/qpos?",
        "elbow flex velocity": "joint/elbow_flex/qvel?",
        "tau_elbow": "elbow_motor?",
        "shoulder_pan_cmd": "servo1?",
        "battery": None,
        "temperature 1": None,
        "q_shoulder": None,
    },
}


@pytest.mark.parametrize("names", CASES.values(), ids=CASES)
def test_names_that_others_give(robot, names):
    assert dict(zip(names, matched(robot, *names), strict=True)) == names


def test_an_effort_is_the_control_of_a_motor_that_has_no_other(robot):
    assert matched(robot, "joint/elbow_flex/effort") == ["elbow_motor?"]
    assert matched(robot, "joint/elbow_flex/effort", "elbow_motor")[0] == "joint/elbow_flex/effort"
    assert matched(robot, "joint/shoulder_pan/effort") == ["joint/shoulder_pan/effort"]  # which is a servo's


def test_units_are_as_good_as_words(robot):
    assert matched(robot, "elbow_flex", units=["rad/s"]) == ["joint/elbow_flex/qvel?"]
    assert matched(robot, "elbow_flex", units=["rad"]) == ["joint/elbow_flex/qpos?"]


def test_nothing_is_matched_twice(robot):
    assert matched(robot, "elbow_flex_pos", "elbow_flex_angle") == ["joint/elbow_flex/qpos?", None]
    with pytest.raises(ValueError, match="expected one column of servo1, got actuator/servo1 and servo1"):
        matched(robot, "servo1", "actuator/servo1")


def test_nearest_names(robot):
    assert matching.nearest(robot, "elbow_moter")[0] == "elbow_motor"
    assert matching.nearest(robot, "log/q_shoulder") == ["joint/shoulder_pan/qpos"]
    assert matching.nearest(robot, "xyzzy") == []
