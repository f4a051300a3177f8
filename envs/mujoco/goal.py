"""The goal of a policy: the signals it sees, their targets, and the cost of its controls.

[policy]
interval = 0.02                     # s between two controls
duration = 4.0                      # s of an episode
observed = ["arm angle", "joint/arm/qvel"]      # sensors, and joints and bodies as under `measured`
scales = { "joint/arm/qvel" = 5.0 } # what is a large number of a signal; 1 by default
limits = { motor = [-0.05, 0.05] }  # of the actuators; by default their ctrlrange
costs = { motor = 0.02 }            # of a control at its limit for a second; half as large ones cost a quarter

[policy.targets."arm angle"]
value = 0.0
weight = 1.0                        # what a difference of 1 costs a second; of half that, a quarter

[policy.initial]                    # drawn anew for each episode, uniformly; else as for inference
"arm/qpos" = [-1.0, 1.0]

Positions of hinges without a range are angles: a policy sees their cosine and sine, and a difference d from a target
costs 2 (1 - cos d), which is d squared while it is small.

What a policy sees and does besides (`jaxlfi.rl.preparation`):

turns = ["winch angle"]             # angles of which turns count: they are seen, and cost, as numbers
history = 3                         # how many times signals are seen: now, one control interval before, two before
actions = 2                         # how many of the last controls are seen
rates = { motor = 0.5 }             # of a control, its largest change per second
displacing = ["motor"]              # actions are added to the last control, by as much as the rate allows, at most
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from jaxlfi.envs.mujoco import config as tables
from jaxlfi.envs.mujoco import measured
from jaxlfi.envs.mujoco.columns import require_one_control_each
from jaxlfi.rl.environment import Signals
from jaxlfi.rl.preparation import Control, Preparation, Signal

KEYS = ("interval", "duration", "observed", "scales", "limits", "costs", "targets", "initial")
PREPARED = ("turns", "history", "actions", "rates", "displacing")
"""Further keys, of what a policy sees and does (`jaxlfi.rl.preparation`)."""
Reward = Callable[[Mapping[str, Array], Mapping[str, Array]], Array]
"""From signals and controls by name, each one number, to the reward of a control interval."""
MOST_BEFORE = 100
"""Control intervals that a policy looks back, at most."""
_JOINTS = {
    int(mujoco.mjtSensor.mjSENS_JOINTPOS): ("rad", "m"),
    int(mujoco.mjtSensor.mjSENS_JOINTVEL): ("rad/s", "m/s"),
}
"""Units of sensors of hinges and slides."""


@dataclasses.dataclass(frozen=True)
class Goal:
    """The goal of a policy; see above.

    Attributes:
        observed: signals that a policy sees.
        interval: between two controls, in s.
        duration: of an episode, in s.
        targets: value and weight by signal.
        costs: by actuator.
        limits: by actuator.
        scales: by signal.
        initial: bounds by JOINT/qpos and JOINT/qvel.
        reward: in place of targets and costs, in JAX.
        turns: signals that are angles of which turns count.
        history: how many times signals are seen.
        actions: how many of the last controls are seen.
        rates: largest change per second, by actuator.
        displacing: actuators whose actions are added to the last control.

    Raises:
        ValueError: for intervals and weights that are not positive, and a goal without a target or a reward.
    """

    observed: Sequence[str]
    interval: float
    duration: float
    targets: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
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

    def __post_init__(self):
        if not self.observed or len(set(self.observed)) < len(self.observed):
            raise ValueError(f"observed: expected at least one signal, each once, got {list(self.observed)}")
        if not 0 < self.interval <= self.duration:
            raise ValueError(
                f"interval: expected one of more than 0 s, and at most the duration, got {self.interval:g} s "
                f"and {self.duration:g} s"
            )
        if not self.targets and self.reward is None:
            raise ValueError("targets: expected at least one, or a reward; got none")
        weights = {f"targets: {name}": weight for name, (_, weight) in self.targets.items()}
        costs = {f"costs: {name}": cost for name, cost in self.costs.items()}
        for name, number in (weights | costs).items():
            if not number >= 0:
                raise ValueError(f"{name}: expected a weight of at least 0, got {number:g}")
        for name, (low, high) in self.initial.items():
            if not low <= high:
                raise ValueError(f"initial: {name}: expected LOW up to HIGH, got {[low, high]}")
        if unknown := [name for name in self.scales if name not in self.observed]:
            raise ValueError(f"scales: expected signals that are observed, got {', '.join(unknown)}")

    @property
    def steps(self) -> int:
        """Controls in an episode."""
        return round(self.duration / self.interval)

    @property
    def signals(self) -> tuple[str, ...]:
        """The observed signals, and further ones that have a target."""
        return (*self.observed, *(name for name in self.targets if name not in self.observed))


def of_table(table: Mapping[str, Any]) -> Goal:
    """The goal that the table `policy` of a file describes.

    Raises:
        ValueError: for other keys, and values that are no such numbers.
    """
    if unknown := [key for key in table if key not in (*KEYS, *PREPARED)]:
        raise ValueError(f"policy: expected keys among {', '.join((*KEYS, *PREPARED))}, got {', '.join(unknown)}")
    if missing := [key for key in ("interval", "duration", "observed", "targets") if key not in table]:
        raise ValueError(f"policy: expected {', '.join(missing)}, got none")
    named = {"observed": "signals", "turns": "signals", "displacing": "actuators"}
    for key, what in named.items():
        if not isinstance(table.get(key, []), list) or not all(isinstance(one, str) for one in table.get(key, [])):
            raise ValueError(f"policy: {key}: expected names of {what}, got {table[key]!r}")
    for key, least in (("history", 1), ("actions", 0)):
        if type(number := table.get(key, least)) is not int or not least <= number <= MOST_BEFORE:
            raise ValueError(f"policy: {key}: expected a whole number from {least} to {MOST_BEFORE}, got {number!r}")
    for key in ("targets", "limits", "initial"):
        if not isinstance(table.get(key, {}), dict):
            raise ValueError(f"policy: {key}: expected a table, got {table[key]!r}")
    targets = {}
    for name, target in table["targets"].items():
        if not isinstance(target, dict) or set(target) - {"value", "weight"} or "value" not in target:
            raise ValueError(f"policy: targets: {name}: expected value and weight, got {target!r}")
        where = f"policy: targets: {name}"
        targets[name] = tuple(tables.number(target.get(key, 1.0), f"{where}: {key}") for key in ("value", "weight"))
    bounds = {
        key: {name: tables.pair(value, f"policy: {key}: {name}") for name, value in table.get(key, {}).items()}
        for key in ("limits", "initial")
    }
    plain = {key: tables.numbers(table, key) for key in ("costs", "scales", "rates")}
    plain |= {key: table[key] for key in ("turns", "history", "actions", "displacing") if key in table}
    times = {key: tables.number(table[key], f"policy: {key}") for key in ("interval", "duration")}
    try:
        return Goal(tuple(table["observed"]), targets=targets, **times, **bounds, **plain)
    except ValueError as error:
        raise ValueError(f"policy: {error}") from error


class Reading:
    """A goal in terms of a model's sensors and actuators. Works on JAX's arrays and on NumPy's.

    Attributes:
        goal: what is read for.
        places: of its signals among the sensor data, S of them; the observed ones come first.
        preparation: from these and controls to what a policy observes and does.
        observations: of a policy.
        actions: of a policy: the controls, or their displacements.
    """

    def __init__(self, model: mujoco.MjModel, goal: Goal):
        """Look up signals and actuators.

        Args:
            model: with a sensor for each signal.
            goal: of the policy.

        Raises:
            ValueError: for names that the model does not have, and actuators without limits, in one line.
        """
        self.goal = goal
        self.places = np.asarray(measured.places(model, goal.signals))
        owners = [_owner(model, place) for place in self.places]
        for name in goal.turns:
            if name not in goal.signals or not owners[goal.signals.index(name)].turning:
                angles = [one for one, owner in zip(goal.signals, owners, strict=True) if owner.turning]
                raise ValueError(
                    f"policy: turns: expected positions of hinges without a range ({', '.join(angles) or 'none'}), "
                    f"got {name}"
                )
        self._turning = [one.turning and name not in goal.turns for name, one in zip(goal.signals, owners, strict=True)]
        require_one_control_each(model)
        self._actuators = [model.actuator(i).name or f"actuator/{i}" for i in range(model.nu)]
        if not self._actuators:
            raise ValueError("policy: expected a model with actuators, got one without")
        for key in ("limits", "costs", "rates", "displacing"):
            if unknown := [name for name in getattr(goal, key) if name not in self._actuators]:
                raise ValueError(
                    f"policy: {key}: expected actuators of the model ({', '.join(self._actuators)}), "
                    f"got {', '.join(unknown)}"
                )
        self.preparation = self._prepared(model, owners)
        controls = self.preparation.controls
        self._centre, self._scale = (np.array([sign * one.low + one.high for one in controls]) / 2 for sign in (1, -1))
        self.observations, self.actions = self._signals(owners)

    def _prepared(self, model: mujoco.MjModel, owners: Sequence["_Owner"]) -> Preparation:
        goal, count = self.goal, len(self.goal.observed)
        units = [measured.unit(model, name) for name in goal.observed]
        signals = tuple(Signal(*one) for one in zip(goal.observed, units, self._turning[:count], strict=True))
        joints = [one.joint for one in owners[:count]]
        controls = []
        for i, name in enumerate(self._actuators):
            low, high = _limits(model, i, name, goal)
            rate, displacing = goal.rates.get(name), name in goal.displacing
            begins = None if rate is None else _begins(model, i, name, joints)
            try:
                controls.append(Control(name, low, high, _control_unit(model, i), rate, displacing, begins))
            except ValueError as error:
                raise ValueError(f"policy: {'displacing' if rate is None else 'rates'}: {error}") from error
        return Preparation(signals, tuple(controls), goal.interval, goal.steps, goal.history, goal.actions)

    def _signals(self, owners: Sequence["_Owner"]) -> tuple[Signals, Signals]:
        """Observations and actions as the policy scales them."""
        goal, prepared = self.goal, self.preparation
        frame: list[tuple[str, float, float]] = []
        for name, owner, turning in zip(goal.observed, owners, self._turning, strict=False):
            frame += [("", 0.0, 1.0)] * 2 if turning else [(owner.unit, 0.0, goal.scales.get(name, 1.0))]
        controls = [("", *one) for one in zip(self._centre.tolist(), self._scale.tolist(), strict=True)]
        units, centres, scales = zip(*frame * goal.history, *controls * goal.actions, strict=True)
        low, high = prepared.ranges
        centre, scale = (low + high) / 2, (high - low) / 2
        blank = ("",) * len(self._actuators)
        return (
            Signals(prepared.names, units, centres, scales),
            Signals(tuple(self._actuators), blank, tuple(centre.tolist()), tuple(scale.tolist())),
        )

    def reward(self, values: Float[Array | np.ndarray, " signals"], control: Float[Array | np.ndarray, " act"], xp=jnp):
        """The reward of a control interval, at whose end signals have these values."""
        goal = self.goal
        if goal.reward is not None:
            signals = {name: values[place] for place, name in enumerate(goal.signals)}
            return goal.reward(signals, {name: control[i] for i, name in enumerate(self._actuators)})
        cost = 0.0
        for name, off in self.off(values, xp).items():
            turning = self._turning[goal.signals.index(name)]
            cost += goal.targets[name][1] * (2 * (1 - xp.cos(off)) if turning else off**2)
        for i, name in enumerate(self._actuators):
            fraction = (control[i] - self._centre[i]) / self._scale[i]
            cost += goal.costs.get(name, 0.0) * fraction**2
        return -goal.interval * cost

    def off(self, values: Float[Array | np.ndarray, " signals"], xp: Any = jnp) -> dict[str, Any]:
        """Distances of signals from their targets; for angles, the shorter way round."""
        found = {}
        for name, (target, _) in self.goal.targets.items():
            place = self.goal.signals.index(name)
            difference = values[place] - target
            turning = self._turning[place]
            found[name] = xp.arctan2(xp.sin(difference), xp.cos(difference)) if turning else difference
        return found


class _Owner(NamedTuple):
    """What a number of the sensor data is of a joint.

    Attributes:
        unit: "" of what is no joint's.
        turning: whether it is an angle without a range.
        joint: whose position it is; -1 where it is none's.
    """

    unit: str
    turning: bool
    joint: int


def _owner(model: mujoco.MjModel, place: int) -> _Owner:
    sensor = int(np.searchsorted(model.sensor_adr, place, side="right") - 1)
    kind, joint = int(model.sensor_type[sensor]), int(model.sensor_objid[sensor])
    if kind not in _JOINTS:
        return _Owner("", False, -1)
    hinge = bool(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE)
    position = kind == int(mujoco.mjtSensor.mjSENS_JOINTPOS)
    turning = hinge and position and not model.jnt_limited[joint]
    return _Owner(_JOINTS[kind][0 if hinge else 1], turning, joint if position else -1)


def _begins(model: mujoco.MjModel, i: int, name: str, joints: Sequence[int]) -> int | None:
    """The place of the signal that a control begins at: a servo's target is where its joint is.

    Raises:
        ValueError: where the policy does not see it.
    """
    if measured.control_units(model, i) not in (("rad",), ("m",)):
        return None
    joint = int(model.actuator_trnid[i, 0])
    if joint not in joints or model.actuator_gear[i, 0] != 1:
        raise ValueError(
            f"policy: rates: {name}: expected the position of the joint {model.joint(joint).name!r} among the observed "
            "signals, and a gear of 1, as the servo's target begins there"
        )
    return joints.index(joint)


def _control_unit(model: mujoco.MjModel, i: int) -> str:
    """The unit of an actuator's control; "" where the model does not say: a motor may be driven by a voltage."""
    units = measured.control_units(model, i)
    return units[0] if len(units) == 1 else ""


def _limits(model: mujoco.MjModel, i: int, name: str, goal: Goal) -> tuple[float, float]:
    if name in goal.limits:
        low, high = goal.limits[name]
    elif model.actuator_ctrllimited[i]:
        low, high = model.actuator_ctrlrange[i]
    else:
        raise ValueError(f"policy: limits: expected those of {name}, whose actuator has no ctrlrange; got none")
    if not low < high:
        raise ValueError(f"policy: limits: {name}: expected LOW below HIGH, got {[float(low), float(high)]}")
    least, most = model.actuator_ctrlrange[i]
    clamps = model.actuator_ctrllimited[i] and not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    if clamps and (low < least or high > most):
        raise ValueError(
            f"policy: limits: {name}: expected limits within the actuator's ctrlrange, beyond which MuJoCo clamps: "
            f"{[float(least), float(most)]}; got {[float(low), float(high)]}"
        )
    return float(low), float(high)
