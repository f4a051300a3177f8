"""The goal of a policy: what it sees and does, what it is rewarded for, and when an episode ends.

[policy]
interval = 0.02                     # s between two controls
duration = 4.0                      # s of an episode
observed = ["arm angle", "joint/arm/qvel"]      # sensors, and joints and bodies as under `measured`
scales = { "joint/arm/qvel" = 5.0 } # a large value of the signal; 1 by default
limits = { motor = [-0.05, 0.05] }  # of the actuators; by default their ctrlrange

[policy.initial]                    # drawn uniformly for each episode; else as for inference
"arm/qpos" = [-1.0, 1.0]

The reward of a control interval is its length times the sum of these terms, per second, at its end:

[policy.targets."arm angle"]        # - weight times the squared difference
value = 0.0
weight = 1.0                        # cost per second of a difference of 1; half the difference costs a quarter

[policy.targets."joint/arm/qvel"]   # + weight times exp(-(difference / within)^2)
command = "speed"                   # instead of a value: the commanded one
weight = 2.0                        # the most that a second can gain
within = 0.5                        # a difference this large gains 1/e of it

[policy]
costs = { motor = 0.02 }            # - for a control at its limit; half as large a control costs a quarter
change_costs = { motor = 0.1 }      # - for a control that has changed by half its range since the last interval
alive = 0.5                         # + for every second that the episode continues

[policy.commands]                   # drawn uniformly for each episode; a policy sees them
speed = [-1.0, 2.0]

[policy.terminations]               # besides the duration; `jaxlfi.rl.termination`
fallen = { when = "body/torso/pos[2] < 0.2", cost = 10.0 }      # - at the step that ends the episode
away = "abs(arm angle) > 2.5"       # at no cost

With costs only, ending an episode early pays, unless the end costs more than the rest of the episode would; `within`
and `alive` reward an episode that continues.

Positions of hinges without a range are angles: a policy sees their cosine and sine, and a difference d from a target
costs 2 (1 - cos d), which is d squared while it is small. Conditions compare them as numbers, full turns included.

What else a policy observes and does (`jaxlfi.rl.preparation`):

[policy]
turns = ["winch angle"]             # angles whose turns count: observed, and charged, as numbers
history = 3                         # observed readings of each signal: now, one and two control intervals ago
actions = 2                         # how many of the last controls are observed
memory = "gru"                      # remember `memory_size` numbers from step to step, 32 by default
rates = { motor = 0.5 }             # of a control, its largest change per second
displacing = ["motor"]              # actions are added to the last control, by as much as the rate allows, at most

Disturbances in training, in addition to the noise of `[noise]`:

[policy]
action_delay = 0.01                 # s until an action reaches the actuators, in addition to an inferred control/delay
observation_delay = [0.0, 0.02]     # s, the age of a measurement when the policy acts on it; drawn for each episode,
                                    # and in addition to an inferred sensor/NAME/delay
noises = { "joint/arm/qvel" = 0.1 } # standard deviations of signals that `[noise]` does not have
bias = 0.5                          # offset of a signal, drawn for each episode, as a fraction of its noise
model_error = true                  # `unmodelled_force`, `[discrepancy]` and the noise of recordings, as in inference
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from jaxtyping import Array

from jaxlfi.envs.mujoco import config as tables
from jaxlfi.envs.mujoco.parameters import near
from jaxlfi.rl import termination
from jaxlfi.rl.preparation import LARGEST, MOST_BEFORE
from jaxlfi.rl.termination import Termination

NEEDED = ("interval", "duration", "observed")
BOUNDS = ("limits", "initial", "commands")
NUMBERS = ("scales", "costs", "change_costs", "rates", "noises")
SINGLE = ("alive", "bias")
DELAYS = ("action_delay", "observation_delay")
MODEL_ERROR = "model_error"
NAMES = {"observed": "signals", "turns": "signals", "displacing": "actuators"}
COUNTS = {"history": 1, "actions": 0}
"""Smallest value of each."""
MEMORY, SIZE, UNITS, USUAL = "memory", "memory_size", ("none", "gru"), 32
"""The memory of policies: the table's keys, kinds of units, and the default number of values."""
KEYS = (
    *NEEDED,
    *BOUNDS,
    *NUMBERS,
    "targets",
    "terminations",
    *SINGLE,
    "turns",
    "displacing",
    *COUNTS,
    *DELAYS,
    MODEL_ERROR,
    MEMORY,
    SIZE,
)
RESERVED = ("return", "value", "steps", "theta", "length", "episodes", "seconds", "failed")
"""Names under which records of episodes have something other than a termination."""
Reward = Callable[[Mapping[str, Array], Mapping[str, Array]], Array]
"""From signals and controls by name, each one number, to the reward of a control interval."""


class Target(NamedTuple):
    """What a signal should be; see above.

    Attributes:
        value: in the signal's unit, or the name of a command.
        weight: per second.
        within: difference at which the reward is 1/e of the weight; None if differences cost.
    """

    value: float | str
    weight: float = 1.0
    within: float | None = None


