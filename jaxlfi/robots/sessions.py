"""A session: a policy, a robot, a loop that fits both, and the files of the episode."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxlfi.rl import deployment
from jaxlfi.rl.policy import TRAINED_ON, Policy
from jaxlfi.robots import driving, recording
from jaxlfi.robots.driver import Driven, Driver
from jaxlfi.robots.driving import Drive, Idle
from jaxlfi.robots.episode import Log
from jaxlfi.robots.loop import Loop
from jaxlfi.robots.recording import Recording
from jaxlfi.robots.robot import Robot, RobotError
from jaxlfi.robots.settings import Settings

Mode = Literal["control", "dry run", "shadow"]
SET_POINT = "set-point "
"""Prefix that turns the name of a measured position into that of its set-point."""
DOUBTFUL = 0.1
"""Fraction of a control period by which ages of measurements may exceed those of the training without a warning."""


@dataclasses.dataclass(frozen=True)
class Session:
    """How a policy controls a robot.

    Attributes:
        policy: policy that is evaluated.
        loop: control loop of the policy's training, within the robot's limits.
        settings: settings of the robot.
        mode: whether the robot is commanded, only observed ("dry run"), or commanded by another controller ("shadow").
    """

    policy: Policy
    loop: Drive | Loop
    settings: Settings
    mode: Mode

    def run(
        self, robot: Robot | Driver, out: Path, about: Mapping[str, Any], say: Callable[[str], Any] = lambda line: None
    ) -> Log:
        """Control a robot for an episode, stop it, and write the recording (`jaxlfi.robots.recording`).

        Args:
            robot: robot, which is stopped in any case.
            out: a new recording.
            about: further entries of the report.
            say: called with lines about what happened.

        Raises:
            RobotError: for a robot that failed, or had to be stopped.
            Interrupted: after SIGINT or SIGTERM.
        """
        made, loop, itself = self._connected(robot)
        if self.mode == "dry run":
            made = Idle(made)

        def ended(log: Log) -> None:
            report = {**about, **self.report(log), "robot": itself}
            recording.write(out, self.recorded(log), log, report, self._signals)
            say(f"{recording.timing_line(log)}; wrote {out}")
            if aged := self._aged(log):
                say(aged)
            if log.ended:
                say(f"the episode ended after {len(log.actions)} of {loop.steps} controls, as in training: {log.ended}")

        log = loop.run(made, self.policy, on_end=ended)
        if log.stopped:
            raise RobotError(f"robot: stopped after {len(log.actions)} of {loop.steps} controls: {log.stopped}")
        return log

    def _connected(self, robot: Robot | Driver) -> tuple[Robot, Drive | Loop, dict[str, Any]]:
        """The robot as the loop needs it, the loop with the robot's clock, and the robot's information about itself."""
        if isinstance(self.loop, Drive):
            if not isinstance(robot, Driver):
                robot.stop()
                raise ValueError("robot: expected one with connect, observe, act and stop (jaxlfi.robots.driver)")
            return driving.connected(self.loop, robot, self.settings)
        if isinstance(robot, Driver):
            robot = Driven(robot, _measured(self.policy), _set_points(self.policy), self.settings.names)
        loop = dataclasses.replace(self.loop, clock=getattr(robot, "simulated_clock", self.loop.clock))
        return robot, loop, dict(getattr(robot, "about", {}))

    def _aged(self, log: Log) -> str:
        """A warning if observations were older or newer than in the policy's training; else ""."""
        if not isinstance(self.loop, Drive) or (age := recording.timing(log)["age"]) is None:
            return ""
        low, high = self.loop.preparation.observation_delay
        if low - DOUBTFUL * log.period <= age <= high + DOUBTFUL * log.period:
            return ""
        line = (
            f"measurements were {1e3 * age:.3g} ms old when the controls made from them were sent (median); the policy "
            f"was trained with {1e3 * low:.3g} to {1e3 * high:.3g} ms: give [policy] an observation_delay that holds it"
        )
        inferred = [f"{name} of {1e3 * low:.3g} to {1e3 * high:.3g} ms" for name, (low, high) in self.delays.items()]
        return f"{line}. To ages it adds the delays that were inferred: {', '.join(inferred)}" if inferred else line

    @property
    def delays(self) -> dict[str, tuple[float, float]]:
        """Delays of sensors that the policy was trained with, in s, which add to the ages of measurements."""
        known = self.policy.schema.get(TRAINED_ON, {})
        own = {name: one for name, one in known.items() if name.startswith("sensor/") and name.endswith("/delay")}
        return {name: (float(one["low"]), float(one["high"])) for name, one in own.items()}

    @property
    def _signals(self) -> tuple[str, ...]:
        """Names of the numbers of an observation."""
        return self.loop.signals if isinstance(self.loop, Drive) else tuple(self.policy.observed["names"])

    def recorded(self, log: Log) -> Recording:
        """The measured signals, and the controls given by whichever controller commanded."""
        if isinstance(self.loop, Drive):
            own = self.loop.preparation
            names, units = self.loop.signals, self.loop.asked
            controls = {one.name: one.unit for one in own.controls}
        else:
            names, units, controls = tuple(_measured(self.policy)), _measured(self.policy), _set_points(self.policy)
        estimated = set(self.settings.velocities)
        if both := set(names) & set(controls):  # which recordings tell apart by a prefix
            names = tuple(f"sensor/{name}" if name in both else name for name in names)
            controls = {f"actuator/{name}" if name in both else name: unit for name, unit in controls.items()}
            units = dict(zip(names, units.values(), strict=True))
        signals = {name: log.observations[:, i] for i, name in enumerate(names) if name not in estimated}
        sent = np.isfinite(log.lateness)
        given, rows = np.flatnonzero(sent) * log.period + log.lateness[sent], log.targets[sent]
        if self.mode == "shadow":
            given, rows = log.times, driving.done(log) if len(log.times) else np.zeros((0, len(controls)))
        columns = {} if self.mode == "dry run" else dict(zip(controls, rows.T, strict=True))
        return Recording(log.times, signals, given if columns else np.zeros(0), columns, {**units, **controls})

    def report(self, log: Log) -> dict[str, Any]:
        """Why the episode ended, its timing and its limits."""
        return {
            "environment": self.policy.schema["environment"],
            "mode": self.mode,
            "stopped": log.stopped,
            "failed": log.failed,
            "ended": log.ended,
            "over": log.over,
            "controls": len(log.targets),
            "timing": recording.timing(log),
            "sensor_delays": self.delays,
            "faults": dict(log.faults),
            "limits": dataclasses.asdict(self.loop.limits),
            "settings": dataclasses.asdict(self.settings),
        }


