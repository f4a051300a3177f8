"""Preparation: the conversion between a robot's signals and controls and a policy's observations and actions.

An environment declares it as an attribute `preparation`, its episodes use it, and the training writes it into the
policy's schema, so that a robot runs the same code as the training. Its functions take `xp`, NumPy or `jax.numpy`; like
`jaxlfi.rl.policy`, this module needs NumPy only.

    memory = preparation.start(values)                            # once an episode, before its first observation
    memory, observation = preparation.observed(memory, values)    # each control interval
    memory, control = preparation.commanded(memory, policy(observation))

An observation [O] contains, in this order: the signals now, one control interval before and so on, `history` times; the
last `actions` controls, the latest first; the commands; and the policy's memory. At the start of an episode, earlier
signals and controls are set to the first ones, and the memory to zero. An action [A] contains a number for each
control, followed by the policy's next memory.
"""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple, get_args

import numpy as np
from jaxtyping import Float

from jaxlfi.rl.termination import Termination

KEY = "preparation"
"""Key of the preparation in a policy's schema."""
MOST_BEFORE = 100
"""Largest number of control intervals that a policy looks back."""
LARGEST = 1024
"""Largest number of values that a policy remembers."""


class Memory(NamedTuple):
    """The recent past of an episode, the latest first.

    Attributes:
        frames: signals as the policy sees them, F numbers per interval, shape [history, F].
        controls: commanded controls, shape [max(actions, 1), A].
        remembered: the policy's memory, shape [memory].
    """

    frames: Float[Any, "history frame"]
    controls: Float[Any, "before act"]
    remembered: Float[Any, " memory"] = np.zeros(0, np.float32)


@dataclasses.dataclass(frozen=True)
class Signal:
    """A quantity that a robot measures.

    Attributes:
        name: name of the signal.
        unit: unit of the measurement; "" if there is none, or it is not known.
        turning: whether it is an angle that is seen as cosine and sine instead of one number.

    Raises:
        ValueError: for values of wrong types.
    """

    name: str
    unit: str = ""
    turning: bool = False

    def __post_init__(self):
        _check_types(self)


@dataclasses.dataclass(frozen=True)
class Control:
    """The command to an actuator, in its own quantity, such as a torque, a target angle or a speed.

    Attributes:
        name: name of the actuator.
        low: smallest control.
        high: largest control.
        unit: unit of the control; "" if it is not known.
        rate: largest change per second; None if any change is allowed.
        displacing: whether an action is added to the last control instead of being the control.
        begins: index of the signal whose first value is the control before the first one; by default that control is 0,
            or the limit nearest to it.

    Raises:
        ValueError: for invalid limits and rates, and displacing actions without a rate, in one line.
    """

    name: str
    low: float
    high: float
    unit: str = ""
    rate: float | None = None
    displacing: bool = False
    begins: int | None = None

    def __post_init__(self):
        _check_types(self)
        _check_limits(self)
        if self.rate is not None and not 0 < self.rate < math.inf:
            raise ValueError(f"{self.name}: expected a rate of more than 0 per second, got {self.rate:g}")
        if self.displacing and self.rate is None:
            raise ValueError(f"{self.name}: expected a rate, which limits its displacement; got none")


@dataclasses.dataclass(frozen=True)
class Command:
    """A target that an operator sets and a policy observes; in training it is redrawn for each episode.

    Attributes:
        name: name of the command.
        low: smallest value in training.
        high: largest value in training.
        unit: unit of both.

    Raises:
        ValueError: for invalid limits.
    """

    name: str
    low: float
    high: float
    unit: str = ""

    def __post_init__(self):
        _check_types(self)
        _check_limits(self)


