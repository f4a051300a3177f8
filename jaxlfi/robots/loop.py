"""Control loops for policies that displace set-points, such as a gripper's in the whipping task.

Other policies are run by `jaxlfi.robots.driving`. Both use the same periods, and stop the robot whatever happens
(`jaxlfi.robots.episode`).
"""

import dataclasses
from typing import Any

import numpy as np

from jaxlfi.rl import deployment
from jaxlfi.rl.deployment import Limits
from jaxlfi.rl.policy import Policy
from jaxlfi.robots.episode import Paced, positive
from jaxlfi.robots.robot import Observation, RobotError


@dataclasses.dataclass(frozen=True)
class Loop(Paced):
    """The control loop for a policy that displaces a robot's set-points.

    The robot is also stopped if it is measured further than `margin` outside the set-points' box.

    Attributes:
        limits: limits on the set-points.
        moved: indices of the set-points' measured positions in an observation, one per action.
        size: number of values in an observation.
        margin: largest distance of a measured position outside the limits, in its unit.

    Raises:
        ValueError: for numbers that are not positive, and limits for another number of set-points.
    """

    limits: Limits
    moved: tuple[int, ...]
    size: int
    margin: float = 0.05

    def __post_init__(self):
        super().__post_init__()
        positive("margin", self.margin, infinite=True)
        if len(self.limits.step) != len(self.moved):
            raise ValueError(f"limits: expected those of {len(self.moved)} set-points, got {len(self.limits.step)}")

    @staticmethod
    def of(policy: Policy, **changes: Any) -> "Loop":
        """The loop of a policy's training, from its schema, with some changes.

        Raises:
            ValueError: for a policy that does not state how it was trained, and invalid changes.
        """
        facts, names = deployment.of_schema(policy.schema), list(policy.observed["names"])
        own: dict[str, Any] = {
            "limits": facts.limits,
            "moved": tuple(names.index(name) for name in facts.moved),
            "size": len(names),
            "rate": 1 / facts.control_interval,
            "steps": facts.steps,
        }
        return Loop(**(own | changes))

    @property
    def measured(self) -> int:
        """Number of measured values."""
        return self.size

    @property
    def count(self) -> int:
        """Number of set-points."""
        return len(self.moved)

    def begin(self, observation: Observation) -> np.ndarray:
        """The set-points before the first command, shape [A].

        Raises:
            ValueError: for a wrong number of set-points.
            RobotError: if they are not within the limits.
        """
        limits, reported = self.limits, observation.target
        target = np.array(observation.values[list(self.moved)] if reported is None else reported, float)
        if target.shape != (self.count,) or not np.isfinite(target).all():
            raise ValueError(f"robot: expected {self.count} set-points, got {target.tolist()}")
        if (target < limits.low).any() or (target > limits.high).any():
            raise RobotError(
                f"robot: expected set-points between {list(limits.low)} and {list(limits.high)} to begin with, "
                f"got {target.tolist()}"
            )
        return target

    def observed(self, state: np.ndarray, observation: Observation) -> tuple[np.ndarray, np.ndarray]:
        """The set-points, and the policy's observation, which is the measurement."""
        return state, np.array(observation.values)

    def applied(self, state: np.ndarray, asked: np.ndarray | None, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """The set-points after the policy's action, within the limits, and their displacement."""
        displacement, target = self.limits.applied(state, np.zeros(self.count) if asked is None else asked, seconds)
        return target, displacement

    def target(self, state: np.ndarray) -> np.ndarray:
        """The set-points."""
        return state

    def outside(self, values: np.ndarray) -> str:
        """Why the robot must be stopped, given these measurements; "" if it need not."""
        at = values[list(self.moved)]
        beyond = np.maximum(np.subtract(self.limits.low, at), np.subtract(at, self.limits.high)).max()
        if beyond > self.margin:
            return f"it was measured at {np.round(at, 4).tolist()}, {beyond:.3g} outside of its limits"
        return ""