@dataclasses.dataclass(frozen=True)
class Goal:
    """The goal of a policy; see above.

    Attributes:
        observed: signals that a policy sees.
        interval: between two controls, in s.
        duration: of an episode, in s.
        targets: by signal; a pair of value and weight will do.
        costs: by actuator.
        limits: by actuator.
        scales: by signal.
        initial: bounds by JOINT/qpos and JOINT/qvel.
        reward: a JAX function in place of targets and costs; commands are among the signals, as "command NAME".
        turns: angles whose full turns count.
        history: number of readings of each signal that are seen.
        actions: number of past controls that are seen.
        rates: largest change per second, by actuator.
        displacing: actuators whose actions are added to the last control.
        change_costs: by actuator.
        alive: reward per second while the episode continues.
        commands: bounds by name.
        terminations: by name.
        action_delay: smallest and largest one, in s.
        observation_delay: likewise.
        noises: standard deviations, by signal.
        bias: standard deviation of offsets, as a fraction of those of the noise.
        memory: number of values that a policy remembers (`jaxlfi.rl.recurrent`).

    Raises:
        ValueError: for invalid numbers, and a goal without a reward.
    """

    observed: Sequence[str]
    interval: float
    duration: float
    targets: Mapping[str, Target | tuple[float, float]] = dataclasses.field(default_factory=dict)
    costs: Mapping[str, float] = dataclasses.field(default_factory=dict)
    limits: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    scales: Mapping[str, float] = dataclasses.field(default_factory=dict)
    initial: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    reward: Reward | None = None
    turns: Sequence[str] = ()
    history: int = 1
    actions: int = 0
    rates: Mapping[str, float] = dataclasses.field(default_factory=dict)
    displacing: Sequence[str] = ()
    change_costs: Mapping[str, float] = dataclasses.field(default_factory=dict)
    alive: float = 0.0
    commands: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    terminations: Mapping[str, Termination] = dataclasses.field(default_factory=dict)
    action_delay: tuple[float, float] = (0.0, 0.0)
    observation_delay: tuple[float, float] = (0.0, 0.0)
    noises: Mapping[str, float] = dataclasses.field(default_factory=dict)
    bias: float = 0.0
    memory: int = 0

    def __post_init__(self):
        object.__setattr__(self, "targets", self.aims)
        if not self.observed or len(set(self.observed)) < len(self.observed):
            raise ValueError(f"observed: expected at least one signal, each once, got {list(self.observed)}")
        if not 0 < self.interval <= self.duration < math.inf:
            raise ValueError(
                f"interval: expected more than 0 s and at most the duration, got {self.interval:g} s "
                f"and {self.duration:g} s"
            )
        if not self.targets and self.reward is None and not self.alive:
            raise ValueError("targets: expected at least one, or a reward; got none")
        self._check_rewards()
        for name, (low, high) in self.initial.items():
            if not -math.inf < low <= high < math.inf:
                raise ValueError(f"initial: {name}: expected LOW up to HIGH, got {[low, high]}")
        for what in ("scales", "noises"):
            if unknown := [name for name in getattr(self, what) if name not in self.observed]:
                raise ValueError(f"{what}: expected signals that are observed, got {', '.join(unknown)}")
        for what, deviation in (
            {f"noises: {name}": one for name, one in self.noises.items()} | {"bias": self.bias}
        ).items():
            if not 0 <= deviation < math.inf:
                raise ValueError(f"{what}: expected a standard deviation of at least 0, got {deviation:g}")
        for name, scale in self.scales.items():
            if not 0 < scale < math.inf:
                raise ValueError(f"scales: {name}: expected more than 0, got {scale:g}")
        for what in DELAYS:
            low, high = getattr(self, what)
            if not 0 <= low <= high <= self.duration:
                raise ValueError(f"{what}: expected 0 s up to the duration, LOW up to HIGH, got {[low, high]}")
        for name in self.terminations:
            if name in RESERVED or name.endswith(" off"):
                raise ValueError(f"terminations: expected a name that has no other meaning, got {name!r}")

    def _check_rewards(self) -> None:
        weights = {f"targets: {name}": one.weight for name, one in self.aims.items()}
        weights |= {f"costs: {name}": cost for name, cost in self.costs.items()}
        weights |= {f"change_costs: {name}": cost for name, cost in self.change_costs.items()}
        for name, number in weights.items():
            if not 0 <= number < math.inf:
                raise ValueError(f"{name}: expected a weight of at least 0, got {number:g}")
        if not math.isfinite(self.alive):
            raise ValueError(f"alive: expected a finite number, got {self.alive:g}")
        for name, (low, high) in self.commands.items():
            if not -math.inf < low < high < math.inf:
                raise ValueError(f"commands: {name}: expected LOW below HIGH, got {[low, high]}")
        for name, one in self.aims.items():
            if isinstance(one.value, str) and one.value not in self.commands:
                known = near(one.value, [*self.commands])
                raise ValueError(f"targets: {name}: expected a command {known}, got {one.value!r}")
            if not isinstance(one.value, str) and not math.isfinite(one.value):
                raise ValueError(f"targets: {name}: expected a finite value, got {one.value:g}")
            if one.within is not None and not 0 < one.within < math.inf:
                raise ValueError(f"targets: {name}: within: expected more than 0, got {one.within:g}")
        followed = [one.value for one in self.aims.values()]
        if self.reward is None and (idle := [name for name in self.commands if name not in followed]):
            raise ValueError(f"commands: expected each to be a target of a signal, got no target of {', '.join(idle)}")

    @property
    def aims(self) -> dict[str, Target]:
        """The targets, in full."""
        return {name: Target(*one) for name, one in self.targets.items()}

    @property
    def steps(self) -> int:
        """Number of controls in an episode."""
        return round(self.duration / self.interval)

    @property
    def signals(self) -> tuple[str, ...]:
        """The observed signals, and further ones that have a target or end episodes."""
        further = (*self.targets, *(one.signal for one in self.terminations.values()))
        return tuple(dict.fromkeys((*self.observed, *further)))


