"""Where episodes begin: in the model's own state, in a keyframe, or where their own recordings do.

| `[initial] from =` | every episode begins |
|---|---|
| `"model"` | in the model's own state |
| `"keyframe home"` | in a keyframe of the model, by its name or number |
| `"log"` | where its recording does |

Numbers next to it, and parameters `initial/JOINT/qpos`, take precedence. By default, an episode begins where its
recording does, if that measures all joints of which nothing is given, and begins elsewhere than the model.

Position and velocity are estimated by a cubic polynomial through a recording's first samples, over half of the longest
time over which it fits to within the noise and agrees with fits over shorter times (Lepskii 1991). What remains
uncertain, velocities above all, is redrawn in each simulation: it is not inferred but widens the posterior.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Array, Float, Int

from jaxlfi.envs.mujoco import measured, orientations, poses
from jaxlfi.envs.mujoco.columns import controls_of
from jaxlfi.envs.mujoco.effects import STATE, Effects, initial_state, sizes, state_place
from jaxlfi.envs.mujoco.logs import Log
from jaxlfi.envs.mujoco.parameters import near
from jaxlfi.envs.mujoco.plausible import say

DEGREE = 3
"""Degree of the polynomial."""
KEYFRAME = "keyframe "
FEWEST, MOST = 8, 1000
"""Smallest and largest number of samples for the polynomial."""
COUNTS = np.unique(np.round(np.geomspace(FEWEST, MOST, 24)).astype(int)).tolist()
"""Numbers of samples that are tried."""
AGREES = 3.0
"""Standard deviations within which a recording begins where the model does."""
STRAIGHT = {1: 1, 4: 0, 7: 3}
"""Number of a joint's positions outside of quaternions, by the number of all its positions."""
APART = 2.5
"""Standard deviations by which a start from fewer samples may differ from one from more."""
_TINY = 1e-9
_OF_FIRST_ORDER = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))


@dataclasses.dataclass(frozen=True, eq=False)
class Start:
    """An episode's initial state, and its uncertainty. V is the number of degrees of freedom.

    Attributes:
        state: the most likely one (`effects.STATE`).
        acceleration: shape [V].
        root: Cholesky factor of the covariance of each position and its velocity; 0 where they are known. Rotations
            are vectors in the body's frame. Shape [V, 2, 2].
        signals: numbers of the signals that measure the positions; -1 where none does, shape [V].
        fixed: numbers of the state that are given, by their places.
        joints: each joint's places in `qpos` and `qvel`, and its number of positions.
        time: when the episode begins, in s of the recording.
    """

    state: Float[np.ndarray, " state"]
    acceleration: Float[np.ndarray, " dofs"]
    root: Float[np.ndarray, "dofs 2 2"]
    signals: Int[np.ndarray, " dofs"]
    fixed: Mapping[int, float]
    joints: tuple[tuple[int, int, int], ...]
    time: float = 0.0

    @property
    def uncertain(self) -> bool:
        """Whether each simulation begins in a state of its own."""
        return bool(self.root.any())

    def at(
        self,
        does: Effects,
        theta: Float[Array | np.ndarray, "*n dim"],
        draws: Float[Array | np.ndarray, "*n dofs 2"],
        xp: ModuleType = np,
    ) -> Float[Array | np.ndarray, "*n state"]:
        """The initial states for parameter vectors, except for what parameters set of them.

        Positions from a recording are as its sensors measured them, late or with a gain and an offset, which is undone.

        Args:
            does: effects of parameters.
            theta: in natural units.
            draws: of a standard normal distribution; 0 for the most likely state.
            xp: `numpy` or `jax.numpy`.
        """
        dofs = len(self.signals)
        first, rest = 1 + sum(count for _, _, count in self.joints), self.state[1:]
        qpos, qvel = rest[: first - 1], rest[first - 1 : first - 1 + dofs]
        off = xp.einsum("vij,...vj->...vi", self.root, draws)
        late, bias, gain = (self._of(pairs, theta, xp) for pairs in (does.lags, does.biases, does.gains))
        scalar, own = self._scalars()
        gain = 1.0 if gain is None else xp.where(scalar & self._touched(does.gains), gain, 1.0)
        late, bias = (0.0 if one is None else one for one in (late, bias))
        position = off[..., 0] + late * (qvel + 0.5 * late * self.acceleration)
        position = position + xp.where(scalar, (own + position - bias) / gain - (own + position), 0.0)
        velocity = (qvel + off[..., 1] + late * self.acceleration) / gain
        parts = [moved(self.joints, qpos, position, xp), velocity]
        shape = parts[1].shape[:-1]
        parts = [xp.broadcast_to(self.state[:1], (*shape, 1)), *parts]
        parts.append(xp.broadcast_to(self.state[first + dofs :], (*shape, len(self.state) - first - dofs)))
        state = xp.concatenate(parts, axis=-1)
        for place, number in self.fixed.items():
            state = xp.where(np.arange(len(self.state)) == place, number, state)
        return state

    def _of(self, pairs: Sequence[tuple[int, int]], theta: Any, xp: ModuleType) -> Any:
        """The value of a sensor's parameter for each degree of freedom; None if there are no such parameters."""
        if not any((self.signals == signal).any() for signal, _ in pairs):
            return None
        return sum((self.signals == signal) * theta[..., d, None] for signal, d in pairs)

    def _touched(self, pairs: Sequence[tuple[int, int]]) -> np.ndarray:
        return np.isin(self.signals, [signal for signal, _ in pairs])

    def _scalars(self) -> tuple[np.ndarray, np.ndarray]:
        """Which degrees of freedom are no rotations of balls and free bodies, and their positions."""
        scalar, own = np.ones(len(self.signals), bool), np.zeros(len(self.signals))
        for place, dof, count in self.joints:
            straight = STRAIGHT[count]
            own[dof : dof + straight] = self.state[1 + place : 1 + place + straight]
            scalar[dof + straight : dof + straight + 3 * (count > 1)] = False
        return scalar, own