@dataclasses.dataclass(frozen=True)
class Preparation:
    """The conversion of S signals and C commands to O observations, and of A actions to A controls; see above.

    Attributes:
        signals: signals that the robot measures.
        controls: controls that it is given.
        interval: time between two controls, in s.
        steps: largest number of steps of an episode.
        history: number of intervals whose signals are seen; 1 for the current one only.
        actions: number of last controls that are seen.
        commands: commands that are also observed.
        observation_delay: smallest and largest age in training of a measurement when the policy acts on it, in s; a
            robot should match this, but it has no effect here.
        action_delay: likewise, the delay from an action to when the actuator receives it, in s.
        terminations: conditions that end an episode early, by name.
        memory: number of values from -1 to 1 that the policy remembers (`jaxlfi.rl.recurrent`).

    Raises:
        ValueError: for inconsistent values, in one line.

    Example:
        >>> arm = Preparation((Signal("angle", "rad"),), (Control("motor", -2.0, 3.0, "N m", rate=10.0),), 0.1, 50,
        ...                   history=2, actions=1)
        >>> arm.names
        ('angle', 'angle 1 before', 'control motor 1 before')
        >>> memory = arm.start([0.5])
        >>> memory, control = arm.commanded(memory, np.array([2.5]))
        >>> control.tolist(), arm.observed(memory, [0.75])[1].tolist()
        ([1.0], [0.75, 0.5, 1.0])
    """

    signals: tuple[Signal, ...]
    controls: tuple[Control, ...]
    interval: float
    steps: int
    history: int = 1
    actions: int = 0
    commands: tuple[Command, ...] = ()
    observation_delay: tuple[float, float] = (0.0, 0.0)
    action_delay: tuple[float, float] = (0.0, 0.0)
    terminations: Mapping[str, Termination] = dataclasses.field(default_factory=dict)
    memory: int = 0

    def __post_init__(self):
        counts = {"history": (1, MOST_BEFORE), "actions": (0, MOST_BEFORE), "memory": (0, LARGEST)}
        for name, (least, most) in (counts | {"steps": (1, math.inf)}).items():
            if type(number := getattr(self, name)) is not int or not least <= number <= most:
                raise ValueError(f"{name}: expected a whole number from {least} to {most}, got {number!r}")
        if not 0 < self.interval < math.inf:
            raise ValueError(f"interval: expected more than 0 s, got {self.interval:g}")
        for what in ("signals", "controls", "commands"):
            names = [one.name for one in getattr(self, what)]
            if len(set(names)) < len(names) or (not names and what != "commands"):
                raise ValueError(f"{what}: expected at least one, each once, got {names}")
        for what in ("observation_delay", "action_delay"):
            object.__setattr__(self, what, delay := tuple(getattr(self, what)))
            if len(delay) != 2 or not 0 <= delay[0] <= delay[1] < math.inf:
                raise ValueError(f"{what}: expected LOW up to HIGH of at least 0 s, got {list(delay)}")
        for one in self.controls:
            if one.begins is not None and not 0 <= one.begins < len(self.signals):
                raise ValueError(f"{one.name}: expected to begin at one of {len(self.signals)} signals")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the observations."""
        seen = [name for one in self.signals for name in _seen(one)]
        frames = [name + before(k) for k in range(self.history) for name in seen]
        controls = [f"control {one.name}{before(k + 1)}" for k in range(self.actions) for one in self.controls]
        return (*frames, *controls, *(f"command {one.name}" for one in self.commands), *self.remembered)

    @property
    def remembered(self) -> tuple[str, ...]:
        """Names of the remembered values."""
        return tuple(f"memory {k + 1}" for k in range(self.memory))

    @property
    def ranges(self) -> tuple[Float[np.ndarray, " act"], Float[np.ndarray, " act"]]:
        """Smallest and largest actions, in their units, without the memory."""
        step = lambda one: one.rate * self.interval
        low = [-step(one) if one.displacing else one.low for one in self.controls]
        return np.array(low), np.array([step(one) if one.displacing else one.high for one in self.controls])

    def start(self, values: Float[Any, " values"], xp: Any = np) -> Memory:
        """The memory at the start of an episode.

        Args:
            values: signals, followed by commands, shape [S + C].
            xp: NumPy, or `jax.numpy`.
        """
        rest = [min(max(0.0, one.low), one.high) for one in self.controls]
        first = [r if one.begins is None else values[one.begins] for r, one in zip(rest, self.controls, strict=True)]
        low, high, _ = self._limits
        control = xp.clip(xp.asarray(first), low, high)
        frames = xp.stack([self._frame(values, xp)] * self.history)
        return Memory(frames, xp.stack([control] * max(self.actions, 1)), xp.zeros(self.memory, frames.dtype))

    def observed(
        self, memory: Memory, values: Float[Any, " values"], xp: Any = np
    ) -> tuple[Memory, Float[Any, " obs"]]:
        """The memory with these signals, and the policy's observation; also for the first ones of an episode.

        Args:
            memory: memory of the episode.
            values: signals, followed by commands, shape [S + C].
            xp: NumPy, or `jax.numpy`.
        """
        frames = xp.concatenate([self._frame(values, xp)[None], memory.frames[:-1]])
        commands = xp.asarray(values)[len(self.signals) :]
        controls = memory.controls[: self.actions].ravel()
        seen = xp.concatenate([frames.ravel(), controls, commands, memory.remembered])
        return memory._replace(frames=frames), seen

    def commanded(self, memory: Memory, action: Float[Any, " act"], xp: Any = np) -> tuple[Memory, Float[Any, " act"]]:
        """The memory with the control of an action, and the control, within rates and limits.

        Args:
            memory: memory of the episode.
            action: action of the policy, in its units, shape [A], or [A + memory].
            xp: NumPy, or `jax.numpy`.
        """
        last, (low, high, most), count = memory.controls[0], self._limits, len(self.controls)
        wanted = xp.where(self._displacing, last + action[:count], action[:count])
        control = xp.clip(xp.clip(wanted, last - most, last + most), low, high)
        controls = xp.concatenate([control[None], memory.controls[:-1]])
        return Memory(memory.frames, controls, action[count:] if self.memory else memory.remembered), control

    @functools.cached_property
    def _limits(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Smallest and largest controls, and their largest change in an interval."""
        rates = [math.inf if one.rate is None else one.rate for one in self.controls]
        low, high = ([getattr(one, what) for one in self.controls] for what in ("low", "high"))
        return np.array(low), np.array(high), self.interval * np.array(rates)

    @functools.cached_property
    def _displacing(self) -> np.ndarray:
        return np.array([one.displacing for one in self.controls])

    @functools.cached_property
    def _parts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The signal of each number of a frame, and whether the number is its cosine or its sine."""
        parts = [(k, which) for k, one in enumerate(self.signals) for which in (("cos", "sin") if one.turning else "=")]
        whiches = np.array([which for _, which in parts])
        return np.array([k for k, _ in parts]), whiches == "cos", whiches == "sin"

    def _frame(self, values: Float[Any, " values"], xp: Any) -> Float[Any, " frame"]:
        """The signals at one time, as the policy sees them."""
        places, cosine, sine = self._parts
        numbers = xp.asarray(values)[places]
        return xp.where(cosine, xp.cos(numbers), xp.where(sine, xp.sin(numbers), numbers))


def of_schema(schema: Mapping[str, Any]) -> Preparation | None:
    """The preparation in a policy's schema; None for policies that have none.

    Raises:
        ValueError: for one that is incomplete, or for other observations or actions than the policy's.
    """
    found = schema.get(KEY)
    if found is None:
        return None
    parts = {"signals": Signal, "controls": Control, "commands": Command}
    try:
        made = {what: tuple(kind(**one) for one in found.get(what, ())) for what, kind in parts.items()}
        ends = {name: Termination(**one) for name, one in found.get("terminations", {}).items()}
        preparation = Preparation(**{**found, **made, "terminations": ends})
    except (TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"policy: expected a preparation in its schema, got one that is not whole: {error}") from error
    acted = (*(one.name for one in preparation.controls), *preparation.remembered)
    names = {"observations": preparation.names, "actions": acted}
    for what, own in names.items():
        if own != (got := tuple(schema[what]["names"])):
            raise ValueError(f"policy: expected a preparation of its {what} {list(got)}, got one of {list(own)}")
    return preparation


def _check_types(one: Any) -> None:
    """Refuse values of other types than a dataclass declares; integers are accepted as floats."""
    for field in dataclasses.fields(one):
        value, kinds = getattr(one, field.name), get_args(field.type) or (field.type,)
        kinds = (*kinds, int) if float in kinds else kinds
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            raise ValueError(f"{field.name}: expected {kinds[0].__name__}, got {value!r}")


def _check_limits(one: Control | Command) -> None:
    if not -math.inf < one.low < one.high < math.inf:
        raise ValueError(f"{one.name}: expected finite limits, LOW below HIGH, got {[one.low, one.high]}")


def _seen(signal: Signal) -> list[str]:
    return [f"cos {signal.name}", f"sin {signal.name}"] if signal.turning else [signal.name]


def before(intervals: int) -> str:
    """Suffix of a signal's name for its value so many control intervals ago."""
    return f" {intervals} before" if intervals else ""
