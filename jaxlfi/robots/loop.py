"""The control loop: a policy controls a robot at a set rate, within limits, and the robot is stopped whatever happens.

Time is divided into control periods ("slots") that begin at multiples of the period after the first command, by a clock
that never goes back, so that delays do not add up. In each slot the loop observes, asks the policy, and commands.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from jaxlfi.rl import deployment
from jaxlfi.rl.deployment import Limits
from jaxlfi.rl.policy import Policy
from jaxlfi.robots.clock import Clock, Monotonic
from jaxlfi.robots.interrupts import Interrupts
from jaxlfi.robots.robot import Command, Observation, Robot, RobotError

Act = Callable[[np.ndarray], np.ndarray]
"""From an observation [O] to displacements of set-points [A], both in the units of the schema."""
TOLERANCE = 0.1
"""Part of a period by which a command may come late before its deadline counts as missed."""


@dataclasses.dataclass(frozen=True)
class Log:
    """What happened, of S slots and N observations that could be used.

    Attributes:
        times: when observations were made, in s since the first command, shape [N].
        observations: shape [N, O].
        extras: what else robots report, by name, shape [N, ...].
        asked: displacements that the policy asked for, NaN where it was not asked, shape [S, A].
        actions: displacements that were commanded, 0 where set-points were held, shape [S, A].
        targets: set-points that were commanded, shape [S, A].
        held: slots without an observation that could be used, shape [S].
        lateness: of each slot's command, in s; infinite where there was none, as the slot had passed, shape [S].
        faults: how many observations were "missing", "late" and "non-finite".
        over: slot at whose beginning the episode was over, or None.
        stopped: why the robot was stopped before its time; "" where it was not.
        period: between two commands, in s.
    """

    times: np.ndarray
    observations: np.ndarray
    extras: Mapping[str, np.ndarray]
    asked: np.ndarray
    actions: np.ndarray
    targets: np.ndarray
    held: np.ndarray
    lateness: np.ndarray
    faults: Mapping[str, int]
    over: int | None
    stopped: str
    period: float

    @property
    def missed(self) -> int:
        """Deadlines by which no command had been sent, a tenth of a period late at most."""
        return int(np.sum(self.lateness > TOLERANCE * self.period))


@dataclasses.dataclass(frozen=True)
class Loop:
    """How a robot is controlled.

    An observation is of no use if there is none that is new ("missing"), it is older than `max_age` ("late"), or has
    numbers that are not finite. Then the set-points are held. After more than `holds` such slots in a row the robot is
    stopped, and so it is if it is measured further than `margin` outside of the set-points' box.

    Attributes:
        limits: of the set-points.
        moved: places of the measured positions of the set-points in an observation, one an action.
        size: of an observation.
        rate: of commands, in Hz.
        steps: of an episode, in control periods.
        holds: slots in a row that set-points may be held for want of an observation.
        max_age: of an observation when it is asked for, in s; by default a control period.
        margin: by which a measured position may lie outside of the limits, in its unit.
        over: whether an observation ends the episode; from then on the set-points are held.
        clock: by which time passes.

    Raises:
        ValueError: for numbers that are not positive, and limits of another size.
    """

    limits: Limits
    moved: tuple[int, ...]
    size: int
    rate: float
    steps: int
    holds: int = 3
    max_age: float | None = None
    margin: float = 0.05
    over: Callable[[np.ndarray], bool] = lambda observation: False
    clock: Clock = dataclasses.field(default_factory=Monotonic)

    def __post_init__(self):
        for name in ("rate", "max_age", "margin"):
            value = getattr(self, name)
            if value is not None and not (value > 0 and (math.isfinite(value) or name == "margin")):
                raise ValueError(f"{name}: expected a positive number, got {value}")
        for name, least in (("steps", 1), ("holds", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: expected at least {least}, got {getattr(self, name)}")
        if len(self.limits.step) != len(self.moved):
            raise ValueError(f"limits: expected those of {len(self.moved)} set-points, got {len(self.limits.step)}")

    @staticmethod
    def of(policy: Policy, **changes: Any) -> "Loop":
        """As a policy was trained, by its schema, but for some changes.

        Raises:
            ValueError: for a policy that does not say how it was trained, and changes that make no loop.
        """
        facts, names = deployment.of_schema(policy.schema), list(policy.observed["names"])
        own = {
            "limits": facts.limits,
            "moved": tuple(names.index(name) for name in facts.moved),
            "size": len(names),
            "rate": 1 / facts.control_interval,
            "steps": facts.steps,
        }
        return Loop(**(own | changes))

    @property
    def period(self) -> float:
        """Between two commands, in s."""
        return 1 / self.rate

    def run(self, robot: Robot, act: Act, whole: bool = True, on_end: Callable[[Log], None] = lambda log: None) -> Log:
        """Control a robot for an episode, and stop it.

        Args:
            robot: whose `stop` is called exactly once, last, whatever happens.
            act: the policy.
            whole: go on to the last slot after the episode is over, with the set-points held.
            on_end: called after the stop with what happened so far, also where an error or a signal ended the episode.

        Raises:
            ValueError: for an observation or an action of another size, and actions that are not finite.
            RobotError: where no first observation comes, the robot does not start within the limits, or it fails.
            Interrupted: after SIGINT or SIGTERM.
        """
        with Interrupts() as interrupts:
            episode = _Episode(self, robot, act, interrupts)
            try:
                episode.run(whole)
            except BaseException as error:
                _stop_after(error, robot)
                raise
            else:
                robot.stop()
            finally:
                on_end(episode.log())
            return episode.log()


def _stop_after(error: BaseException, robot: Robot) -> None:
    try:
        robot.stop()
    except Exception as failed:
        raise RobotError(f"{error}; and stopping the robot failed: {failed}") from error


class _Episode:
    """An episode while it goes on."""

    def __init__(self, loop: Loop, robot: Robot, act: Act, interrupts: Interrupts):
        self.loop, self.robot, self.act, self.clock, self.interrupts = loop, robot, act, loop.clock, interrupts
        self.faults = {"missing": 0, "late": 0, "non-finite": 0}
        self.last: int | None = None  # number of the observation that was used last
        self.seen: list[tuple[float, np.ndarray, Mapping[str, Any]]] = []
        self.slots: list[tuple[np.ndarray, np.ndarray, np.ndarray, bool, float]] = []
        self.over: int | None = None
        self.stopped = ""

    def run(self, whole: bool) -> None:
        """From the first observation to the end."""
        loop, clock = self.loop, self.clock
        observation = self._first()
        target = self._target(observation)
        start = clock.now()
        sent, slot, unusable, fault = start - loop.period, 0, 0, None
        while True:
            if observation is not None:
                unusable, values = 0, observation.values
                self.seen.append((clock.now() - start - observation.age, values, observation.extras))
                if self.over is None and loop.over(values.copy()):
                    self.over = slot
                self.stopped = self._outside(values)
            else:
                unusable += 1
                if unusable > loop.holds:
                    self.stopped = f"{unusable} observations in a row could not be used, the last one was {fault}"
            if self.stopped or slot == loop.steps or (self.over is not None and not whole):
                return
            asking = observation is not None and self.over is None
            asked = self._asked(values) if asking else np.full(len(loop.moved), np.nan)
            self.interrupts.check()
            now = clock.now()
            seconds = min(loop.period, now - sent)
            displacement, target = loop.limits.applied(target, asked if asking else np.zeros(len(target)), seconds)
            with self.interrupts.calling():
                self.robot.act(Command(slot, displacement.copy(), target.copy()))
            sent = clock.now()  # so that the next command is no closer to this one than its length allows
            self.slots.append((asked, displacement, target, observation is None, now - start - slot * loop.period))
            self._wait_until(start + (slot + 1) * loop.period)
            slot = self._due(slot + 1, (clock.now() - start) / loop.period, target)
            observation, fault = self._look()

    def _wait_until(self, moment: float) -> None:
        with self.interrupts.waiting():
            self.clock.sleep_until(moment)

    def _first(self) -> Observation:
        """The first observation that can be used, for which the loop waits as long as it would hold."""
        start = self.clock.now()
        for wait in range(self.loop.holds + 1):
            self._wait_until(start + wait * self.loop.period)
            observation, fault = self._look()
            if observation is not None:
                return observation
        raise RobotError(
            f"robot: expected a usable observation to begin with, got none in {wait + 1} control periods, "
            f"the last one was {fault}"
        )

    def _target(self, observation: Observation) -> np.ndarray:
        """Where the set-points are before the first command."""
        limits = self.loop.limits
        reported = observation.target
        target = np.array(observation.values[list(self.loop.moved)] if reported is None else reported, float)
        if target.shape != (len(self.loop.moved),) or not np.isfinite(target).all():
            raise ValueError(f"robot: expected {len(self.loop.moved)} set-points, got {target.tolist()}")
        if (target < limits.low).any() or (target > limits.high).any():
            raise RobotError(
                f"robot: expected set-points between {list(limits.low)} and {list(limits.high)} to begin with, "
                f"got {target.tolist()}"
            )
        return target

    def _look(self) -> tuple[Observation | None, str]:
        """The latest observation if it can be used, and else what is wrong with it."""
        loop, fault = self.loop, ""
        with self.interrupts.calling():
            observation = self.robot.observe()
        if observation is None or (self.last is not None and observation.number <= self.last):
            fault = "missing"
        else:
            values = np.array(observation.values)  # a driver may measure into the same array again
            if values.shape != (loop.size,):
                raise ValueError(f"robot: expected observations of {loop.size} numbers, got shape {list(values.shape)}")
            if not observation.age <= (loop.period if loop.max_age is None else loop.max_age):  # NaN is late, too
                fault = "late"
            elif not np.isfinite(values).all():
                fault = "non-finite"
        if fault:
            self.faults[fault] += 1
            return None, fault
        shapes = {name: np.shape(value) for name, value in observation.extras.items()}
        if self.seen and shapes != (first := {name: np.shape(value) for name, value in self.seen[0][2].items()}):
            raise ValueError(f"robot: expected extras of shapes {first} as before, got {shapes}")
        self.last = observation.number
        extras = {name: np.array(value) for name, value in observation.extras.items()}
        return dataclasses.replace(observation, values=values, extras=extras), ""

    def _asked(self, values: np.ndarray) -> np.ndarray:
        with self.interrupts.calling():
            asked = np.array(self.act(values.copy()), float)
        if asked.shape != (len(self.loop.moved),) or not np.isfinite(asked).all():
            raise ValueError(f"policy: expected {len(self.loop.moved)} finite displacements, got {asked.tolist()}")
        return asked

    def _outside(self, values: np.ndarray) -> str:
        """Why the robot must be stopped where it has been measured; "" if it need not."""
        limits, at = self.loop.limits, values[list(self.loop.moved)]
        beyond = np.maximum(np.subtract(limits.low, at), np.subtract(at, limits.high)).max()
        if beyond > self.loop.margin:
            return f"it was measured at {np.round(at, 4).tolist()}, {beyond:.3g} outside of its limits"
        return ""

    def _due(self, following: int, periods: float, target: np.ndarray) -> int:
        """The slot that it is time for; those that have passed are missed: their commands are not made up for."""
        due = min(max(following, int(periods)), self.loop.steps)
        nothing = np.full(len(target), np.nan), np.zeros(len(target)), target, False, np.inf
        self.slots += [nothing] * (due - following)
        return due

    def log(self) -> Log:
        """What happened so far."""
        times, observations, extras = zip(*self.seen, strict=True) if self.seen else [()] * 3
        asked, actions, targets, held, lateness = zip(*self.slots, strict=True) if self.slots else [()] * 5
        table = lambda rows: np.reshape(np.array(rows, float), (len(rows), len(self.loop.moved)))
        return Log(
            times=np.array(times),
            observations=np.reshape(np.array(observations), (len(times), self.loop.size)),
            extras={
                name: np.stack([np.asarray(row[name]) for row in extras]) for name in (extras[0] if extras else ())
            },
            asked=table(asked),
            actions=table(actions),
            targets=table(targets),
            held=np.array(held, bool),
            lateness=np.array(lateness, float),
            faults=self.faults,
            over=self.over,
            stopped=self.stopped,
            period=self.loop.period,
        )