def of_table(table: Mapping[str, Any]) -> Goal:
    """The goal that the table `policy` of a file describes.

    Raises:
        ValueError: for unknown keys, and invalid values.
    """
    if unknown := [key for key in table if key not in KEYS]:
        raise ValueError(f"policy: expected keys among {', '.join(KEYS)}, got {', '.join(unknown)}")
    if missing := [key for key in NEEDED if key not in table]:
        raise ValueError(f"policy: expected {', '.join(missing)}, got none")
    for key, what in NAMES.items():
        if not isinstance(table.get(key, []), list) or not all(isinstance(one, str) for one in table.get(key, [])):
            raise ValueError(f"policy: {key}: expected names of {what}, got {table[key]!r}")
    for key, least in COUNTS.items():
        if type(number := table.get(key, least)) is not int or not least <= number <= MOST_BEFORE:
            raise ValueError(f"policy: {key}: expected a whole number from {least} to {MOST_BEFORE}, got {number!r}")
    for key in (*BOUNDS, "targets", "terminations"):
        if not isinstance(table.get(key, {}), dict):
            raise ValueError(f"policy: {key}: expected a table, got {table[key]!r}")
    made: dict[str, Any] = {key: tables.number(table[key], f"policy: {key}") for key in ("interval", "duration")}
    made |= {key: tuple(table[key]) for key in NAMES if key in table} | {
        key: table[key] for key in COUNTS if key in table
    }
    made |= {key: tables.number(table.get(key, 0.0), f"policy: {key}") for key in SINGLE}
    made |= {key: _range(table.get(key, 0.0), f"policy: {key}") for key in DELAYS}
    made["memory"] = _memory(table)
    made["targets"] = {name: _target(name, one) for name, one in table.get("targets", {}).items()}
    made["terminations"] = {name: _termination(name, one) for name, one in table.get("terminations", {}).items()}
    for key in BOUNDS:
        made[key] = {name: tables.pair(value, f"policy: {key}: {name}") for name, value in table.get(key, {}).items()}
    try:
        return Goal(**made, **{key: tables.numbers(table, key) for key in NUMBERS})
    except ValueError as error:
        raise ValueError(f"policy: {error}") from error


def _memory(table: Mapping[str, Any]) -> int:
    """Number of values that a policy remembers."""
    if (kind := table.get(MEMORY, UNITS[0])) not in UNITS:
        raise ValueError(f"policy: {MEMORY}: expected {' or '.join(UNITS)}, got {kind!r}")
    size = table.get(SIZE, USUAL)
    if type(size) is not int or not 1 <= size <= LARGEST or (SIZE in table and kind == UNITS[0]):
        raise ValueError(f'policy: {SIZE}: expected 1 to {LARGEST}, beside {MEMORY} = "gru"; got {size!r}')
    return 0 if kind == UNITS[0] else size


def _range(value: Any, where: str) -> tuple[float, float]:
    """Two bounds, or one number for both."""
    return tables.pair(value if isinstance(value, list) else [value, value], where)


def _target(name: str, table: Any) -> Target:
    where = f"policy: targets: {name}"
    known = {"value", "command", "weight", "within"}
    if not isinstance(table, dict) or set(table) - known or ("value" in table) == ("command" in table):
        raise ValueError(f"{where}: expected keys value or command, and optionally weight and within, got {table!r}")
    if not isinstance(command := table.get("command", ""), str):
        raise ValueError(f"{where}: command: expected the name of a command, got {command!r}")
    number = lambda key, other: tables.number(table[key], f"{where}: {key}") if key in table else other
    return Target(number("value", command), number("weight", 1.0), number("within", None))


def _termination(name: str, given: Any) -> Termination:
    where = f"policy: terminations: {name}"
    table = {"when": given} if isinstance(given, str) else given
    if not isinstance(table, dict) or set(table) - {"when", "cost"} or not isinstance(table.get("when"), str):
        raise ValueError(f'{where}: expected {{ when = "SIGNAL < NUMBER", cost = NUMBER }}, got {given!r}')
    cost = tables.number(table.get("cost", 0.0), f"{where}: cost")
    try:
        return termination.parsed(table["when"], cost)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
