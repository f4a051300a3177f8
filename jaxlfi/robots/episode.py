"""A control episode: at a fixed rate, within limits, with the robot stopped whatever happens.

Time is divided into control periods ("slots") that begin at multiples of the period after the first command, according
to a monotonic clock, so that delays do not add up. In each slot the loop observes, evaluates the policy, and sends a
command. How an action becomes a command depends on the kind of loop: `jaxlfi.robots.loop` displaces set-points,
`jaxlfi.robots.driving` drives actuators.
"""

import abc
import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from jaxlfi.robots.clock import Clock, Monotonic
from jaxlfi.robots.interrupts import Interrupts
from jaxlfi.robots.robot import Command, Observation, Robot, RobotError
from jaxlfi.robots.watchdog import Stop, Watchdog

Act = Callable[[np.ndarray], np.ndarray]
"""Function from an observation [O] to an action [A], both in the units of the schema."""
TOLERANCE = 0.1
"""Lateness of a command, as a fraction of the period, above which its deadline counts as missed."""


@dataclasses.dataclass(frozen=True)
class Log:
    """Record of an episode with S slots and N usable observations.

    Attributes:
        times: times of the observations, in s since the first command, shape [N].
        observations: usable observations, shape [N, O].
        extras: further data from the robot, by name, shape [N, ...].
        asked: actions of the policy, NaN where it was not evaluated, shape [S, A].
        actions: commanded displacements, 0 where set-points were held, shape [S, A].
        targets: commanded set-points, shape [S, A].
        held: whether a slot had no usable observation, shape [S].
        lateness: lateness of each slot's command, in s; infinite if there was none, as the slot had passed, shape [S].
        faults: numbers of observations that were "missing", "late" and "non-finite".
        over: slot at whose beginning the episode was over, or None.
        stopped: why the robot was stopped early; "" if it was not.
        period: time between two commands, in s.
        ages: age of the measurement behind each slot's command when it was sent, in s; NaN if there was none, shape
            [S].
        ended: which termination of the policy's training ended the episode; "" if none did.
        failed: whether an error or a signal stopped the robot, and not the loop.
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
    ages: np.ndarray
    ended: str = ""
    failed: bool = False

    @property
    def missed(self) -> int:
        """Number of deadlines missed by more than a tenth of a period."""
        return int(np.sum(self.lateness > TOLERANCE * self.period))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Paced(abc.ABC):
    """A control loop's periods, and its handling of unusable observations. Subclasses define what is commanded.

    An observation is unusable if there is no new one ("missing"), it is older than `max_age` ("late"), or a needed
    number is not finite. Then the set-points are held. After more than `holds` such slots in a row, the robot is
    stopped.

    Attributes:
        rate: control rate, in Hz.
        steps: length of an episode, in control periods.
        holds: largest number of consecutive slots in which set-points are held for want of an observation.
        max_age: largest age of an observation when it is requested, in s; by default a control period.
        over: whether an observation ends the episode; from then on the set-points are held.
        clock: clock of the loop.
        watchdog: time limit of a call of the robot or the policy, in s, after which the robot is stopped; by default
            none.

    Raises:
        ValueError: for numbers that are not positive.
    """

    rate: float
    steps: int
    holds: int = 3
    max_age: float | None = None
    over: Callable[[np.ndarray], bool] = lambda observation: False
    clock: Clock = dataclasses.field(default_factory=Monotonic)
    watchdog: float | None = None

    def __post_init__(self):
        for name in ("rate", "max_age", "watchdog"):
            if getattr(self, name) is not None:
                positive(name, getattr(self, name))
        for name, least in (("steps", 1), ("holds", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: expected at least {least}, got {getattr(self, name)}")

    @property
    @abc.abstractmethod
    def measured(self) -> int:
        """Number of measured values."""

    @property
    def needed(self) -> list[int]:
        """Indices of the numbers without which an observation is unusable; by default all."""
        return list(range(self.measured))

    @property
    @abc.abstractmethod
    def count(self) -> int:
        """Number of set-points, or of controls."""

    @property
    def answers(self) -> int:
        """Number of values in a policy's action: set-points or controls, and memory."""
        return self.count

    @abc.abstractmethod
    def begin(self, observation: Observation) -> Any:
        """The state before the first command: the set-points, and whatever else the loop keeps."""

    @abc.abstractmethod
    def observed(self, state: Any, observation: Observation) -> tuple[Any, np.ndarray]:
        """The state with a new measurement, and the policy's observation [O]."""

    @abc.abstractmethod
    def applied(self, state: Any, asked: np.ndarray | None, seconds: float) -> tuple[Any, np.ndarray]:
        """The state after an action, within all limits, and the displacement of the set-points [A].

        Args:
            state: state before the action.
            asked: the policy's action [A]; None if it was not evaluated, and the set-points are held.
            seconds: time since the previous command, in s, at most a control period.
        """

    @abc.abstractmethod
    def target(self, state: Any) -> np.ndarray:
        """The set-points in a state, shape [A]."""

    @abc.abstractmethod
    def outside(self, values: np.ndarray) -> str:
        """Why the robot must be stopped, given these measurements; "" if it need not."""

    def ended(self, values: np.ndarray) -> str:
        """Which termination ends the episode, given these measurements; "" if none does."""
        return ""

    @property
    def period(self) -> float:
        """Time between two commands, in s."""
        return 1 / self.rate

    def run(self, robot: Robot, act: Act, whole: bool = True, on_end: Callable[[Log], None] = lambda log: None) -> Log:
        """Control a robot for an episode, and stop it.

        Args:
            robot: robot whose `stop` is called exactly once, last, whatever happens; by the watchdog's thread if
                another call hangs.
            act: the policy.
            whole: continue to the last slot after the episode is over, with the set-points held.
            on_end: called after the stop with the log so far, also if an error or a signal ended the episode.

        Raises:
            ValueError: for an observation or an action of a wrong size, and actions that are not finite.
            RobotError: if no first observation comes, the robot does not start within the limits, it fails, or a call
                exceeds the watchdog's time limit.
            Interrupted: after SIGINT or SIGTERM.
        """
        stop = Stop(robot.stop)
        with Interrupts() as interrupts, Watchdog(self.watchdog, stop, self.clock, interrupts) as watchdog:
            episode = _Episode(self, robot, act, interrupts, watchdog)
            try:
                episode.run(whole)
            except BaseException as error:
                episode.stopped, episode.failed = str(error) or type(error).__name__, True
                _stop_after(error, stop)
                raise
            else:
                stop()
            finally:
                on_end(episode.log())
            return episode.log()


