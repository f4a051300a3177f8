"""Loops of policies that drive actuators: torques, angles or speeds, each by name and within its own limits.

What lies between a robot's signals and the policy, history, rates and displacements, is what the policy was trained
with (`jaxlfi.rl.preparation`). What a robot allows besides is in its settings (`jaxlfi.robots.settings`).
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxlfi.rl import preparation as preparations
from jaxlfi.rl.deployment import ControlLimits
from jaxlfi.rl.policy import Policy
from jaxlfi.rl.preparation import Control, Memory, Preparation, Signal
from jaxlfi.rl.termination import Termination
from jaxlfi.robots.driver import DONE, Driven, Driver
from jaxlfi.robots.episode import Log, Paced
from jaxlfi.robots.robot import Command, Observation, Robot, RobotError
from jaxlfi.robots.settings import KEY as SETTINGS
from jaxlfi.robots.settings import Settings, of_table
from jaxlfi.robots.velocities import Estimated, WithVelocities

WATCHDOG = 0.1
"""Seconds that a call of a driver may take, where nothing else is said."""


class Driving(NamedTuple):
    """What an episode keeps of its past.

    Attributes:
        memory: of the preparation.
        control: of the last command, shape [A].
    """

    memory: Memory
    control: np.ndarray


@dataclasses.dataclass(frozen=True)
class Drive(Paced):
    """The control loop for a policy that drives a robot's actuators.

    A robot is stopped, too, if a signal is measured outside of its bounds. Where there is no usable observation the
    last control is held.

    Attributes:
        preparation: between signals and the policy.
        limits: of the controls.
        signals: names of the numbers of an observation: those that the policy sees, and further ones.
        bounds: least and largest value by signal.
        commands: what the operator asks for, as the policy was trained with, in the order of the preparation.
        follows: another controller commands, and observations say what.
        units: of signals that the policy does not see, where they are known.
        terminations: when an episode ends early, by name.

    Raises:
        ValueError: for bounds, commands and terminations of others.
    """

    preparation: Preparation
    limits: ControlLimits
    signals: tuple[str, ...]
    bounds: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    commands: tuple[float, ...] = ()
    follows: bool = False
    units: Mapping[str, str] = dataclasses.field(default_factory=dict)
    terminations: Mapping[str, Termination] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        super().__post_init__()
        if unknown := [name for name in self.bounds if name not in self.signals]:
            raise ValueError(f"limits: expected signals among {', '.join(self.signals)}, got {', '.join(unknown)}")
        if unknown := [name for name, one in self.terminations.items() if one.signal not in self.signals]:
            raise ValueError(f"terminations: expected some of {', '.join(self.signals)}, got {', '.join(unknown)}")
        if len(self.commands) != len(self.preparation.commands):
            names = ", ".join(one.name for one in self.preparation.commands)
            raise ValueError(f"commands: expected a number for each of {names or 'none'}, got {list(self.commands)}")

    @staticmethod
    def of(
        policy: Policy,
        settings: Settings | None = None,
        commands: Mapping[str, float] | None = None,
        rate: float | None = None,
        **changes: Any,
    ) -> "Drive":
        """As a policy was trained, within what its robot allows, but for some changes.

        Args:
            policy: with a preparation; of one that was trained before there were any it is made from its names, which
                needs a rate.
            settings: of the robot; by default those that the policy carries.
            commands: what is asked for, by name; the middle of what was trained with by default.
            rate: of commands, in Hz; that of the training by default.
            **changes: of other attributes.

        Raises:
            ValueError: for settings of other signals and actuators, and those that would loosen a limit.
        """
        own = preparation_of(policy, rate)
        settings = settings_of(policy) if settings is None else settings
        names = tuple(one.name for one in own.signals)
        ends = terminations_within(own, settings)
        further = (*(one.signal for one in ends.values()), *settings.further)
        given = {
            "rate": 1 / own.interval if rate is None else rate,
            "watchdog": settings.watchdog or WATCHDOG,
            "holds": settings.holds,
            "max_age": settings.max_age,
        }
        return Drive(
            own,
            limits_within(own, settings),
            tuple(dict.fromkeys((*names, *further))),
            settings.limits,
            _commands(own, commands or {}),
            units={one.signal: one.unit for one in ends.values()} | dict(settings.units),
            terminations=ends,
            **({"steps": own.steps} | {name: value for name, value in given.items() if value is not None} | changes),
        )

    @property
    def measured(self) -> int:
        """Number of the numbers that are measured."""
        return len(self.signals)

    @property
    def needed(self) -> list[int]:
        """Places of what the policy sees, has bounds or ends episodes; what is only recorded may be missing."""
        seen = len(self.preparation.signals)
        watched = {*self.bounds, *(one.signal for one in self.terminations.values())}
        return [place for place, name in enumerate(self.signals) if place < seen or name in watched]

    @property
    def count(self) -> int:
        """Number of controls."""
        return len(self.preparation.controls)

    @property
    def answers(self) -> int:
        """Number of the numbers that a policy gives: controls, and what it remembers."""
        return self.count + self.preparation.memory

    @property
    def asked(self) -> dict[str, str]:
        """The signals with their units; "" where they are not known."""
        known = {**self.units, **{one.name: one.unit for one in self.preparation.signals}}
        return {name: known.get(name, "") for name in self.signals}

    def begin(self, observation: Observation) -> Driving:
        """What is remembered before the first command.

        Raises:
            RobotError: where the robot says that its controls are beyond the limits.
        """
        memory, reported = self.preparation.start(self._values(observation)), observation.target
        control = np.clip(memory.controls[0], self.limits.low, self.limits.high)
        if reported is not None and np.isfinite(reported).all():
            control = np.asarray(reported, float)
            if not self.follows and not self.limits.allow(control, np.zeros(self.count), control, math.inf):
                raise RobotError(
                    f"robot: expected controls between {list(self.limits.low)} and {list(self.limits.high)} to begin "
                    f"with, got {control.tolist()}"
                )
        return Driving(memory._replace(controls=np.stack([control] * len(memory.controls))), control)

    def observed(self, state: Driving, observation: Observation) -> tuple[Driving, np.ndarray]:
        """What is remembered with what was measured, and what the policy observes."""
        memory, control = state
        if self.follows and observation.target is not None and np.isfinite(observation.target).all():
            control = np.asarray(observation.target, float)
            memory = _commanded(memory, control)
        memory, seen = self.preparation.observed(memory, self._values(observation))
        return Driving(memory, control), np.asarray(seen, np.float32)

    def applied(self, state: Driving, asked: np.ndarray | None, seconds: float) -> tuple[Driving, np.ndarray]:
        """What is remembered with the control of an action, within all limits, and the change of the control."""
        memory, before = state
        if asked is None:
            controls = np.concatenate([before[None], memory.controls[:-1]])
            return Driving(memory._replace(controls=controls), before), np.zeros(self.count)
        memory, wanted = self.preparation.commanded(memory, asked)
        change, control = self.limits.applied(before, wanted - before, seconds)
        return Driving(_commanded(memory, control), control), change

    def target(self, state: Driving) -> np.ndarray:
        """The control."""
        return state.control

    def outside(self, values: np.ndarray) -> str:
        """Why the robot must be stopped where it has been measured; "" if it need not."""
        for name, (low, high) in self.bounds.items():
            value = values[self.signals.index(name)]
            if not low <= value <= high:
                return f"{name} was measured at {value:.6g}, outside of its limits {[low, high]}"
        return ""

    def ended(self, values: np.ndarray) -> str:
        """Which termination ends the episode where the robot has been measured; "" if none does."""
        for name, one in self.terminations.items():
            if one.holds(value := values[self.signals.index(one.signal)]):
                return f"{name} ({one}: {one.signal} was measured at {value:.6g})"
        return ""

    def _values(self, observation: Observation) -> np.ndarray:
        """Signals that the policy sees, and commands after them."""
        return np.concatenate([np.asarray(observation.values)[: len(self.preparation.signals)], self.commands])


class Idle:
    """A robot that is asked what it measures, and not moved: for dry runs."""

    def __init__(self, robot: Robot):
        """Whatever it is commanded, it does not hear of it."""
        self._robot = robot

    def observe(self) -> Observation | None:
        """As the robot does."""
        return self._robot.observe()

    def act(self, command: Command) -> None:
        """Nothing."""

    def stop(self) -> None:
        """As the robot does."""
        self._robot.stop()


def connected(loop: Drive, driver: Driver, settings: Settings) -> tuple[Robot, Drive, dict[str, Any]]:
    """A driver as the robot of a loop, the loop by the robot's clock where it is simulated, and what the driver says.

    Args:
        loop: which `follows` where the robot is only to be watched.
        driver: of the robot.
        settings: of the robot.

    Raises:
        ValueError: for units that do not fit.
    """
    turning = {one.name for one in loop.preparation.signals if one.turning}
    half = 0.5 * loop.period
    estimated = {
        name: Estimated(one.of, half if one.filter is None else one.filter, one.of in turning)
        for name, one in settings.velocities.items()
        if name in loop.signals
    }
    measured = {name: unit for name, unit in loop.asked.items() if name not in estimated}
    controls = {one.name: one.unit for one in loop.preparation.controls}
    robot = Driven(driver, measured, controls, settings.names, loop.follows)
    loop = dataclasses.replace(loop, clock=getattr(robot, "simulated_clock", loop.clock))
    if not estimated:
        return robot, loop, robot.about
    return WithVelocities(robot, loop.clock, loop.signals, estimated), loop, robot.about


def preparation_of(policy: Policy, rate: float | None = None) -> Preparation:
    """A policy's preparation; of one without, what its names say: cosines and sines are angles, actions are controls.

    Raises:
        ValueError: where a rate is needed, and for observations that are cosines of nothing.
    """
    found = preparations.of_schema(policy.schema)
    if found is not None:
        return found
    if rate is None:
        raise ValueError(
            "policy: expected a control interval in its schema, got none: train it again, or give the rate"
        )
    names, units = list(policy.observed["names"]), list(policy.observed["units"])
    signals, place = [], 0
    while place < len(names):
        angle = names[place].removeprefix("cos ")
        turning = names[place : place + 2] == [f"cos {angle}", f"sin {angle}"]
        signals.append(Signal(angle, "rad", True) if turning else Signal(names[place], units[place]))
        place += 1 + turning
    columns = (policy.acted[key] for key in ("names", "centre", "scale", "units"))
    controls = [
        Control(name, centre - scale, centre + scale, unit) for name, centre, scale, unit in zip(*columns, strict=True)
    ]
    return Preparation(tuple(signals), tuple(controls), 1 / rate, LONG)


LONG = 10**6
"""Control periods of an episode of a policy that does not say."""


def limits_of(preparation: Preparation) -> ControlLimits:
    """What a policy was trained to command."""
    each = preparation.controls
    rates = tuple(math.inf if one.rate is None else one.rate for one in each)
    return ControlLimits(
        tuple(one.name for one in each), tuple(one.low for one in each), tuple(one.high for one in each), rates
    )


def limits_within(preparation: Preparation, settings: Settings) -> ControlLimits:
    """What a robot lets a policy command.

    Raises:
        ValueError: for settings of other actuators, those that would loosen a limit, and velocities of velocities.
    """
    limits = limits_of(preparation)
    for name, (bounds, most) in settings.controls.items():
        limits = limits.tightened(name, bounds, most)
    for name, one in settings.velocities.items():
        if one.of in settings.velocities:
            raise ValueError(f"velocities: {name}: expected a signal that is measured, got {one.of}")
    return limits


def terminations_within(preparation: Preparation, settings: Settings) -> dict[str, Termination]:
    """Terminations of a training that end episodes on a robot, too: all but those that its settings ignore.

    Raises:
        ValueError: where they ignore others.
    """
    known = preparation.terminations
    if unknown := [name for name in settings.ignored_terminations if name not in known]:
        raise ValueError(
            f"ignored_terminations: expected some of {', '.join(known) or 'none'}, got {', '.join(unknown)}"
        )
    return {name: one for name, one in known.items() if name not in settings.ignored_terminations}


def settings_of(policy: Policy) -> Settings:
    """Those that a policy carries; empty where it carries none.

    Raises:
        ValueError: for a policy whose settings are damaged.
    """
    try:
        return of_table(policy.schema.get(SETTINGS, {}))
    except ValueError as error:
        raise ValueError(f"policy: {error}") from error


def done(log: Log) -> np.ndarray:
    """Controls that somebody else commanded, one row for each observation, NaN where they are not known."""
    return np.asarray(log.extras[DONE], float)


def _commanded(memory: Memory, control: np.ndarray) -> Memory:
    """The memory with another last control."""
    return memory._replace(controls=np.concatenate([control[None], memory.controls[1:]]))


def _commands(preparation: Preparation, given: Mapping[str, float]) -> tuple[float, ...]:
    known = [one.name for one in preparation.commands]
    if unknown := [name for name in given if name not in known]:
        raise ValueError(f"commands: expected some of {', '.join(known) or 'none'}, got {', '.join(unknown)}")
    for one in preparation.commands:
        if one.name in given and not one.low <= given[one.name] <= one.high:
            raise ValueError(
                f"commands: {one.name}: expected what was trained with, {[one.low, one.high]}, got {given[one.name]:g}"
            )
    return tuple(given.get(one.name, 0.5 * (one.low + one.high)) for one in preparation.commands)
