"""The effects of parameters: on the model, on the state that episodes begin in, on sensors or on controls."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from jaxlfi.envs.mujoco import inertia, parameters, ties
from jaxlfi.envs.mujoco.inertia import Inertial
from jaxlfi.envs.mujoco.parameters import Edit, near
from jaxlfi.envs.mujoco.ties import Tie

STATE = mujoco.mjtState.mjSTATE_FULLPHYSICS
"""Time, positions, velocities and activations."""
OF_SENSORS = {"gain": "gains", "bias": "biases", "delay": "lags", "noise": "deviations"}
"""Names of sensor parameters, and their fields of `Effects`."""
OF_EPISODE = re.compile(r"episode/(?P<episode>\d+)/initial/(?P<rest>[^*?]+)")
"""A parameter of the start of one episode."""
OF_CLOCKS = {"control/delay": "delay", "clock/jitter": "jitter"}
"""The same for the clock by which controls act."""


@dataclasses.dataclass(frozen=True)
class Effects:
    """The effects of D parameters, whose index is the second of each pair.

    Attributes:
        edits: of the model.
        inertials: bodies whose whole inertia changes, with those of its ten numbers that are parameters.
        starts: places in the initial state of all episodes.
        own_starts: the same for one episode, whose index is the first of three.
        gains: signals that the parameter multiplies, before an offset is added.
        biases: signals that the parameter is added to.
        lags: signals that are measured with this delay, in s.
        deviations: signals whose noise has this standard deviation.
        delay: index of the parameter that is the control delay, if any.
        jitter: index of the parameter that is the standard deviation of the times at which controls act, if any.
    """

    edits: tuple[tuple[Edit, int], ...] = ()
    inertials: tuple[tuple[Inertial, tuple[tuple[int, int], ...]], ...] = ()
    starts: tuple[tuple[int, int], ...] = ()
    own_starts: tuple[tuple[int, int, int], ...] = ()
    gains: tuple[tuple[int, int], ...] = ()
    biases: tuple[tuple[int, int], ...] = ()
    lags: tuple[tuple[int, int], ...] = ()
    deviations: tuple[tuple[int, int], ...] = ()
    delay: int | None = None
    jitter: int | None = None

    @property
    def rescaled(self) -> frozenset[int]:
        """Signals whose sensors have an offset or a gain that is inferred."""
        return frozenset(signal for signal, _ in (*self.gains, *self.biases))

    def started(
        self, start: Float[np.ndarray, "*#n state"], theta: Float[np.ndarray, "*n dim"], episode: int
    ) -> Float[np.ndarray, "*n state"]:
        """The initial states for parameter vectors, given the states that episodes would begin in otherwise."""
        state = np.array(np.broadcast_to(start, (*theta.shape[:-1], np.shape(start)[-1])))
        for place, d in self.starts_of(episode):
            state[..., place] = theta[..., d]
        return state

    def starts_of(self, episode: int) -> tuple[tuple[int, int], ...]:
        """Places in an episode's initial state, with the parameters that set them."""
        return (*self.starts, *((place, d) for own, place, d in self.own_starts if own == episode))


def effects(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    names: Sequence[str],
    supports: Sequence[tuple[float, float]],
    signals: Sequence[str],
    tied: Sequence[Tie] | None = None,
    episodes: int | None = None,
) -> Effects:
    """The effects of parameters, by their names.

    Args:
        spec: of the model.
        model: as compiled, unchanged.
        names: of the parameters (`parameters`).
        supports: bounds of the parameters, between which the model has to differ.
        signals: that are measured.
        tied: meaning of each parameter for each of several elements (`ties`); by default each has one element.
        episodes: number of episodes, if parameters may set the start of one of them.

    Raises:
        ValueError: for names that match nothing or several numbers, parameters without an effect, and two parameters
            of one number, in one line.
    """
    found: dict[str, list] = {"edits": [], "starts": [], "own_starts": [], **{what: [] for what in OF_SENSORS.values()}}
    of_clock: dict[str, int] = {}
    bodies: dict[str, list[tuple[int, int]]] = {}
    keys: list[tuple[str, list[tuple]]] = []
    tied = [None] * len(names) if tied is None else tied
    for d, (name, support, tie) in enumerate(zip(names, supports, tied, strict=True)):
        kind, _, rest = name.partition("/")
        if kind in ("sensor", "initial", "control", "clock", "option") and tie not in (None, "shared"):
            raise ValueError(f"parameters: {name!r}: tie: expected shared, as the model has no values of them to scale")
        if kind == "sensor":
            what, several = _of_sensor(rest, name, signals)
            found[what] += [(signal, d) for signal in several]
            keys.append((name, [("sensor", signals[signal], what) for signal in several]))
        elif kind == "initial":
            places = [state_place(model, one, name) for one in _of_joints(model, rest, name)]
            found["starts"] += [(place, d) for place in places]
            keys.append((name, [("initial", place, own) for place in places for own in range(episodes or 1)]))
        elif (of_start := OF_EPISODE.fullmatch(name)) is not None:
            own, rest = int(of_start["episode"]), of_start["rest"]
            if episodes is not None and own >= episodes:
                raise ValueError(f"parameters: {name!r}: expected an episode of 0 to {episodes - 1}, got {own}")
            place = state_place(model, rest, name)
            found["own_starts"].append((own, place, d))
            keys.append((name, [("initial", place, own)]))
        elif kind in ("control", "clock"):
            if name not in OF_CLOCKS or not model.nu:
                expected = " or ".join(OF_CLOCKS)
                raise ValueError(f"parameters: expected {expected} of a model with actuators, got {name!r}")
            of_clock[OF_CLOCKS[name]] = d
        elif (of_body := inertia.component(name)) is not None:
            body, number = of_body
            own = inertia.inertial(model, body, name)
            alone = Edit(
                name, lambda spec, x, own=own, number=number: own.apply(spec, x * np.eye(inertia.COUNT)[number])
            )
            parameters.check_effect(spec, alone, support)
            bodies.setdefault(body, []).append((number, d))
            taken = [("body", body, attribute, i) for attribute in parameters.INERTIAL for i in range(4)]
            keys.append((f"body/{body}/inertial", taken))
        else:
            one, several = ties.edit(spec, model, name, tie)
            parameters.check_effect(spec, one, support)
            found["edits"].append((one, d))
            keys.append((name, several))
    ties.refuse_overlaps(keys)
    # A body's mass scales its inertia, except for components that are inferred themselves.
    found["edits"].sort(key=lambda pair: not pair[0].name.endswith("/mass"))
    inertials = tuple((inertia.inertial(model, body, body), tuple(several)) for body, several in bodies.items())
    return Effects(**{what: tuple(several) for what, several in found.items()}, **of_clock, inertials=inertials)


