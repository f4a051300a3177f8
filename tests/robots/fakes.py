"""What tests of robots share: a policy that says how it was trained, and a robot that does what it is told."""

import dataclasses
import json

import numpy as np

from jaxlfi.rl.deployment import Deployment, Limits
from jaxlfi.rl.policy import Policy
from jaxlfi.robots.robot import Observation

PERIOD = 0.16
LIMITS = Limits(step=(0.06, 0.04), speed=0.4, low=(0.275, 0.1), high=(0.6, 0.5))


def a_policy(steps: int = 16, gain: float = 1.0) -> Policy:
    """Displacements by random weights, of an observation of five numbers whose second and fourth are positions."""
    rng = np.random.default_rng(3)
    signals = lambda names, units, centre, scale: {
        "names": list(names),
        "units": units,
        "centre": [centre] * len(names),
        "scale": [scale] * len(names),
    }
    facts = Deployment(PERIOD, steps, ("b", "d"), LIMITS, {"name": "exact"})
    schema = {
        "environment": "table",
        "observations": signals("abcde", ["image", "m", "image", "m", ""], 0.4, 0.2),
        "actions": signals("uv", ["m", "m"], 0.0, 0.09),  # beyond the limits
        "deployment": json.loads(json.dumps(dataclasses.asdict(facts))),
    }
    weights = gain * rng.normal(size=(5, 2)).astype(np.float32)
    return Policy((weights,), (np.float32([0.1, -0.2]),), schema)


class Robot:
    """It is where it is told to be; what it gives to be observed can be replaced.

    Attributes:
        position: of both set-points.
        commands: that it was given.
        stops: how often it was stopped.
    """

    def __init__(self, position=(0.4, 0.3), given=None, on_act=lambda command: None):
        """`given` replaces observations, by their number; `on_act` is called with each command."""
        self.position, self.given, self.on_act = np.array(position), given or {}, on_act
        self.commands, self.stops, self.number = [], 0, -1

    def observe(self):
        assert not self.stops
        self.number += 1
        values = np.array([0.5, self.position[0], 0.7, self.position[1], 0.0])
        plain = Observation(values, self.number, extras={"seen": [self.number % 2 == 0]})
        return self.given.get(self.number, lambda plain: plain)(plain)

    def act(self, command):
        assert not self.stops
        self.commands.append(command)
        self.position = np.array(command.target)
        self.on_act(command)

    def stop(self):
        self.stops += 1
