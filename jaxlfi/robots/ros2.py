"""A ROS 2 robot as a driver, by two topics: the states of its joints, and the commands of a ros2_control controller.

    jaxlfi control policy.npz --robot ros2,commands=/effort_controller/commands,joints=arm --config task.toml ...

Signals are joint/NAME/qpos, joint/NAME/qvel and joint/NAME/effort of `sensor_msgs/JointState`, controls the joints of a
controller that takes `std_msgs/Float64MultiArray`, such as effort_controllers/JointGroupEffortController. A task with
other names maps them in its table `[robot.names]`: motor = { name = "arm" }.

rclpy is imported only here, when the driver is made. Tested against mock modules.
"""

import importlib
import threading
import time
from collections.abc import Mapping
from typing import Any, Literal

from jaxlfi.robots.robot import Observation, RobotError

FIELDS = {"qpos": "position", "qvel": "velocity", "effort": "effort"}
"""Fields of a message, by the suffix of a signal's name."""


class Ros2Driver:
    """A driver (`jaxlfi.robots.driver`) that uses topics."""

    def __init__(
        self,
        commands: str,
        joints: tuple[str, ...],
        states: str = "/joint_states",
        quantity: Literal["effort", "velocity", "position"] = "effort",
        timeout: float = 5.0,
    ):
        """It is not connected yet.

        Args:
            commands: topic of the controller's commands.
            joints: joints of the controller, in its order.
            states: topic of the joints' states.
            quantity: quantity that the controller takes. At the stop, efforts and velocities are set to zero, positions
                as measured.
            timeout: time limit for the first states, in s.

        Raises:
            ImportError: without ROS 2.
        """
        if not joints or len(set(joints)) < len(joints):
            raise ValueError(f"joints: expected those of the controller in its order, as joints=a;b, got {joints}")
        try:
            self._rclpy = importlib.import_module("rclpy")
            self._executors = importlib.import_module("rclpy.executors")
            self._joint_state = importlib.import_module("sensor_msgs.msg").JointState
            self._array = importlib.import_module("std_msgs.msg").Float64MultiArray
        except ImportError as error:
            raise ImportError(
                f"a ROS 2 robot needs rclpy: source the setup of a ROS 2 installation ({error})"
            ) from error
        self._topics, self._joints, self._quantity, self._timeout = (states, commands), joints, quantity, timeout
        self._heard = threading.Condition()
        self._states: tuple[int, float, dict[str, float]] | None = None
        self._commanded: dict[str, float] = {}
        self._moves = self._initialised = False
        self._node: Any = None

    def connect(self, signals: Mapping[str, str], controls: Mapping[str, str]) -> Mapping[str, Any]:
        """Subscribe, and wait for the first states.

        Raises:
            ValueError: for joints that the controller does not have, and signals of no joint.
            RobotError: if no states come, or none of a requested joint.
        """
        if unknown := [name for name in controls if name not in self._joints]:
            raise ValueError(f"robot: expected controls among {', '.join(self._joints)}, got {', '.join(unknown)}")
        if controls and len(controls) < len(self._joints):
            raise ValueError(
                f"robot: expected a control for each of {', '.join(self._joints)}, got {', '.join(controls)}"
            )
        if unknown := [name for name in signals if _field(name) is None and name not in self._joints]:
            raise ValueError(
                "robot: expected signals joint/NAME/qpos, joint/NAME/qvel or joint/NAME/effort, "
                f"got {', '.join(unknown)}"
            )
        if not self._rclpy.ok():
            self._rclpy.init()
            self._initialised = True
        states, commands = self._topics
        self._node = self._rclpy.create_node("jaxlfi_control")
        self._node.create_subscription(self._joint_state, states, self._take_states, 1)
        self._moves = bool(controls)
        if self._moves:
            self._publisher = self._node.create_publisher(self._array, commands, 1)
        else:
            self._node.create_subscription(self._array, commands, self._take_commands, 1)
        self._executor = self._executors.SingleThreadedExecutor()
        self._executor.add_node(self._node)
        threading.Thread(target=self._executor.spin, daemon=True).start()
        with self._heard:
            if not self._heard.wait_for(lambda: self._states is not None, self._timeout):
                raise RobotError(f"robot: expected states on {states}, got none in {self._timeout:g} s")
            measured = self._latest()[2]
        if missing := [name for name in signals if name not in measured and name not in self._joints]:
            raise RobotError(f"robot: expected {', '.join(missing)} on {states}, got {', '.join(measured)}")
        return {"source": "ROS 2", "states": states, "commands": commands, "quantity": self._quantity}

    def observe(self) -> Observation:
        """The latest states, and the latest commands if another controller commands."""
        with self._heard:
            number, received, values = self._latest()
            commanded = dict(self._commanded)
        return Observation({**commanded, **values}, number, time.monotonic() - received)

    def act(self, controls: Mapping[str, float]) -> None:
        """Publish a command."""
        message = self._array()
        message.data = [float(controls[name]) for name in self._joints]
        self._publisher.publish(message)

    def stop(self) -> None:
        """Publish a last command, which brings the robot to rest, and shut down."""
        if self._node is None:
            return
        node, self._node = self._node, None
        try:
            if self._moves:
                here = {} if self._states is None else self._states[2]
                held = self._quantity == "position"
                if not held or all(f"joint/{name}/qpos" in here for name in self._joints):
                    self.act({name: here[f"joint/{name}/qpos"] if held else 0.0 for name in self._joints})
        finally:
            self._executor.shutdown()
            node.destroy_node()
            if self._initialised:
                self._rclpy.shutdown()

    def _latest(self) -> tuple[int, float, dict[str, float]]:
        if self._states is None:
            raise RobotError("robot: expected connect before anything else, got none")
        return self._states

    def _take_states(self, message: Any) -> None:
        """Keep a message; its age is that of its stamp, if the robot's clock and this one agree to a second."""
        values = {
            f"joint/{joint}/{end}": float(row[place])
            for end, name in FIELDS.items()
            for row in [getattr(message, name)]
            for place, joint in enumerate(message.name)
            if place < len(row)
        }
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        behind = 1e-9 * self._node.get_clock().now().nanoseconds - stamp if self._node is not None else 0.0
        received = time.monotonic() - (behind if 0.0 <= behind < 1.0 else 0.0)
        with self._heard:
            self._states = (0 if self._states is None else self._states[0] + 1), received, values
            self._heard.notify_all()

    def _take_commands(self, message: Any) -> None:
        with self._heard:
            self._commanded = dict(zip(self._joints, map(float, message.data), strict=False))


def _field(name: str) -> str | None:
    """The message field that holds a signal; None for a signal of no joint."""
    kind, _, rest = name.partition("/")
    return FIELDS.get(rest.rpartition("/")[2]) if kind == "joint" and "/" in rest else None


driver = Ros2Driver
"""The driver for `--robot ros2,commands=TOPIC,joints=a;b`."""
