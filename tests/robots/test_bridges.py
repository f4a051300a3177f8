"""Drivers of LeRobot and ROS 2, against what pretends to be their interfaces."""

import sys
import threading
import time
import types
from types import SimpleNamespace

import numpy as np
import pytest
from robots.machines import INTERVAL, Wheel, a_policy, expected

from jaxlfi.robots import lerobot, ros2, sessions
from jaxlfi.robots.robot import RobotError
from jaxlfi.robots.settings import of_table

NAMES = {"angle": {"name": "pan.pos", "unit": "deg"}, "motor": {"name": "pan.goal", "unit": "N m"}}


class PretendedLeRobot:
    """A wheel by the interface of LeRobot's `Robot`, with a camera."""

    name, id = "wheel_follower", "black"

    def __init__(self):
        self.observation_features = {"pan.pos": float, "joint/wheel/qvel": float, "front": (480, 640, 3)}
        self.action_features = {"pan.goal": float}
        self.wheel, self.calls, self.is_connected = Wheel(), [], False

    def connect(self, calibrate=True):
        self.calls.append("connect")
        self.is_connected = True

    def get_observation(self):
        assert self.is_connected
        self.wheel.advance()
        values = self.wheel.values()
        return {"pan.pos": np.degrees(values["angle"]), "joint/wheel/qvel": values["joint/wheel/qvel"], "front": None}

    def send_action(self, action):
        assert self.is_connected
        self.calls.append(dict(action))
        self.wheel.act({"motor": action["pan.goal"]})
        return action

    def disconnect(self):
        self.calls.append("disconnect")
        self.is_connected = False


def test_a_lerobot_robot_is_driven_in_its_own_names_and_units(tmp_path):
    robot = PretendedLeRobot()
    driver = lerobot.LeRobotDriver(robot)
    driver.simulated_clock = robot.wheel.simulated_clock
    session = sessions.of(a_policy(), of_table({"names": NAMES}))
    log = session.run(driver, tmp_path / "log.csv", {})
    np.testing.assert_allclose(log.targets[:, 0], expected(100)[0], atol=1e-5)
    assert robot.calls[0] == "connect" and robot.calls[-1] == "disconnect" and not robot.is_connected
    assert len(robot.calls) == 102  # an action that is no position is not held at the end


def test_a_lerobot_robot_is_held_where_it_is_and_disconnected():
    class Arm(PretendedLeRobot):
        def __init__(self):
            super().__init__()
            self.observation_features = {"pan.goal": float}

        def get_observation(self):
            return {"pan.goal": 12.5}

    driver = lerobot.LeRobotDriver(robot := Arm())
    driver.connect({"pan.goal": "deg"}, {"pan.goal": "deg"})
    driver.stop()
    assert robot.calls == ["connect", {"pan.goal": 12.5}, "disconnect"]
    driver.stop()
    assert len(robot.calls) == 3


def pretended():
    return PretendedLeRobot()


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("wheel", "expected module:name of what returns LeRobot's robot, got 'wheel'"),
        ("math:pi", "expected math:pi to return LeRobot's robot, got one without connect, get_observation"),
        ("no_such_module:arm", "cannot load 'no_such_module:arm'"),
    ],
)
def test_what_is_no_lerobot_robot_is_refused(word, expected):
    with pytest.raises(ValueError, match=f"robot: {expected}"):
        lerobot.driver(word)


def test_names_that_a_lerobot_robot_does_not_have_are_refused():
    driver = lerobot.driver(f"{__name__}:pretended")
    with pytest.raises(
        ValueError, match=r"expected signals among pan.pos, joint/wheel/qvel of LeRobot's wheel_follower"
    ):
        driver.connect({"angle": "rad"}, {})
    with pytest.raises(ValueError, match=r"controls among pan.goal .*, got motor: map their names in \[robot.names\]"):
        driver.connect({"pan.pos": "rad"}, {"motor": "N m"})


# --------------------------------------------------------------------------------------------------------------- ROS 2


