"""A driver for your own robot and any policy: one class with four methods, here for a simulated motor and encoder.

    python examples/any_robot.py
    cd examples && jaxlfi control POLICY --robot any_robot:Driver --dry-run --out ../dry.csv

Replace `PretendedMotor` with your own bus; the rest can stay as it is. The driver needs NumPy only.
"""

import math
import tempfile
from pathlib import Path

import numpy as np

from jaxlfi.rl.policy import Policy
from jaxlfi.robots import sessions
from jaxlfi.robots.clock import Monotonic, Simulated
from jaxlfi.robots.robot import Observation
from jaxlfi.robots.settings import of_table


class PretendedMotor:
    """A flywheel of 1e-3 kg m² with a little friction, and an encoder with 4096 counts per turn."""

    def __init__(self, clock):
        self.clock, self.since = clock, clock.now()
        self.angle, self.speed, self.torque = 0.8, 0.0, 0.0

    def set_torque(self, newton_metres):
        """Apply a torque from now on."""
        self.advance()
        self.torque = newton_metres

    def read_encoder(self):
        """The angle, in counts."""
        self.advance()
        return round(self.angle * 4096 / (2 * math.pi))

    def advance(self):
        """Simulate up to now, in steps of a millisecond."""
        while self.since + 1e-3 <= self.clock.now() + 1e-9:
            self.speed += 1e-3 * (self.torque - 2e-4 * self.speed) / 1e-3
            self.angle += 1e-3 * self.speed
            self.since += 1e-3


class Driver:
    """The methods that the loop calls: connect, observe, act and stop."""

    def __init__(self, clock=None):
        """Nothing moves before `connect`."""
        self.clock = Monotonic() if clock is None else clock
        self.number = -1

    def connect(self, signals, controls):
        """Get ready, or refuse unknown signals and controls; the returned values are recorded."""
        if set(signals) - {"wheel angle"} or set(controls) - {"motor"}:
            raise ValueError(f"robot: expected wheel angle and motor, got {', '.join([*signals, *controls])}")
        self.motor = PretendedMotor(self.clock)
        return {"description": "a pretended flywheel", "encoder": "4096 counts a turn"}

    def observe(self):
        """The current measurements by name, with an increasing number and their age in s."""
        self.number += 1
        return Observation({"wheel angle": self.motor.read_encoder() * 2 * math.pi / 4096}, self.number, age=0.0)

    def act(self, controls):
        """Apply the controls from now on, and return at once."""
        self.motor.set_torque(controls["motor"])

    def stop(self):
        """Come to rest, whatever happened before."""
        if hasattr(self, "motor"):
            self.motor.set_torque(0.0)


def a_policy():
    """A policy that turns the wheel to zero, with gains of -0.02 N m/rad and -0.004 N m s/rad."""
    control = {"name": "motor", "low": -0.01, "high": 0.01, "unit": "N m"}
    signals = [{"name": "wheel angle", "unit": "rad"}, {"name": "joint/wheel/qvel", "unit": "rad/s"}]
    names = [one["name"] for one in signals]
    schema = {
        "environment": "flywheel",
        "observations": {"names": names, "units": ["rad", "rad/s"], "centre": [0.0, 0.0], "scale": [1.0, 1.0]},
        "actions": {"names": ["motor"], "units": ["N m"], "centre": [0.0], "scale": [0.01]},
        "preparation": {"signals": signals, "controls": [control], "interval": 0.02, "steps": 150},
    }
    return Policy((np.array([[-2.0], [-0.4]], np.float32),), (np.zeros(1, np.float32),), schema)


ROBOT = {
    "limits": {"wheel angle": [-3.0, 3.0]},
    "controls": {"motor": {"limits": [-0.008, 0.008], "rate": 0.5}},
    "velocities": {"joint/wheel/qvel": {"of": "wheel angle", "filter": 0.01}},
}
"""The table [robot] of a task's file: this robot measures no velocity."""


def main():
    """Run three seconds on a clock that runs as fast as it can; on a real robot, leave the clock out."""
    clock = Simulated()
    driver = Driver(clock)
    session = sessions.of(a_policy(), of_table(ROBOT), changes={"clock": clock})
    with tempfile.TemporaryDirectory() as folder:
        log = session.run(driver, Path(folder) / "log.csv", {}, say=print)
        print((Path(folder) / "log.csv").read_text()[:120])
    print(f"wheel angle {log.observations[0, 0]:.3f} rad at first, {log.observations[-1, 0]:.3f} rad at last")
    return log


if __name__ == "__main__":
    main()