def of(
    policy: Policy,
    settings: Settings,
    commands: Mapping[str, float] | None = None,
    mode: Mode = "control",
    duration: float | None = None,
    changes: Mapping[str, Any] | None = None,
) -> Session:
    """The session of a policy.

    Args:
        policy: policy of any kind.
        settings: settings of the robot.
        commands: values of the commands, by name.
        mode: see `Session`.
        duration: duration of the episode, in s; by default that of the training.
        changes: changes of the loop's attributes, such as its `rate` and `watchdog`.

    Raises:
        ValueError: for values that would loosen a limit, and settings of other signals or actuators.
    """
    given = dict(changes or {})
    if deployment.KEY in policy.schema:
        if commands or mode == "shadow":
            raise ValueError("policy: expected one that drives actuators for commands and shadow mode, got set-points")
        loop: Drive | Loop = Loop.of(policy, **({"watchdog": settings.watchdog or driving.WATCHDOG} | given))
    else:
        loop = Drive.of(policy, settings, commands, **given, follows=mode == "shadow")
    if duration is not None:
        loop = dataclasses.replace(loop, steps=max(round(duration * loop.rate), 1))
    return Session(policy, loop, settings, mode)


def _measured(policy: Policy) -> dict[str, str]:
    return dict(zip(policy.observed["names"], policy.observed["units"], strict=True))


def _set_points(policy: Policy) -> dict[str, str]:
    moved = deployment.of_schema(policy.schema).moved
    return {SET_POINT + name: _measured(policy)[name] for name in moved}