def positive(name: str, value: float, infinite: bool = False) -> None:
    """Refuse a number that is not positive.

    Raises:
        ValueError: naming it.
    """
    if not (value > 0 and (infinite or math.isfinite(value))):
        raise ValueError(f"{name}: expected a positive number, got {value}")


def _stop_after(error: BaseException, stop: Stop) -> None:
    try:
        stop()
    except Exception as failed:
        raise RobotError(f"{error}; and stopping the robot failed: {failed}") from error


class _Episode:
    """An episode in progress."""

    def __init__(self, loop: Paced, robot: Robot, act: Act, interrupts: Interrupts, watchdog: Watchdog):
        self.loop, self.robot, self.act, self.clock = loop, robot, act, loop.clock
        self.interrupts, self.watchdog = interrupts, watchdog
        self.faults = {"missing": 0, "late": 0, "non-finite": 0}
        self.last: int | None = None  # number of the observation that was used last
        self.behind: int | None = None  # number of one that came after it, but was made before it
        self.began_anew = ""
        self.seen: list[tuple[float, np.ndarray, Mapping[str, Any]]] = []
        self.slots: list[tuple[np.ndarray, np.ndarray, np.ndarray, bool, float, float]] = []
        self.over: int | None = None
        self.stopped = self.ended = ""
        self.failed = False

    def run(self, whole: bool) -> None:
        """Run from the first observation to the end."""
        loop, clock = self.loop, self.clock
        first = self._first()
        observation: Observation | None = first
        state = loop.begin(first)
        start = clock.now()
        sent, slot, unusable, fault = start - loop.period, 0, 0, None
        while True:
            if observation is not None:
                unusable, values = 0, observation.values
                self.seen.append((clock.now() - start - observation.age, values, observation.extras))
                if self.over is None and loop.over(values.copy()):
                    self.over = slot
                self.stopped, self.ended = loop.outside(values), loop.ended(values)
            else:
                unusable += 1
                if unusable > loop.holds:
                    self.stopped = f"{unusable} observations in a row could not be used, the last one was {fault}"
            if self.began_anew:
                self.stopped = self.began_anew
            if self.stopped or self.ended or slot == loop.steps or (self.over is not None and not whole):
                return
            asked = None
            if observation is not None and self.over is None:
                state, asked = self._asked(state, observation)
            self.interrupts.check()
            now = clock.now()
            seconds = min(loop.period, now - sent)
            state, displacement = loop.applied(state, asked, seconds)
            target = loop.target(state)
            with self.interrupts.calling(), self.watchdog.watching("act"):
                self.robot.act(Command(slot, displacement.copy(), target.copy()))
            sent = clock.now()  # so that the next command follows at least its length later
            asked = np.full(loop.count, np.nan) if asked is None else asked[: loop.count]
            age = np.nan if observation is None else now - start - self.seen[-1][0]
            self.slots.append((asked, displacement, target, observation is None, now - start - slot * loop.period, age))
            self._wait_until(start + (slot + 1) * loop.period)
            slot = self._due(slot + 1, (clock.now() - start) / loop.period, target)
            observation, fault = self._look()

    def _wait_until(self, moment: float) -> None:
        with self.interrupts.waiting(), self.watchdog.watching("waiting", max(moment - self.clock.now(), 0.0)):
            self.clock.sleep_until(moment)

    def _first(self) -> Observation:
        """The first usable observation, for which the loop waits as long as it would hold."""
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

    def _look(self) -> tuple[Observation | None, str]:
        """The latest observation if it is usable, or else its fault."""
        loop = self.loop
        with self.interrupts.calling(), self.watchdog.watching("observe"):
            observation = self.robot.observe()
        if observation is None:
            return self._unusable("missing")
        if self.last is not None and observation.number <= self.last:
            self._count(observation.number, self.last)
            return self._unusable("missing")
        values = np.array(observation.values)  # a driver may reuse the array
        if values.shape != ((size := loop.measured),):
            raise ValueError(f"robot: expected observations of {size} numbers, got shape {list(values.shape)}")
        if not observation.age <= (loop.period if loop.max_age is None else loop.max_age):  # NaN is late, too
            return self._unusable("late")
        if not np.isfinite(values[loop.needed]).all():
            return self._unusable("non-finite")
        shapes = {name: np.shape(value) for name, value in observation.extras.items()}
        if self.seen and shapes != (first := {name: np.shape(value) for name, value in self.seen[0][2].items()}):
            raise ValueError(f"robot: expected extras of shapes {first} as before, got {shapes}")
        self.last = observation.number
        extras = {name: np.array(value) for name, value in observation.extras.items()}
        return dataclasses.replace(observation, values=values, extras=extras), ""

    def _unusable(self, fault: str) -> tuple[None, str]:
        self.faults[fault] += 1
        return None, fault

    def _count(self, number: int, last: int) -> None:
        """Notice a robot whose count of measurements restarts: the robot was restarted and knows of no command."""
        if self.behind is not None and self.behind < number < last:
            self.began_anew = f"it began anew: its measurement {number} came after {last}"
        self.behind = number if number < last else None

    def _asked(self, state: Any, observation: Observation) -> tuple[Any, np.ndarray]:
        state, seen = self.loop.observed(state, observation)
        with self.interrupts.calling(), self.watchdog.watching("the policy"):
            asked = np.array(self.act(seen), float)
        if asked.shape != (self.loop.answers,) or not np.isfinite(asked).all():
            raise ValueError(f"policy: expected {self.loop.answers} finite actions, got {asked.tolist()}")
        return state, asked

    def _due(self, following: int, periods: float, target: np.ndarray) -> int:
        """The slot that is due; slots that have passed are missed, and their commands are not made up for."""
        due = min(max(following, int(periods)), self.loop.steps)
        nothing = np.full(len(target), np.nan), np.zeros(len(target)), target, False, np.inf, np.nan
        self.slots += [nothing] * (due - following)
        return due

    def log(self) -> Log:
        """The log so far."""
        times, observations, extras = zip(*self.seen, strict=True) if self.seen else [()] * 3
        asked, actions, targets, held, lateness, ages = zip(*self.slots, strict=True) if self.slots else [()] * 6
        table = lambda rows: np.reshape(np.array(rows, float), (len(rows), self.loop.count))
        return Log(
            times=np.array(times),
            observations=np.reshape(np.array(observations), (len(times), self.loop.measured)),
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
            ages=np.array(ages, float),
            ended=self.ended,
            failed=self.failed,
        )