def moved(
    joints: Sequence[tuple[int, int, int]],
    qpos: Float[Array | np.ndarray, "*n nq"],
    by: Float[Array | np.ndarray, "*n nv"],
    xp: ModuleType = np,
) -> Float[Array | np.ndarray, "*n nq"]:
    """Positions moved along each degree of freedom, as MuJoCo integrates velocities over a second."""
    parts = [by[..., :0]]
    for place, dof, count in joints:
        straight = STRAIGHT[count]
        parts.append(qpos[..., place : place + straight] + by[..., dof : dof + straight])
        if count > 1:
            quaternion = qpos[..., place + straight : place + count]
            parts.append(turned(quaternion, by[..., dof + straight : dof + straight + 3], xp))
    return xp.concatenate(parts, axis=-1)


def turned(
    quaternion: Float[Array | np.ndarray, "*#n 4"], by: Float[Array | np.ndarray, "*#n 3"], xp: ModuleType = np
) -> Float[Array | np.ndarray, "*n 4"]:
    """Orientations that are rotated by a rotation vector in their own frame, in rad."""
    angle = xp.sqrt(xp.sum(by**2, axis=-1, keepdims=True))
    scale, cosine = 0.5 * xp.sinc(angle / (2 * np.pi)), xp.cos(0.5 * angle)
    w, vector, other = quaternion[..., :1], quaternion[..., 1:], scale * by
    real = w * cosine - xp.sum(vector * other, axis=-1, keepdims=True)
    return xp.concatenate([real, w * other + cosine * vector + xp.cross(vector, other)], axis=-1)


def certain(model: mujoco.MjModel, state: Float[np.ndarray, " state"], fixed: Mapping[int, float] = {}) -> Start:
    """A start without uncertainty."""
    own = state.copy()
    for place, number in fixed.items():
        own[place] = number
    none = np.zeros((model.nv, 2, 2))
    return Start(own, np.zeros(model.nv), none, np.full(model.nv, -1), dict(fixed), _joints(model))


