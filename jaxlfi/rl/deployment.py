"""Deployment: what a robot must know about the environment that a policy was trained in, besides its signals.

An environment whose actions displace set-points declares it as an attribute `deployment`, and the training writes it
into the policy's schema. Like `jaxlfi.rl.policy`, this module needs NumPy only.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

KEY = "deployment"
"""Key of the deployment in a policy's schema."""
ROUNDING = 1e-6
"""Tolerance by which commands may exceed limits; for controls, as a fraction of their range."""


@dataclasses.dataclass(frozen=True)
class Limits:
    """Limits on the commands for a robot's A set-points, in their units.

    Attributes:
        step: largest displacement of each set-point per command, in either direction.
        speed: largest speed of all set-points together, as the Euclidean norm of a displacement per second.
        low: lower limit of each set-point.
        high: upper limit of each set-point.

    Raises:
        ValueError: for unequal lengths, steps and speeds that are not positive, and an empty box.
    """

    step: tuple[float, ...]
    speed: float
    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self):
        for name in ("step", "low", "high"):
            object.__setattr__(self, name, tuple(float(value) for value in getattr(self, name)))
        if not len(self.step) == len(self.low) == len(self.high):
            raise ValueError(f"limits: expected one number a set-point in step, low and high, got {self}")
        if not (all(step > 0 for step in self.step) and self.speed > 0):  # also refuses NaN
            raise ValueError(f"limits: expected a positive step and speed, got {self.step} and {self.speed}")
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"limits: expected low below high, got {self.low} and {self.high}")

    @staticmethod
    def none(size: int) -> "Limits":
        """Infinite limits for `size` set-points, for simulations that check commands themselves."""
        return Limits((math.inf,) * size, math.inf, (-math.inf,) * size, (math.inf,) * size)

    def tightened(
        self,
        step: float | None = None,
        speed: float | None = None,
        low: Sequence[float] | None = None,
        high: Sequence[float] | None = None,
    ) -> "Limits":
        """A copy with some limits tightened.

        Args:
            step: largest displacement of every set-point.
            speed: largest speed of all set-points together.
            low: lower limit of each set-point.
            high: upper limit of each set-point.

        Raises:
            ValueError: for values that would loosen a limit.
        """
        for name, value in (("step", step), ("speed", speed)):
            bound = getattr(self, name)
            if value is not None and not 0 < value <= (bound if name == "speed" else max(bound)):
                raise ValueError(f"{name}: expected more than 0 and at most the policy's {bound}, got {value}")
        for name, values, sign in (("low", low, 1), ("high", high, -1)):
            bounds = getattr(self, name)
            if values is None:
                continue
            if len(values) != len(bounds) or not all(
                sign * value >= sign * bound for value, bound in zip(values, bounds, strict=True)
            ):
                raise ValueError(f"{name}: expected limits within the policy's {list(bounds)}, got {list(values)}")
        return Limits(
            self.step if step is None else tuple(min(step, bound) for bound in self.step),
            self.speed if speed is None else speed,
            self.low if low is None else tuple(low),
            self.high if high is None else tuple(high),
        )

    def applied(self, target: np.ndarray, displacement: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """The requested displacement of the set-points, restricted to all limits.

        Each component is clipped to its step, the vector is shortened to the largest speed, and the set-points are
        clipped to their box.

        Args:
            target: set-points before the command, within the box, shape [A].
            displacement: requested displacement, shape [A].
            seconds: time since the previous command, in s.

        Returns:
            The displacement and the set-points after it, each of shape [A].

        Example:
            >>> limits = Limits(step=(0.06, 0.06), speed=0.5, low=(0.3, 0.1), high=(0.6, 0.5))
            >>> limits.applied(np.array([0.58, 0.3]), np.array([0.09, 0.0]), 0.16)[1].round(3).tolist()
            [0.6, 0.3]
        """
        moved = np.clip(displacement, -np.asarray(self.step), self.step)
        length = float(np.linalg.norm(moved))
        if length > self.speed * seconds:
            moved = moved * (self.speed * seconds / length)
        after = target + moved
        inside = np.clip(after, self.low, self.high)
        return np.where(inside == after, moved, inside - target), inside

    def allow(self, before: np.ndarray, displacement: np.ndarray, target: np.ndarray, seconds: float) -> bool:
        """Whether a command is within the limits, up to rounding, which robots check themselves.

        Args:
            before: set-points before the command, shape [A].
            displacement: displacement of the command, shape [A].
            target: set-points after the command, shape [A].
            seconds: time since the previous command, in s; infinite if there was none.
        """
        return bool(
            (np.abs(displacement) <= np.add(self.step, ROUNDING)).all()  # also refuses NaN
            and (target >= np.subtract(self.low, ROUNDING)).all()
            and (target <= np.add(self.high, ROUNDING)).all()
            and (np.abs(target - (before + displacement)) <= ROUNDING).all()
            and np.linalg.norm(displacement) <= self.speed * seconds + ROUNDING
        )


@dataclasses.dataclass(frozen=True)
class ControlLimits:
    """Limits on the commands for actuators, each in its own quantity, such as a torque, an angle or a speed.

    Attributes:
        names: names of the actuators.
        low: smallest control of each.
        high: largest control of each.
        rate: largest change of each per second; infinite if any change is allowed.

    Raises:
        ValueError: for unequal lengths, rates that are not positive, and empty ranges.

    Example:
        >>> limits = ControlLimits(("motor", "servo"), (-2.0, -1.0), (3.0, 1.0), (10.0, math.inf))
        >>> limits.applied(np.array([0.0, 0.5]), np.array([5.0, 0.75]), 0.1)[1].tolist()
        [1.0, 1.0]
    """

    names: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    rate: tuple[float, ...]

    def __post_init__(self):
        for name in ("low", "high", "rate"):
            object.__setattr__(self, name, tuple(float(value) for value in getattr(self, name)))
        object.__setattr__(self, "names", tuple(self.names))
        if not len(self.names) == len(self.low) == len(self.high) == len(self.rate):
            raise ValueError(f"limits: expected one number an actuator in low, high and rate, got {self}")
        for name, low, high, rate in zip(self.names, self.low, self.high, self.rate, strict=True):
            if not low < high:
                raise ValueError(f"limits: {name}: expected LOW below HIGH, got {[low, high]}")
            if not rate > 0:
                raise ValueError(f"limits: {name}: expected a rate of more than 0 per second, got {rate:g}")

    def tightened(self, name: str, bounds: Sequence[float] | None = None, rate: float | None = None) -> "ControlLimits":
        """A copy with the limits of one actuator tightened.

        Args:
            name: name of the actuator.
            bounds: its smallest and largest control.
            rate: its largest change per second.

        Raises:
            ValueError: for an unknown actuator, and values that would loosen a limit.
        """
        if name not in self.names:
            raise ValueError(f"limits: expected some of {', '.join(self.names)}, got {name}")
        place = self.names.index(name)
        low, high, most = self.low[place], self.high[place], self.rate[place]
        if bounds is not None and not low <= bounds[0] < bounds[1] <= high:
            raise ValueError(f"limits: {name}: expected LOW below HIGH within the policy's {[low, high]}, got {bounds}")
        if rate is not None and not 0 < rate <= most:
            raise ValueError(
                f"limits: {name}: expected a rate of more than 0 and at most the policy's {most}, got {rate}"
            )
        low, high = (low, high) if bounds is None else bounds
        put = lambda values, value: (*values[:place], value, *values[place + 1 :])
        most = most if rate is None else rate
        return ControlLimits(self.names, put(self.low, low), put(self.high, high), put(self.rate, most))

    def applied(self, before: np.ndarray, change: np.ndarray, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """The requested change of the controls, restricted first to the rates and then to the bounds.

        Args:
            before: controls before the command, within the bounds, shape [A].
            change: requested change, shape [A].
            seconds: time since the previous command, in s.

        Returns:
            The change and the controls after it, each of shape [A].
        """
        most = self._most(seconds)
        after = np.clip(before + np.clip(change, -most, most), self.low, self.high)
        return after - before, after

    def allow(self, before: np.ndarray, change: np.ndarray, control: np.ndarray, seconds: float) -> bool:
        """Whether a command is within the limits, up to rounding, which robots check themselves.

        Args:
            before: controls before the command, shape [A].
            change: change of the controls, shape [A].
            control: controls after the command, shape [A].
            seconds: time since the previous command, in s; infinite if there was none.
        """
        size = ROUNDING * np.subtract(self.high, self.low)
        return bool(
            (control >= self.low - size).all()  # also refuses NaN
            and (control <= self.high + size).all()
            and (np.abs(control - (before + change)) <= size).all()
            and (np.abs(change) <= self._most(seconds) + size).all()
        )

    def _most(self, seconds: float) -> np.ndarray:
        """Largest changes in a given time; infinite if any change is allowed, even in no time."""
        return np.array([rate if math.isinf(rate) else rate * seconds for rate in self.rate])


@dataclasses.dataclass(frozen=True)
class Deployment:
    """The conditions that a policy was trained under.

    Attributes:
        control_interval: time between two actions, in s.
        steps: largest number of steps of an episode.
        moved: names of the observations whose set-points the actions displace, one per action, in the actions' order.
        limits: limits on the set-points in training.
        detector: detector that makes the observations: its `name`, and what else is known about it.

    Raises:
        ValueError: for intervals and numbers of steps that are not positive, and limits for another number of
            set-points.
    """

    control_interval: float
    steps: int
    moved: tuple[str, ...]
    limits: Limits
    detector: Mapping[str, Any]

    def __post_init__(self):
        object.__setattr__(self, "moved", tuple(self.moved))
        if not (self.control_interval > 0 and math.isfinite(self.control_interval) and self.steps >= 1):
            raise ValueError(
                f"deployment: expected a positive interval and number of steps, got {self.control_interval} s, "
                f"{self.steps} steps"
            )
        if len(self.limits.step) != len(self.moved):
            raise ValueError(f"deployment: expected limits of {list(self.moved)}, got {len(self.limits.step)}")


def of_schema(schema: Mapping[str, Any]) -> Deployment:
    """The deployment in a policy's schema.

    Raises:
        ValueError: for a policy without a deployment, such as those of earlier versions, or with one of other signals.
    """
    found = schema.get(KEY)
    if found is None:
        raise ValueError(
            "policy: expected a deployment (limits, control interval) in its schema, got none: train it again"
        )
    try:
        deployment = Deployment(**{**found, "limits": Limits(**found["limits"])})
    except (TypeError, KeyError) as error:
        raise ValueError(f"policy: expected a deployment in its schema, got one that is not whole: {error}") from error
    unknown = set(deployment.moved) - set(schema["observations"]["names"])
    if unknown or len(deployment.moved) != len(schema["actions"]["names"]):
        raise ValueError(
            f"policy: expected a deployment whose actions {list(schema['actions']['names'])} each move an "
            f"observation, got {list(deployment.moved)}"
        )
    return deployment