class PretendedRos:
    """rclpy, sensor_msgs and std_msgs, and a wheel that publishes its states 200 times a second while a node spins."""

    def __init__(self, monkeypatch, silent=False):
        self.begun, self.sent, self.subscriptions, self.destroyed, self.silent = False, [], {}, 0, silent
        self.angle, self.ended, self.other = 0.25, threading.Event(), None
        message = lambda: SimpleNamespace(data=[])
        modules = {
            "rclpy": {
                "ok": lambda: self.begun,
                "init": lambda: setattr(self, "begun", True),
                "shutdown": lambda: setattr(self, "begun", False),
                "create_node": lambda name: self,
            },
            "rclpy.executors": {"SingleThreadedExecutor": lambda: self},
            "sensor_msgs": {},
            "sensor_msgs.msg": {"JointState": "JointState"},
            "std_msgs": {},
            "std_msgs.msg": {"Float64MultiArray": message},
        }
        for name, contents in modules.items():
            module = types.ModuleType(name)
            vars(module).update(contents)
            monkeypatch.setitem(sys.modules, name, module)

    def create_subscription(self, kind, topic, callback, depth):
        self.subscriptions[topic] = callback

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=lambda message: self.sent.append((topic, list(message.data))))

    def add_node(self, node):
        assert node is self

    def spin(self):
        while not self.ended.wait(0.005):
            stamp = SimpleNamespace(sec=int(time.time()), nanosec=int(time.time() % 1 * 1e9))
            states = {"name": ["other", "arm"], "position": [9.0, self.angle], "velocity": [8.0, -0.5], "effort": []}
            if not self.silent:
                self.subscriptions["/joint_states"](SimpleNamespace(header=SimpleNamespace(stamp=stamp), **states))
            if self.other is not None:
                self.subscriptions["/effort/commands"](SimpleNamespace(data=[self.other]))

    def shutdown(self):
        self.ended.set()

    def destroy_node(self):
        self.destroyed += 1

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=int(time.time() * 1e9)))


ROS = {
    "names": {
        "angle": {"name": "joint/arm/qpos"},
        "joint/wheel/qvel": {"name": "joint/arm/qvel"},
        "motor": {"name": "arm"},
    }
}


def test_a_ros_robot_is_driven_by_its_topics_and_stops_at_rest(tmp_path, monkeypatch):
    ros = PretendedRos(monkeypatch)
    driver = ros2.driver("/effort/commands", ("arm",))
    session = sessions.of(a_policy(), of_table(ROS), duration=10 * INTERVAL, changes={"watchdog": 5.0, "max_age": 1.0})
    log = session.run(driver, tmp_path / "log.csv", {})
    np.testing.assert_allclose(log.observations, [[0.25, -0.5]] * len(log.observations))
    assert {topic for topic, _ in ros.sent} == {"/effort/commands"}
    given = [data[0] for _, data in ros.sent]
    assert given[-1] == 0.0 and given[:-1] == list(log.targets[np.isfinite(log.lateness), 0])
    assert given[-2] == pytest.approx(-8 * 0.25 + 0.5 * 0.5) and ros.destroyed == 1 and not ros.begun
    assert (log.times[1:] < INTERVAL * np.arange(1, len(log.times)) + 1.0).all()


def test_a_ros_robot_with_positions_is_held_where_it_is(monkeypatch):
    ros = PretendedRos(monkeypatch)
    driver = ros2.driver("/position/commands", ("arm", "other"), quantity="position")
    about = driver.connect({"joint/arm/qpos": "rad"}, {"other": "rad", "arm": "rad"})
    assert about["quantity"] == "position"
    driver.act({"arm": 1.5, "other": -2.5})
    driver.stop()
    assert [data for _, data in ros.sent] == [[1.5, -2.5], [0.25, 9.0]]


def test_what_somebody_else_commands_a_ros_robot_is_heard(monkeypatch):
    ros = PretendedRos(monkeypatch)
    ros.other = 0.75
    driver = ros2.driver("/effort/commands", ("arm",))
    driver.connect({"joint/arm/qpos": "rad", "arm": "N m"}, {})
    ends = time.monotonic() + 5.0
    while "arm" not in driver.observe().values and time.monotonic() < ends:
        time.sleep(0.005)
    assert driver.observe().values["arm"] == 0.75
    driver.stop()
    assert not ros.sent


def test_a_ros_robot_that_is_not_there_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(ImportError, match="a ROS 2 robot needs rclpy: source the setup of a ROS 2 installation"):
        ros2.driver("/commands", ("arm",))
    PretendedRos(monkeypatch, silent=True)
    driver = ros2.driver("/commands", ("arm",), timeout=0.05)
    with pytest.raises(RobotError, match=r"robot: expected states on /joint_states, got none in 0.05 s"):
        driver.connect({"joint/arm/qpos": "rad"}, {"arm": "N m"})
    for signals, controls, expected_error in (
        (
            {"arm angle": "rad"},
            {"arm": "N m"},
            "expected signals joint/NAME/qpos, joint/NAME/qvel or .*, got arm angle",
        ),
        ({"joint/arm/qpos": "rad"}, {"leg": "N m"}, "expected controls among arm, got leg"),
    ):
        with pytest.raises(ValueError, match=expected_error):
            driver.connect(signals, controls)
    driver.stop()
