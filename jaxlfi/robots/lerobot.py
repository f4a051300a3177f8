"""A LeRobot robot as a driver: any object with LeRobot's `connect`, `get_observation`, `send_action` and `disconnect`.

    jaxlfi control policy.npz --robot lerobot,robot=my_lab:arm --config task.toml --out runs/real

`my_lab:arm` returns the robot, constructed with LeRobot. The names and units of its numbers are given in the table
`[robot.names]`: "shoulder angle" = { name = "shoulder_pan.pos", unit = "deg" }. LeRobot measures on request, so a call
takes as long as its bus and cameras do.

LeRobot itself is imported by the code that makes the robot. Tested against a mock robot.
"""

import contextlib
import time
from collections.abc import Mapping
from typing import Any

from jaxlfi.registry import named
from jaxlfi.robots.robot import Observation


class LeRobotDriver:
    """A driver (`jaxlfi.robots.driver`) of a LeRobot robot."""

    def __init__(self, robot: Any):
        """It is not connected yet.

        Args:
            robot: LeRobot's robot.
        """
        self._robot, self._number = robot, -1
        self._signals: tuple[str, ...] = ()
        self._controls: tuple[str, ...] = ()

    def connect(self, signals: Mapping[str, str], controls: Mapping[str, str]) -> Mapping[str, Any]:
        """Connect to the robot, which calibrates it if LeRobot requires that.

        Raises:
            ValueError: for signals or controls that it does not have.
        """
        for what, names, features in (
            ("signals", signals, self._robot.observation_features),
            ("controls", controls, self._robot.action_features),
        ):
            known = [name for name, kind in features.items() if kind in (float, int, "float", "int")]
            if missing := [name for name in names if name not in known]:
                raise ValueError(
                    f"robot: expected {what} among {', '.join(known)} of LeRobot's {self._robot.name}, got "
                    f"{', '.join(missing)}: map their names in [robot.names]"
                )
        self._signals, self._controls = tuple(signals), tuple(controls)
        if not self._robot.is_connected:
            self._robot.connect()
        return {"source": "LeRobot", "robot_type": self._robot.name, "id": getattr(self._robot, "id", None)}

    def observe(self) -> Observation:
        """The robot's current measurements, whose age is half the time that the call takes."""
        began = time.monotonic()
        found = self._robot.get_observation()
        self._number += 1
        age = 0.5 * (time.monotonic() - began)
        return Observation({name: float(found[name]) for name in self._signals}, self._number, age)

    def act(self, controls: Mapping[str, float]) -> None:
        """Send an action."""
        self._robot.send_action(dict(controls))

    def stop(self) -> None:
        """Hold the measured positions, if actions are positions, and disconnect, which is how LeRobot stops a robot."""
        if not self._robot.is_connected:
            return
        try:
            if self._controls:
                with contextlib.suppress(KeyError):  # actions that are not positions have nothing to be held at
                    found = self._robot.get_observation()
                    self._robot.send_action({name: float(found[name]) for name in self._controls})
        finally:
            self._robot.disconnect()


def driver(robot: str) -> LeRobotDriver:
    """The driver for `--robot lerobot,robot=module:name`.

    Args:
        robot: LeRobot's robot, or a function that returns it, as module:name.

    Raises:
        ValueError: for anything else.
    """
    if ":" not in robot:
        raise ValueError(f"robot: expected module:name of what returns LeRobot's robot, got {robot!r}")
    made = named("robot", robot)
    made = made() if callable(made) else made
    methods = ("connect", "get_observation", "send_action", "disconnect")
    if missing := [name for name in methods if not callable(getattr(made, name, None))]:
        raise ValueError(f"robot: expected {robot} to return LeRobot's robot, got one without {', '.join(missing)}")
    return LeRobotDriver(made)
