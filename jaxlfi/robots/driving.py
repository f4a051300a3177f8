"""Control loops for policies that drive actuators: torques, angles or speeds, each by name and within its own limits.

The conversion between a robot's signals and the policy, with history, rates and displacements, is that of the training
(`jaxlfi.rl.preparation`). The robot's own limits are in its settings (`jaxlfi.robots.settings`).
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
"""Default time limit of a driver call, in s."""


class Driving(NamedTuple):
    """The state of an episode between two commands.

    Attributes:
        memory: memory of the preparation.
        control: control of the last command, shape [A].
    """

    memory: Memory
    control: np.ndarray


@dataclasses.dataclass(frozen=True)
class Drive(Paced):
    """The control loop for a policy that drives a robot's actuators.

    The robot is also stopped if a signal is measured outside its bounds. Without a usable observation, the last control
    is held.

    Attributes:
        preparation: conversion between signals and the policy.
        limits: limits on the controls.
        signals: names of the numbers of an observation: those that the policy sees, and further ones.
        bounds: smallest and largest allowed value by signal.
        commands: values that the operator sets, in the order of the preparation's commands.
        follows: whether another controller commands, whose controls are observed.
        units: units of signals that the policy does not see, where they are known.
        terminations: conditions that end an episode early, by name.

    Raises:
        ValueError: for bounds and terminations of other signals, and a wrong number of commands.
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
        """The loop of a policy's training, within its robot's limits, with some changes.

        Args:
            policy: policy with a preparation; for policies of earlier versions, it is made from their names, which
                needs a rate.
            settings: settings of the robot; by default those that the policy carries.
            commands: values of the commands by name; by default the middle of their range in training.
            rate: control rate, in Hz; by default that of the training.
            **changes: changes of other attributes.

        Raises:
            ValueError: for settings of other signals or actuators, and settings that would loosen a limit.
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
        """Number of measured values."""
        return len(self.signals)

    @property
    def needed(self) -> list[int]:
        """Indices of signals that are seen by the policy, have bounds or end episodes; others may be missing."""
        seen = len(self.preparation.signals)
        watched = {*self.bounds, *(one.signal for one in self.terminations.values())}
        return [place for place, name in enumerate(self.signals) if place < seen or name in watched]

    @property
    def count(self) -> int:
        """Number of controls."""
        return len(self.preparation.controls)

    @property
    def answers(self) -> int:
        """Number of values in a policy's action: controls and memory."""
        return self.count + self.preparation.memory

    @property
    def asked(self) -> dict[str, str]:
        """The signals with their units; "" if they are not known."""
        known = {**self.units, **{one.name: one.unit for one in self.preparation.signals}}
        return {name: known.get(name, "") for name in self.signals}

    def begin(self, observation: Observation) -> Driving:
        """The state before the first command.

        Raises:
            RobotError: if the robot reports controls beyond the limits.
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
        """The state with a new measurement, and the policy's observation."""
        memory, control = state
        if self.follows and observation.target is not None and np.isfinite(observation.target).all():
            control = np.asarray(observation.target, float)
            memory = _commanded(memory, control)
        memory, seen = self.preparation.observed(memory, self._values(observation))
        return Driving(memory, control), np.asarray(seen, np.float32)

    def applied(self, state: Driving, asked: np.ndarray | None, seconds: float) -> tuple[Driving, np.ndarray]:
        """The state with the control of an action, within all limits, and the change of the control."""
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
        """Why the robot must be stopped, given these measurements; "" if it need not."""
        for name, (low, high) in self.bounds.items():
            value = values[self.signals.index(name)]
            if not low <= value <= high:
                return f"{name} was measured at {value:.6g}, outside of its limits {[low, high]}"
        return ""

    def ended(self, values: np.ndarray) -> str:
        """Which termination ends the episode, given these measurements; "" if none does."""
        for name, one in self.terminations.items():
            if one.holds(value := values[self.signals.index(one.signal)]):
                return f"{name} ({one}: {one.signal} was measured at {value:.6g})"
        return ""

    def _values(self, observation: Observation) -> np.ndarray:
        """Signals that the policy sees, followed by commands."""
        return np.concatenate([np.asarray(observation.values)[: len(self.preparation.signals)], self.commands])


class Idle:
    """A robot that is observed but not commanded, for dry runs."""

    def __init__(self, robot: Robot):
        """Wrap a robot, which gets no commands."""
        self._robot = robot

    def observe(self) -> Observation | None:
        """The robot's latest observation, or None."""
        return self._robot.observe()

    def act(self, command: Command) -> None:
        """Do nothing."""

    def stop(self) -> None:
        """Stop the robot."""
        self._robot.stop()


def connected(loop: Drive, driver: Driver, settings: Settings) -> tuple[Robot, Drive, dict[str, Any]]:
    """A driver as the robot of a loop, the loop with the clock of a simulated robot, and the driver's information.

    Args:
        loop: control loop, which `follows` if the robot is only watched.
        driver: driver of the robot.
        settings: settings of the robot.

    Raises:
        ValueError: for incompatible units.
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
    """A policy's preparation, or else one made from its names: cosines and sines are angles, actions are controls.

    Raises:
        ValueError: if neither the policy's schema nor `rate` gives a control interval.
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
"""Number of control periods of an episode, for policies that do not state it."""


def limits_of(preparation: Preparation) -> ControlLimits:
    """The limits on the controls that a policy was trained with."""
    each = preparation.controls
    rates = tuple(math.inf if one.rate is None else one.rate for one in each)
    return ControlLimits(
        tuple(one.name for one in each), tuple(one.low for one in each), tuple(one.high for one in each), rates
    )


def limits_within(preparation: Preparation, settings: Settings) -> ControlLimits:
    """The limits on the controls that a robot allows a policy.

    Raises:
        ValueError: for settings of other actuators, settings that would loosen a limit, and velocities of velocities.
    """
    limits = limits_of(preparation)
    for name, (bounds, most) in settings.controls.items():
        limits = limits.tightened(name, bounds, most)
    for name, one in settings.velocities.items():
        if one.of in settings.velocities:
            raise ValueError(f"velocities: {name}: expected a signal that is measured, got {one.of}")
    return limits


def terminations_within(preparation: Preparation, settings: Settings) -> dict[str, Termination]:
    """Terminations of a training that also end episodes on a robot: all but those that its settings ignore.

    Raises:
        ValueError: if they ignore unknown ones.
    """
    known = preparation.terminations
    if unknown := [name for name in settings.ignored_terminations if name not in known]:
        raise ValueError(
            f"ignored_terminations: expected some of {', '.join(known) or 'none'}, got {', '.join(unknown)}"
        )
    return {name: one for name, one in known.items() if name not in settings.ignored_terminations}


def settings_of(policy: Policy) -> Settings:
    """The robot settings that a policy carries; empty if it carries none.

    Raises:
        ValueError: for a policy whose settings are damaged.
    """
    try:
        return of_table(policy.schema.get(SETTINGS, {}))
    except ValueError as error:
        raise ValueError(f"policy: {error}") from error


def done(log: Log) -> np.ndarray:
    """Controls that another controller commanded, one row per observation, NaN where they are not known."""
    return np.asarray(log.extras[DONE], float)


def _commanded(memory: Memory, control: np.ndarray) -> Memory:
    """The memory with its last control replaced."""
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