def keyframe(model: mujoco.MjModel, name: str) -> Float[np.ndarray, " state"]:
    """The state of a keyframe.

    Raises:
        ValueError: for one that the model does not have.
    """
    names = [model.key(i).name for i in range(model.nkey)]
    number = names.index(name) if name in names else int(name) if name.isdecimal() else -1
    if not 0 <= number < model.nkey:
        raise ValueError(f"initial: from: expected a keyframe {near(name, [*filter(None, names)])}, got {name!r}")
    data, state = mujoco.MjData(model), np.zeros(mujoco.mj_stateSize(model, STATE))
    mujoco.mj_resetDataKeyframe(model, data, number)
    mujoco.mj_getState(model, data, state, STATE)
    state[0] = 0.0
    return state


def modes(begins: str | Sequence[str] | None, count: int) -> list[str | None]:
    """Where each episode begins, as `[initial] from` says; None where it does not.

    Raises:
        ValueError: for other words, and a number of them that is not that of episodes.
    """
    if not isinstance(begins, str | list | tuple | None):
        raise ValueError(f'initial: from: expected "log", "model" or "keyframe NAME", got {begins!r}')
    several: list[str | None] = list(begins) if isinstance(begins, list | tuple) else [begins] * count
    if len(several) != count:
        raise ValueError(f"initial: from: expected one for all, or one for each of {count} episodes, got {begins!r}")
    for one in several:
        if one not in (None, "log", "model") and not str(one).startswith(KEYFRAME):
            raise ValueError(f'initial: from: expected "log", "model" or "keyframe NAME", got {one!r}')
    return several


def state_of(model: mujoco.MjModel, mode: str | None, fixed: Mapping[int, float]) -> Float[np.ndarray, " state"]:
    """An episode's initial state, unless its recording determines it.

    Raises:
        ValueError: for a keyframe that the model does not have.
    """
    if mode is not None and mode.startswith(KEYFRAME):
        state = keyframe(model, mode.removeprefix(KEYFRAME))
    else:
        state = initial_state(model, {})
    state[list(fixed)] = list(fixed.values())
    return state


def first(
    model: mujoco.MjModel, begins: str | Sequence[str] | None, initial: Mapping[str, float | Sequence[float]]
) -> Float[np.ndarray, " state"]:
    """The initial state of the first episode, unless its recording determines it.

    Raises:
        ValueError: for joints and keyframes that the model does not have.
    """
    numbers = {name: float(np.ravel(several)[0]) for name, several in initial.items()}
    mode = begins if isinstance(begins, str | None) else begins[0]
    return state_of(model, mode, given(model, numbers, 1)[0])


def chosen(
    model: mujoco.MjModel,
    episodes: Sequence[Log],
    signals: Sequence[str],
    noises: Mapping[str, float],
    states: Sequence[Float[np.ndarray, " state"]],
    fixed: Sequence[Mapping[int, float]],
    begins: Sequence[str | None],
    does: Effects,
) -> list[Start]:
    """Where each episode begins; starts from recordings are reported in one line.

    Args:
        model: with a sensor for each signal.
        episodes: recordings.
        signals: that are measured.
        noises: standard deviations of their noise; 0 where they are not known.
        states: initial state of each otherwise.
        fixed: numbers of the state that are given, by their places.
        begins: where each episode begins (`modes`).
        does: effects of parameters.

    Raises:
        ValueError: if a recording should determine the start of its episode and does not, in one line.
    """
    found, said = [], []
    for number, (log, own, known, mode) in enumerate(zip(episodes, states, fixed, begins, strict=True)):
        start, inferred = certain(model, own, known), [place for place, _ in does.starts_of(number)]
        here = [name for name in signals if name in log.signals and np.isfinite(log.signals[name]).any()]
        missing = unmeasured(model, here, [*known, *inferred])
        if mode == "log" and missing:
            raise ValueError(
                f"initial: from: expected a log that measures all joints, got none of {', '.join(missing)} in "
                f"{log.name}: give {missing[0]}/qpos in [initial], or infer initial/{missing[0]}/qpos"
            )
        if mode == "log" or (mode is None and not missing and model.nq):
            settled = [*known, *inferred] if mode is None else []
            without = [joint for joint in range(model.njnt) if not _places(model, joint).isdisjoint(settled)]
            says = recorded(model, log, signals, noises, own, known, inferred, without=without)
            if says.uncertain and (mode == "log" or not agrees(model, says, own, does)):
                start = says
                said.append(log.name)
        found.append(start)
    if said:
        speeds = np.concatenate([np.linalg.norm(one.root[:, 1], axis=-1) for one in found if one.uncertain])
        several = f"{len(said)} episodes begin" if len(said) > 3 else f"{', '.join(said)}: an episode begins"
        say(
            f"{several} where the recording does, with velocities to within {np.median(speeds):.2g} (a standard "
            'deviation), which are drawn anew in each simulation; for the model\'s own start: [initial] from = "model"'
        )
    return found


