"""What tests of drivers share: a policy of a motor, and a motor that is a mass on a clock."""

import dataclasses
import json
import math

import numpy as np

from jaxlfi.rl.policy import Policy
from jaxlfi.rl.preparation import Control, Preparation, Signal
from jaxlfi.robots.clock import Simulated
from jaxlfi.robots.robot import Observation

INTERVAL = 0.02
SIGNALS = (Signal("angle", "rad"), Signal("joint/wheel/qvel", "rad/s"))
MOTOR = Control("motor", -2.0, 3.0, "N m", rate=60.0)


def prepared(steps=100, controls=(MOTOR,), signals=SIGNALS, **more):
    return Preparation(signals, controls, INTERVAL, steps, **more)


def a_policy(preparation=None, weights=None, robot=None):
    """A linear policy, by default -8 times the angle and -0.5 times the speed."""
    preparation = preparation or prepared()
    low, high = preparation.ranges
    names = list(preparation.names)
    columns = {
        "observations": {"names": names, "units": [""] * len(names), "centre": [0.0] * len(names)}
        | {"scale": [1.0] * len(names)},
        "actions": {
            "names": [one.name for one in preparation.controls],
            "units": [one.unit for one in preparation.controls],
            "centre": (0.5 * (low + high)).tolist(),
            "scale": (0.5 * (high - low)).tolist(),
        },
    }
    weights = np.array([[-8.0], [-0.5]]) if weights is None else np.asarray(weights)
    centre, scale = 0.5 * (low + high), 0.5 * (high - low)
    schema = {"environment": "wheel", **columns, "preparation": json.loads(json.dumps(dataclasses.asdict(preparation)))}
    schema |= {} if robot is None else {"robot": robot}
    return Policy(((weights / scale).astype(np.float32),), ((-centre / scale).astype(np.float32),), schema)


class Wheel:
    """A wheel of 0.1 kg m² without friction, on which the motor's torque acts from one command to the next.

    Attributes:
        calls: what it was asked, in order.
    """

    def __init__(self, clock=None, angle=0.5, given=None, units=None, seen=("angle", "joint/wheel/qvel")):
        """`given` is called with the number of each observation, in its place."""
        self.simulated_clock = Simulated() if clock is None else clock
        self.given, self.seen, self.calls, self.stops = given or {}, seen, [], 0
        self.angle, self.speed, self.torque, self.since, self.number = angle, 0.0, 0.0, 0.0, -1
        self.torques = []

    def connect(self, signals, controls):
        self.calls.append("connect")
        self.asked, self.controls = dict(signals), dict(controls)
        if missing := [name for name in signals if name not in (*self.seen, "motor")]:
            raise ValueError(f"robot: expected signals among {', '.join(self.seen)}, got {', '.join(missing)}")
        return {"name": "wheel"}

    def observe(self):
        assert not self.stops
        self.number += 1
        self.advance()
        plain = Observation(self.values(), self.number)
        return self.given[self.number](plain) if self.number in self.given else plain

    def values(self):
        every = {"angle": self.angle, "joint/wheel/qvel": self.speed, "motor": self.torque, "battery": 11.0}
        return {name: every[name] for name in (*self.seen, "motor", "battery")}

    def act(self, controls):
        assert not self.stops
        self.advance()
        self.torque = controls["motor"]
        self.torques.append((self.simulated_clock.now(), self.torque))

    def stop(self):
        self.stops += 1

    def advance(self):
        """The closed form of a constant torque."""
        passed = self.simulated_clock.now() - self.since
        acceleration = self.torque / 0.1
        self.angle += self.speed * passed + 0.5 * acceleration * passed**2
        self.speed += acceleration * passed
        self.since += passed


def expected(steps, angle=0.5, low=-2.0, high=3.0, rate=60.0, first=0.0):
    """What should be commanded and measured, in plain NumPy: shapes [steps] and [steps + 1, 2]."""
    speed, torque, torques, seen = 0.0, first, [], [(angle, 0.0)]
    for _ in range(steps):
        wanted = np.clip(-8.0 * angle - 0.5 * speed, -2.0, 3.0)
        torque = np.clip(np.clip(wanted, torque - rate * INTERVAL, torque + rate * INTERVAL), low, high)
        angle += speed * INTERVAL + 0.5 * torque / 0.1 * INTERVAL**2
        speed += torque / 0.1 * INTERVAL
        torques.append(torque), seen.append((angle, speed))
    assert math.isfinite(angle)
    return np.array(torques), np.array(seen)