def built(spec: mujoco.MjSpec, does: Effects, theta: Float[np.ndarray, " dim"]) -> mujoco.MjModel:
    """The model of a parameter vector, recompiled.

    Raises:
        ValueError: where MuJoCo refuses it.
    """
    own = spec.copy()
    for one, d in does.edits:
        one.apply(own, float(theta[d]))
    for body, several in does.inertials:
        coordinates = np.zeros(inertia.COUNT)
        for number, d in several:
            coordinates[number] = theta[d]
        body.apply(own, coordinates)
    return own.compile()


def initial_state(model: mujoco.MjModel, initial: Mapping[str, float]) -> Float[np.ndarray, " state"]:
    """The model's own initial state, with some values replaced, by JOINT/qpos and JOINT/qvel.

    Raises:
        ValueError: for joints that the model does not have.
    """
    data, state = mujoco.MjData(model), np.zeros(mujoco.mj_stateSize(model, STATE))
    mujoco.mj_getState(model, data, state, STATE)
    for name, number in initial.items():
        state[state_place(model, name, f"initial/{name}")] = number
    return state


def state_place(model: mujoco.MjModel, rest: str, name: str) -> int:
    """The place of JOINT/qpos, or JOINT/qvel[2], in a state.

    Raises:
        ValueError: for joints that the model does not have, and several numbers.
    """
    match = parameters.FORM.fullmatch(rest)
    if match is None or match["attribute"] not in ("qpos", "qvel"):
        raise ValueError(f"parameters: expected initial/JOINT/qpos or initial/JOINT/qvel, got {name!r}")
    joints = [model.joint(i).name for i in range(model.njnt)]
    if match["element"] not in joints:
        raise ValueError(f"parameters: {name!r}: expected a joint {near(match['element'], joints)}")
    joint, velocity = model.joint(match["element"]), match["attribute"] == "qvel"
    index = None if match["index"] is None else int(match["index"])
    place = parameters.place(np.zeros(sizes(joint)[velocity]), index, name)
    return 1 + place + (model.nq + int(joint.dofadr[0]) if velocity else int(joint.qposadr[0]))


def sizes(joint: Any) -> tuple[int, int]:
    """How many positions and velocities a joint has; of several positions the last four are a quaternion."""
    several = {mujoco.mjtJoint.mjJNT_FREE: (7, 6), mujoco.mjtJoint.mjJNT_BALL: (4, 3)}
    return several.get(mujoco.mjtJoint(joint.type[0]), (1, 1))


def sensed_by(pattern: str, signals: Sequence[str]) -> list[int]:
    """Indices of the signals whose sensors match a name or a pattern."""
    fits = ties.expression(pattern).fullmatch
    plain = [one.removeprefix("sensor/") for one in signals]  # of sensors without a name
    several = zip(signals, plain, strict=True)
    return [i for i, (one, own) in enumerate(several) if fits(one) or fits(own) or fits(own.rpartition("[")[0])]


def _of_joints(model: mujoco.MjModel, rest: str, name: str) -> list[str]:
    """JOINT/qpos of all joints whose names a pattern matches."""
    if not parameters.PATTERN.search(rest):
        return [rest]
    pattern, _, what = rest.rpartition("/")
    joints = [model.joint(i).name for i in range(model.njnt)]
    if not (found := [joint for joint in joints if ties.expression(pattern).fullmatch(joint)]):
        raise ValueError(
            f"parameters: {name!r}: expected a pattern that matches the name of a joint {near(rest, joints)}"
        )
    return [f"{joint}/{what}" for joint in found]


def _of_sensor(rest: str, name: str, signals: Sequence[str]) -> tuple[str, list[int]]:
    """The effect, and the signals: one, or all components that a sensor measures."""
    signal, _, what = rest.rpartition("/")
    found = sensed_by(signal, signals)
    if not found:
        raise ValueError(f"parameters: {name!r}: expected a signal {near(signal, signals)}, got {signal!r}")
    if what not in OF_SENSORS:
        raise ValueError(f"parameters: {name!r}: expected {', '.join(OF_SENSORS)} of a sensor, got {what!r}")
    return OF_SENSORS[what], found