def given(model: mujoco.MjModel, initial: Mapping[str, float | Sequence[float]], count: int) -> list[dict[int, float]]:
    """Numbers of the state of each episode by their places: one for all, or one for each.

    Raises:
        ValueError: for joints that the model does not have, and a number of values that is not that of episodes.
    """
    found: list[dict[int, float]] = [{} for _ in range(count)]
    for name, numbers in initial.items():
        place = state_place(model, name, f"initial/{name}")
        several = [numbers] * count if isinstance(numbers, int | float) else list(numbers)
        if len(several) != count:
            raise ValueError(
                f"initial: {name}: expected a number, or one for each of {count} episodes, got {len(several)}"
            )
        for own, number in zip(found, several, strict=True):
            own[place] = float(number)
    return found


def unmeasured(model: mujoco.MjModel, signals: Sequence[str], known: Sequence[int]) -> list[str]:
    """Joints whose position is neither measured nor given completely.

    Args:
        model: with a sensor for each signal.
        signals: that are measured.
        known: places in the state that are given.
    """
    found = []
    for joint in poses.unmeasured_joints(model, signals):
        own = model.joint(joint)
        if not all(1 + int(own.qposadr[0]) + k in known for k in range(sizes(own)[0])):
            found.append(joint)
    return found


def recorded(
    model: mujoco.MjModel,
    log: Log,
    signals: Sequence[str],
    noises: Mapping[str, float],
    own: Float[np.ndarray, " state"],
    fixed: Mapping[int, float] = {},
    inferred: Sequence[int] = (),
    at: float = 0.0,
    without: Sequence[int] = (),
) -> Start:
    """The start that is estimated from a recording.

    Args:
        model: with a sensor for each signal.
        log: the recording.
        signals: that are measured.
        noises: standard deviations of their noise; 0 where they are not known.
        own: the state that provides what the recording does not.
        fixed: numbers of the state that are given, by their places.
        inferred: places in the state that parameters set.
        at: when the episode begins, in s of the recording.
        without: numbers of the joints that begin as they would otherwise.

    Raises:
        ValueError: for too few samples, in one line.
    """
    state, numbers = own.copy(), poses.measured_positions(model, signals)
    acceleration, root = np.zeros(model.nv), np.zeros((model.nv, 2, 2))
    measuring = np.full(model.nv, -1)
    speeds = _speeds(model, signals)
    for joint, (place, dof, count) in enumerate(_joints(model)):
        if joint in without:
            continue
        straight = STRAIGHT[count]
        for k in range(straight):
            if place + k not in numbers:
                continue
            number = numbers[place + k]
            series = [(*log.samples(signals[number]), _deviation(log, signals[number], noises), 0)]
            for name in (one for one in speeds.get(dof + k, ()) if one in log.signals):
                series.append((*log.samples(name), _deviation(log, name, noises), 1))
            moments, covariance = polynomial(series, at, f"{log.name}: {signals[number]}")
            state[1 + place + k], state[1 + model.nq + dof + k], acceleration[dof + k] = moments
            root[dof + k] = np.linalg.cholesky(covariance + _TINY**2 * np.eye(2))
            measuring[dof + k] = number
        places = range(place + straight, place + count)
        if count > 1 and all(one in numbers for one in places):
            names = [signals[numbers[one]] for one in places]
            quaternion, spin, change, roots = _rotation(log, names, noises, at)
            state[[1 + one for one in places]] = quaternion
            dofs = slice(dof + straight, dof + straight + 3)
            state[1 + model.nq + dof + straight : 1 + model.nq + dof + straight + 3] = spin
            acceleration[dofs], root[dofs], measuring[dofs] = change, roots, numbers[places[0]]
    for dof, place in enumerate(_position_places(model)):
        velocity = 1 + model.nq + dof
        for row, where in enumerate((place, velocity)):
            if where in fixed or where in inferred:
                root[dof, row] = 0.0
    first = 1 + model.nq + model.nv
    for i, name in enumerate(controls_of(model)):
        of_first_order = int(model.actuator_dyntype[i]) in _OF_FIRST_ORDER and model.actuator_actnum[i] == 1
        if of_first_order and name in log.signals:
            state[first + int(model.actuator_actadr[i])] = log.held(name, np.array([at]))[0]
    for where, given in fixed.items():
        state[where] = given
    state[0] = 0.0
    return Start(state, acceleration, root, measuring, dict(fixed), _joints(model), at)


