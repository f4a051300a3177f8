"""A goal in terms of a model: where its signals are, what a policy observes and does, and its reward."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlfi.envs.mujoco import measured
from jaxlfi.envs.mujoco.columns import require_one_control_each
from jaxlfi.envs.mujoco.goal import Goal
from jaxlfi.rl.environment import Signals
from jaxlfi.rl.preparation import Command, Control, Preparation, Signal

_JOINTS = {
    int(mujoco.mjtSensor.mjSENS_JOINTPOS): ("rad", "m"),
    int(mujoco.mjtSensor.mjSENS_JOINTVEL): ("rad/s", "m/s"),
}
"""Units of sensors of hinges and slides."""


def add_signals(spec: mujoco.MjSpec, goal: Goal) -> None:
    """Add sensors to a specification for the signals of a goal that are of joints and bodies.

    Raises:
        ValueError: for joints and bodies that the model does not have, which says where in the goal they are.
    """
    _for_each(goal, lambda names: measured.add_sensors(spec, names))


def _for_each(goal: Goal, look: Callable[[Sequence[str]], Any]) -> None:
    """Look up the signals of each part of a goal separately, so that an error names the part."""
    ends = {f"terminations: {name}": [one.signal] for name, one in goal.terminations.items()}
    for where, names in ({"observed": goal.observed, "targets": [*goal.targets]} | ends).items():
        try:
            look(names)
        except ValueError as error:
            raise ValueError(f"policy: {where}: {str(error).removeprefix('measured: ')}") from error


class Reading:
    """A goal in terms of a model's sensors and actuators. Works on JAX's arrays and on NumPy's.

    Attributes:
        goal: of the policy.
        places: of its signals among the sensor data, S of them; the observed ones come first.
        preparation: of these and of controls, to what a policy observes and does.
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
        _for_each(goal, lambda names: measured.places(model, names))
        self.places = np.asarray(measured.places(model, goal.signals))
        owners = [_owner(model, place) for place in self.places]
        used = zip(goal.signals, owners, strict=True)
        angles = [name for name, one in used if one.turning and name in (*goal.observed, *goal.targets)]
        if unknown := [name for name in goal.turns if name not in angles]:
            raise ValueError(
                f"policy: turns: expected positions of hinges without a range ({', '.join(angles) or 'none'}), "
                f"got {', '.join(unknown)}"
            )
        self._turning = [one.turning and name not in goal.turns for name, one in zip(goal.signals, owners, strict=True)]
        require_one_control_each(model)
        self._actuators = [model.actuator(i).name or f"actuator/{i}" for i in range(model.nu)]
        if not self._actuators:
            raise ValueError("policy: expected a model with actuators, got one without")
        for key in ("limits", "costs", "change_costs", "rates", "displacing"):
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
        of_targets = {one.value: measured.unit(model, name) for name, one in goal.aims.items()}
        commands = tuple(Command(name, *bounds, of_targets.get(name, "")) for name, bounds in goal.commands.items())
        ends = {
            name: dataclasses.replace(one, unit=measured.unit(model, one.signal).removeprefix("1"))
            for name, one in goal.terminations.items()
        }
        return Preparation(
            signals=signals,
            controls=tuple(controls),
            interval=goal.interval,
            steps=goal.steps,
            history=goal.history,
            actions=goal.actions,
            commands=commands,
            observation_delay=goal.observation_delay,
            action_delay=goal.action_delay,
            terminations=ends,
            memory=goal.memory,
        )

    def _signals(self, owners: Sequence["_Owner"]) -> tuple[Signals, Signals]:
        """Observations and actions as the policy scales them."""
        goal, prepared = self.goal, self.preparation
        frame: list[tuple[str, float, float]] = []
        for name, owner, turning in zip(goal.observed, owners, self._turning, strict=False):
            frame += [("", 0.0, 1.0)] * 2 if turning else [(owner.unit, 0.0, goal.scales.get(name, 1.0))]
        controls = [("", *one) for one in zip(self._centre.tolist(), self._scale.tolist(), strict=True)]
        commands = [(one.unit, (one.low + one.high) / 2, (one.high - one.low) / 2) for one in prepared.commands]
        memory = [("", 0.0, 1.0)] * goal.memory
        units, centres, scales = zip(*frame * goal.history, *controls * goal.actions, *commands, *memory, strict=True)
        low, high = prepared.ranges
        ranges = zip(((low + high) / 2).tolist(), ((high - low) / 2).tolist(), strict=True)
        acted = zip(*[("", *one) for one in ranges], *memory, strict=True)
        names = (*self._actuators, *prepared.remembered)
        return Signals(prepared.names, units, centres, scales), Signals(names, *acted)

    def ended(self, values: Float[Array | np.ndarray, " signals"]) -> dict[str, Bool[Array | np.ndarray, ""]]:
        """Whether each of the terminations holds at these values of signals."""
        signals = self.goal.signals
        return {name: one.holds(values[signals.index(one.signal)]) for name, one in self.goal.terminations.items()}

    def reward(
        self,
        values: Float[Array | np.ndarray, " signals"],
        control: Float[Array | np.ndarray, " act"],
        last: Float[Array | np.ndarray, " act"],
        commands: Float[Array | np.ndarray, " commands"] | tuple[()] = (),
        xp: Any = jnp,
    ) -> Float[Array | np.ndarray, ""]:
        """The reward of a control interval (`jaxlfi.envs.mujoco.goal`).

        Args:
            values: of the goal's signals at its end.
            control: in the interval.
            last: control in the interval before.
            commands: of the episode.
            xp: NumPy, or `jax.numpy`.
        """
        goal, ended = self.goal, self.ended(values)
        if goal.reward is not None:
            signals = {name: values[place] for place, name in enumerate(goal.signals)}
            signals |= {f"command {name}": commands[place] for place, name in enumerate(goal.commands)}
            reward = goal.reward(signals, {name: control[i] for i, name in enumerate(self._actuators)})
        else:
            reward = goal.interval * self._rate(values, control, last, commands, xp)
        if goal.alive:
            goes_on = 1.0 - xp.any(xp.stack([*ended.values()])) if ended else 1.0
            reward += goal.interval * goal.alive * goes_on
        return reward - sum(one.cost * ended[name] for name, one in goal.terminations.items())

    def _rate(self, values, control, last, commands, xp: Any) -> Any:
        """Reward per second from targets and costs of controls."""
        goal, reward = self.goal, 0.0
        for name, off in self.off(values, commands, xp).items():
            target, turning = goal.aims[name], self._turning[goal.signals.index(name)]
            squared = 2 * (1 - xp.cos(off)) if turning else off**2
            reward += target.weight * (-squared if target.within is None else xp.exp(-squared / target.within**2))
        for i, name in enumerate(self._actuators):
            fraction = (control[i] - self._centre[i]) / self._scale[i]
            change = (control[i] - last[i]) / self._scale[i]
            reward -= goal.costs.get(name, 0.0) * fraction**2 + goal.change_costs.get(name, 0.0) * change**2
        return reward

    def off(
        self,
        values: Float[Array | np.ndarray, " signals"],
        commands: Float[Array | np.ndarray, " commands"] | tuple[()] = (),
        xp: Any = jnp,
    ) -> dict[str, Any]:
        """Distances of signals from their targets; for angles, the shorter way round."""
        found, known = {}, [*self.goal.commands]
        for name, target in self.goal.aims.items():
            place = self.goal.signals.index(name)
            aim = commands[known.index(target.value)] if isinstance(target.value, str) else target.value
            difference = values[place] - aim
            turning = self._turning[place]
            found[name] = xp.arctan2(xp.sin(difference), xp.cos(difference)) if turning else difference
        return found


class _Owner(NamedTuple):
    """The relation of a number of the sensor data to a joint.

    Attributes:
        unit: "" if it is not a joint's.
        turning: whether it is an angle without a range.
        joint: number of the joint whose position it is; -1 if there is none.
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
    """The place of the signal that a control begins at: a servo's target begins at its joint's position.

    Raises:
        ValueError: if the policy does not see it.
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
    if not -np.inf < low < high < np.inf:
        raise ValueError(
            f"policy: limits: {name}: expected LOW below HIGH, both finite, got {[float(low), float(high)]}"
        )
    least, most = model.actuator_ctrlrange[i]
    clamps = model.actuator_ctrllimited[i] and not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    if clamps and (low < least or high > most):
        raise ValueError(
            f"policy: limits: {name}: expected limits within the actuator's ctrlrange, beyond which MuJoCo clamps: "
            f"{[float(least), float(most)]}; got {[float(low), float(high)]}"
        )
    return float(low), float(high)