def agrees(model: mujoco.MjModel, start: Start, own: Float[np.ndarray, " state"], does: Effects) -> bool:
    """Whether a recording begins where the model does, to within its noise."""
    deviations = np.linalg.norm(start.root, axis=-1)
    back = np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, back, 1.0, own[1 : 1 + model.nq], start.state[1 : 1 + model.nq])
    velocities = slice(1 + model.nq, 1 + model.nq + model.nv)
    off = np.abs(np.stack([back, start.state[velocities] - own[velocities]], axis=1))
    compared = deviations > 0
    compared[np.isin(start.signals, list(does.rescaled)), 0] = False  # whatever its sensor says
    return bool((off <= AGREES * deviations + _TINY)[compared].all())


def polynomial(
    series: Sequence[tuple[np.ndarray, np.ndarray, float, int]], at: float, where: str
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "2 2"]]:
    """Position, velocity and acceleration at a time, and the covariance of the first two.

    Args:
        series: times, values, the standard deviation of their noise, and 0 for positions or 1 for velocities; the first
            is of positions.
        at: the time.
        where: source of the samples, for messages.

    Raises:
        ValueError: for fewer than two positions.
    """
    series = [_near(*one, at) for one in series]
    away = np.sort(np.abs(series[0][0] - at))
    if len(away) < 2:
        raise ValueError(f"{where}: expected at least 2 samples to estimate the initial state from, got {len(away)}")
    counts = [count for count in COUNTS if count <= len(away)] or [len(away)]
    longest = 0
    before: list[tuple[np.ndarray, np.ndarray]] = []
    for count in counts:
        found, covariance, excess = _least_squares(series, at, away[count - 1])
        apart = [np.abs(found[:2] - moments[:2]) / deviations for moments, deviations in before]
        if excess > 2 or np.max(apart, initial=0.0) > APART:
            break
        before.append((found, np.sqrt(np.diagonal(covariance))))
        longest = count if excess <= 1 else longest
    if longest == 0:  # a polynomial does not fit even the fewest samples: still fewer show how far it is off
        first, _, _ = _least_squares(series, at, away[counts[0] - 1])
        found, covariance, _ = _least_squares(series, at, away[min(counts[0], DEGREE + 2) - 1])
        off = (found - first)[:2]
        return found, covariance + np.outer(off, off)
    found, covariance, _ = _least_squares(series, at, away[max(longest // 2, counts[0]) - 1])
    return found, covariance


def _near(
    times: np.ndarray, values: np.ndarray, deviation: float, order: int, at: float
) -> tuple[np.ndarray, np.ndarray, float, int]:
    """The part of a series that may matter."""
    middle = int(np.searchsorted(times, at))
    part = slice(max(middle - MOST, 0), middle + MOST)
    return times[part], values[part], deviation, order


def _least_squares(
    series: Sequence[tuple[np.ndarray, np.ndarray, float, int]], at: float, reach: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Moments at a time from samples within reach of it, their covariance, and the residuals' excess over the noise.

    An excess of 1 is two standard deviations of what noise alone leaves.
    """
    reach = max(reach, _TINY)
    rows, values = [], []
    positions = int(np.sum(np.abs(series[0][0] - at) <= reach * (1 + 1e-9)))
    degree = max(min(DEGREE, positions - 2), 1)
    powers = np.arange(degree + 1)
    for times, recorded, deviation, order in series:
        near_by = np.abs(times - at) <= reach * (1 + 1e-9)
        s = ((times[near_by] - at) / reach)[:, None]
        row = s**powers if order == 0 else powers * s ** np.maximum(powers - 1, 0) / reach
        rows.append(row / deviation)
        values.append(recorded[near_by] / deviation)
    design, target = np.concatenate(rows), np.concatenate(values)
    coefficients, _, _, _ = np.linalg.lstsq(design, target, rcond=None)
    freedom = len(target) - degree - 1
    left = float(np.sum((target - design @ coefficients) ** 2)) / max(freedom, 1)
    covariance = np.linalg.pinv(design.T @ design) * max(left if freedom > 0 else 1.0, 1.0)
    moments = np.zeros(3)
    moments[: min(degree + 1, 3)] = coefficients[:3]
    scale = np.array([1.0, 1 / reach, 2 / reach**2])
    excess = (left - 1) / (2 * np.sqrt(2 / freedom)) if freedom > 0 else 0.0
    return moments * scale, covariance[:2, :2] * np.outer(scale[:2], scale[:2]), excess


def _rotation(
    log: Log, names: Sequence[str], noises: Mapping[str, float], at: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Orientation, angular velocity and acceleration in the body's frame, and roots of their covariances [3, 2, 2]."""
    recorded = np.stack([log.signals[name] for name in names], axis=1)
    there = np.flatnonzero(np.isfinite(recorded).all(axis=1))
    row = int(np.searchsorted(log.times[there], at))
    there = there[max(row - MOST, 0) : row + MOST]
    times, rows = log.times[there], orientations.continuous(recorded[there])
    deviation = 2 * float(np.mean([_deviation(log, name, noises) for name in names]))
    middle = rows[np.argmin(np.abs(times - at))].copy()
    for _ in range(2):  # angular velocities are derivatives of rotation vectors where those are small
        away = np.zeros((len(rows), 3))
        for vector, own in zip(away, rows, strict=True):
            mujoco.mju_subQuat(vector, own, middle)
        several = [polynomial([(times, column, deviation, 0)], at, f"{log.name}: {names[0]}") for column in away.T]
        moments = np.array([one for one, _ in several])
        middle = np.asarray(turned(middle, moments[:, 0]))
    roots = np.array([np.linalg.cholesky(covariance + _TINY**2 * np.eye(2)) for _, covariance in several])
    return middle / np.linalg.norm(middle), moments[:, 1], moments[:, 2], roots


def _deviation(log: Log, name: str, noises: Mapping[str, float]) -> float:
    """Standard deviation of a signal's noise, above 0 so that polynomials can be fitted."""
    return max(float(noises[name]), 1e-7 * float(np.ptp(log.samples(name)[1])), _TINY)


def _speeds(model: mujoco.MjModel, signals: Sequence[str]) -> dict[int, list[str]]:
    """Signals that measure velocities of hinges and slides, by the degree of freedom."""
    found: dict[int, list[str]] = {}
    for name, place in zip(signals, measured.places(model, signals), strict=True):
        sensor = int(np.searchsorted(model.sensor_adr, place, side="right")) - 1
        if model.sensor_type[sensor] == mujoco.mjtSensor.mjSENS_JOINTVEL:
            found.setdefault(int(model.jnt_dofadr[model.sensor_objid[sensor]]), []).append(name)
    return found


def _places(model: mujoco.MjModel, joint: int) -> set[int]:
    """Places of a joint's positions and velocities in the state."""
    (place, dof, count), velocities = _joints(model)[joint], 1 + model.nq
    return {*range(1 + place, 1 + place + count), *range(velocities + dof, velocities + dof + count - (count > 1))}


def _joints(model: mujoco.MjModel) -> tuple[tuple[int, int, int], ...]:
    joints = [model.joint(i) for i in range(model.njnt)]
    return tuple((int(one.qposadr[0]), int(one.dofadr[0]), sizes(one)[0]) for one in joints)


def _position_places(model: mujoco.MjModel) -> list[int]:
    """Place in the state of each degree of freedom's position; -1 for rotations, which have four numbers together."""
    found = [-1] * model.nv
    for place, dof, count in _joints(model):
        for k in range(STRAIGHT[count]):
            found[dof + k] = 1 + place + k
    return found
