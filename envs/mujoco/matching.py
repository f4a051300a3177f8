"""The counterparts of a recording's signals in a model, by exact names, or guessed from words and counts.

A name that stands for one control or sensor is taken as it is (`columns`). Other names are split into words:
"shoulder_pan.pos" of the topic "action" is the control of the actuator that moves the joint shoulder_pan, "dq[2]" the
velocity of the model's third degree of freedom if there are as many of them, and "imu.data/angular_velocity[0]" is of
the only gyroscope. Such guesses should be checked.
"""

import difflib
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import mujoco

from jaxlfi.envs.mujoco import columns, measured
from jaxlfi.io.units import is_unit

CONTROL = "control"
ALIKE = 0.65
"""Similarity to a signal's name, from 0 to 1, above which an element may have been meant."""
SINGLE = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
QUANTITIES: Mapping[str, frozenset[str]] = {
    CONTROL: frozenset("action actions cmd command commands ctrl control controls u target des desired ref".split()),
    "position": frozenset("pos position positions q qpos angle angles theta pose state".split()),
    "velocity": frozenset("vel velocity velocities speed speeds rate rates dq qd qvel omega".split()),
    "effort": frozenset("effort efforts torque torques tau force forces".split()),
    "gyro": frozenset("gyro gyroscope".split()),
    "acceleration": frozenset("acc accel accelerometer acceleration".split()),
    "orientation": frozenset("quat quaternion orientation rotation".split()),
}
"""Words for each quantity. Several quantities may be meant: the angular velocity of a gyroscope."""
_PHRASES = {"angular velocity": "gyro", "linear acceleration": "accelerometer", "q dot": "qvel", "set point": "target"}
_FILLERS = frozenset(
    "joint motor actuator sensor body link measured meas actual act observation data states msg".split()
)
_AXES = {3: "xyz", 4: "wxyz"}
_TYPES = {
    "position": "JOINTPOS ACTUATORPOS TENDONPOS FRAMEPOS",
    "velocity": "JOINTVEL ACTUATORVEL TENDONVEL FRAMELINVEL FRAMEANGVEL VELOCIMETER",
    "effort": "JOINTACTFRC ACTUATORFRC TENDONACTFRC FORCE TORQUE",
    "gyro": "GYRO",
    "acceleration": "ACCELEROMETER FRAMELINACC",
    "orientation": "FRAMEQUAT BALLQUAT",
}
_MEASURES = {
    getattr(mujoco.mjtSensor, f"mjSENS_{kind}"): what for what, kinds in _TYPES.items() for kind in kinds.split()
}
_OF_JOINTS = {"position": "qpos", "velocity": "qvel", "effort": "effort"}
_UNITS = {"rad": "position", "m": "position", "rad/s": "velocity", "m/s": "velocity", "m/s^2": "acceleration"}


class Place(NamedTuple):
    """The counterpart of a signal in a model.

    Attributes:
        name: as a task calls it, such as "actuator/hip", "angle" and "joint/knee/qpos".
        what: description in words.
        sure: whether the recording uses this name, so that it needs no entry.
        unit: in the signal's name, as in arm_deg; "" if there is none.
    """

    name: str
    what: str
    sure: bool
    unit: str = ""


class _Element(NamedTuple):
    """A number of a model, or a vector of `size` numbers, with the words of its name."""

    name: str
    what: str
    words: frozenset[str]
    quantity: str
    size: int = 1


class _Name(NamedTuple):
    """A signal's name in words: the distinctive ones, all, its possible quantities, and its place in a vector."""

    words: frozenset[str]
    every: frozenset[str]
    quantities: tuple[str, ...]
    base: str
    number: int | None


def places(model: mujoco.MjModel, names: Mapping[str, str], where: str = "recording") -> dict[str, Place | None]:
    """The counterpart of each signal in a model, or None.

    Args:
        model: as compiled.
        names: of the signals, with their SI units or "".
        where: source of the signals, for messages.

    Raises:
        ValueError: for two signals of one name, in one line.
    """
    actuators, sensors = ([one(i).name for i in range(count)] for one, count in _named(model))
    called = columns.called(list(names), where, actuators, sensors)
    found: dict[str, Place | None] = {name: _sure(model, called[name], [*actuators, *sensors]) for name in names}
    taken = {place.name for place in found.values() if place}
    read = {name: _read(name, unit) for name, unit in names.items()}
    elements = list(_elements(model))
    guesses = _vectors(model, read, elements) | _axes(read, elements)
    for name, place in found.items():
        guess = guesses.get(name) or _scalar(read[name], elements)
        if place is None and guess is not None and guess.name not in taken:
            found[name] = guess
            taken.add(guess.name)
    return found | _driving(model, found)


def nearest(model: mujoco.MjModel, name: str, count: int = 3) -> list[str]:
    """The model's controls, sensors and joints whose names are most similar to a signal's, or share a word with it."""
    known = {one: one for one in [*columns.controls_of(model), *measured.signals_of(model)]}
    known |= {f"joint/{joint}/qpos": joint for joint in _joints(model)}
    words = _words(name.rpartition("/")[2])
    scores = {}
    for one, own in known.items():
        others = _words(own)
        shared = set(words) & {word for word in others if word.isalpha()} - _FILLERS
        scores[one] = difflib.SequenceMatcher(None, " ".join(words), " ".join(others)).ratio() + bool(shared)
    return [one for one in sorted(known, key=lambda one: -scores[one]) if scores[one] >= ALIKE][:count]


def _named(model: mujoco.MjModel):
    return (model.actuator, model.nu), (model.sensor, model.nsensor)


def _joints(model: mujoco.MjModel) -> list[str]:
    """Names of hinges and slides."""
    kinds = [mujoco.mjtJoint(kind) for kind in model.jnt_type]
    return [model.joint(i).name for i, kind in enumerate(kinds) if kind in SINGLE and model.joint(i).name]


def _sure(model: mujoco.MjModel, name: str, known: Sequence[str]) -> Place | None:
    base, _, suffix = name.rpartition("_")
    own_base = base in known or measured.JOINT.fullmatch(base)
    if own_base and name not in known and len(suffix) > 1 and is_unit(suffix):
        own = _sure(model, base, known)
        return own and own._replace(unit=suffix)
    if name in (controls := columns.controls_of(model)):
        return Place(name, f"control of actuator {model.actuator(controls.index(name)).name or name}", True)
    if name in measured.signals_of(model):
        return Place(name, f"sensor {name}", True)
    joint, body = measured.JOINT.fullmatch(name), measured.BODY.fullmatch(name)
    if joint and joint["joint"] in _joints(model):
        what = {own: what for what, own in _OF_JOINTS.items()}[joint["what"]]
        return Place(name, f"{what} of joint {joint['joint']}", True)
    if body and body["body"] in [model.body(i).name for i in range(model.nbody)]:
        what = {"pos": "position", "quat": "orientation"}[body["what"]]
        return Place(name, f"{what} of body {body['body']}", True)
    return None


def _driving(model: mujoco.MjModel, found: Mapping[str, Place | None]) -> dict[str, Place | None]:
    """Joint efforts as the controls of motors for which a recording has no controls."""
    taken = {place.name for place in found.values() if place}
    efforts = {place.name: name for name, place in found.items() if place}
    changed: dict[str, Place | None] = {}
    for i, control in enumerate(columns.controls_of(model)):
        effort = efforts.get(f"joint/{_joint_of(model, i)}/effort")
        motor = mujoco.mjtBias(model.actuator_biastype[i]) == mujoco.mjtBias.mjBIAS_NONE
        if effort is not None and control not in taken and motor:
            changed[effort] = Place(control, f"control of actuator {model.actuator(i).name or i}", False)
            taken.add(control)
    return changed


def _words(text: str) -> list[str]:
    """A name in words: letters and digits apart, "shoulderPan2" as "shoulder", "pan" and "2"."""
    found = [word.casefold() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", text)]
    plain = f" {' '.join(found)} "
    for phrase, word in _PHRASES.items():
        plain = plain.replace(f" {phrase} ", f" {word} ")
    return plain.split()


def _read(name: str, unit: str) -> _Name:
    match = re.fullmatch(r"(?P<base>.+?)(?:\[(?P<index>\d+)\]| (?P<number>\d+))", name)
    base, number = (name, None) if match is None else (match["base"], int(match["index"] or match["number"]))
    words = _words(base)
    said = [what for what, several in QUANTITIES.items() if several & set(words)]
    # A topic of actions has target positions, and a unit tells as much as a word.
    if CONTROL in said:
        said = [CONTROL]
    elif not said and unit in _UNITS:
        said = [_UNITS[unit]]
    quantity = frozenset().union(*QUANTITIES.values())
    return _Name(frozenset(words) - quantity - _FILLERS, frozenset(words), tuple(said), base, number)


def _elements(model: mujoco.MjModel) -> Iterator[_Element]:
    """All that a recording may have of a model: controls, sensors, joints and bodies."""
    quantity = frozenset().union(*QUANTITIES.values())
    own = lambda name: frozenset(_words(name)) - quantity - _FILLERS or frozenset(_words(name))
    driven = Counter(_joint_of(model, i) for i in range(model.nu))
    for i, name in enumerate(columns.controls_of(model)):
        what = f"control of actuator {model.actuator(i).name or i}"
        yield _Element(name, what, own(name), CONTROL)
        if (joint := _joint_of(model, i)) and driven[joint] == 1:
            yield _Element(name, what, own(joint), CONTROL)
    for i in range(model.nsensor):
        sensor = model.sensor(i)
        name = sensor.name or f"sensor/{i}"
        what, size = _MEASURES.get(mujoco.mjtSensor(sensor.type[0]), ""), int(sensor.dim[0])
        yield _Element(name, f"sensor {name}", own(name), what, size)
    for joint in _joints(model):
        for what, attribute in _OF_JOINTS.items():
            yield _Element(f"joint/{joint}/{attribute}", f"{what} of joint {joint}", own(joint), what)
    for i in range(1, model.nbody):
        if body := model.body(i).name:
            yield _Element(f"body/{body}/pos", f"position of body {body}", own(body), "position", 3)
            yield _Element(f"body/{body}/quat", f"orientation of body {body}", own(body), "orientation", 4)


def _joint_of(model: mujoco.MjModel, actuator: int) -> str:
    """The name of the joint that an actuator moves; "" where it moves none."""
    of_joints = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    if mujoco.mjtTrn(model.actuator_trntype[actuator]) not in of_joints:
        return ""
    return model.joint(int(model.actuator_trnid[actuator, 0])).name


def _scalar(read: _Name, elements: Sequence[_Element]) -> Place | None:
    """The only scalar element whose words a name has: exactly those, or further ones if it names a quantity."""
    if read.number is not None:
        return None
    fitting = [one for one in elements if one.size == 1 and _names(read, one.words)]
    if read.quantities:
        fitting = [one for one in fitting if one.quantity in _meant(read.quantities)]
    else:
        fitting = [one for one in fitting if one.words in (read.words, read.every)]
    most = max((len(one.words) for one in fitting), default=0)
    fitting = [one for one in fitting if len(one.words) == most]
    for quantity in _meant(read.quantities) or ("position", CONTROL, "velocity", "effort"):
        if of_it := [one for one in fitting if one.quantity == quantity]:
            same = of_it[0].name.startswith(("joint/", "body/")) or len({one.name for one in _plain(of_it)}) == 1
            return Place(of_it[0].name, of_it[0].what, False) if same else None
    return None


def _names(read: _Name, words: frozenset[str]) -> bool:
    """Whether a name has an element's words; a word such as "motor" counts only if the name has no others."""
    return bool(words) and (words <= read.words or (not read.words and words <= read.every))


def _meant(quantities: Sequence[str]) -> tuple[str, ...]:
    """What words may mean, the likeliest first: a torque is measured, or the control of what applies it."""
    return (*quantities, CONTROL) if "effort" in quantities and CONTROL not in quantities else tuple(quantities)


def _plain(elements: Sequence[_Element]) -> list[_Element]:
    """Without joints and bodies where a sensor measures the same."""
    own = [one for one in elements if not one.name.startswith(("joint/", "body/"))]
    return own or list(elements)


def _vectors(model: mujoco.MjModel, read: Mapping[str, _Name], elements: Sequence[_Element]) -> dict[str, Place | None]:
    """Numbers of vectors, as "q[0]" and "action 3": all of a model's, or those of a sensor or body."""
    groups: dict[str, dict[int, str]] = {}
    for name, one in read.items():
        if one.number is not None:
            groups.setdefault(one.base, {})[one.number] = name
    found: dict[str, Place | None] = {}
    for group in groups.values():
        if sorted(group) != list(range(len(group))):
            continue
        one = read[group[0]]
        whole = _whole(model, one, len(group)) or _numbers_of(one, len(group), elements)
        found |= {group[i]: place for i, place in enumerate(whole)}
    return found


def _axes(read: Mapping[str, _Name], elements: Sequence[_Element]) -> dict[str, Place | None]:
    """Numbers of vectors by their axes, as "cube.position/x" and "imu_gyro_z"."""
    groups: dict[str, dict[str, str]] = {}
    for name in read:
        if match := re.fullmatch(r"(.+)[/._ ]([xyzw])", name):
            groups.setdefault(match[1], {})[match[2]] = name
    found: dict[str, Place | None] = {}
    for base, group in groups.items():
        axes = _AXES.get(len(group), "")
        if axes and set(axes) == set(group):
            whole = _numbers_of(_read(base, ""), len(axes), elements)
            found |= {group[axis]: place for axis, place in zip(axes, whole, strict=False)}
    return found


def _whole(model: mujoco.MjModel, read: _Name, count: int) -> list[Place | None]:
    """A vector of all controls, positions or velocities, or of positions and velocities, of a model."""
    controls: list[Place | None] = [
        Place(name, f"control of actuator {model.actuator(i).name or i}", False)
        for i, name in enumerate(columns.controls_of(model))
    ]
    positions, velocities = list(_coordinates(model, "qpos")), list(_coordinates(model, "qvel"))
    vectors: Mapping[str, list[Place | None]] = {CONTROL: controls, "position": positions, "velocity": velocities}
    for quantity in read.quantities:
        if read.words and quantity != CONTROL:
            continue  # of something else than the whole model
        if len(whole := vectors.get(quantity, [])) == count:
            return whole
        if quantity == "position" and count == len(positions) + len(velocities):
            return positions + velocities
        if quantity == "effort" and count == len(controls):
            return controls
    return []


def _coordinates(model: mujoco.MjModel, attribute: str) -> Iterator[Place | None]:
    """The counterpart of each number of a model's qpos or qvel; None where no signal can be it."""
    for i in range(model.njnt):
        joint, kind = model.joint(i).name, mujoco.mjtJoint(model.jnt_type[i])
        what = "position" if attribute == "qpos" else "velocity"
        if kind in SINGLE:
            yield Place(f"joint/{joint}/{attribute}", f"{what} of joint {joint}", False) if joint else None
            continue
        body = model.body(int(model.jnt_bodyid[i])).name
        several = {mujoco.mjtJoint.mjJNT_FREE: (7, 6), mujoco.mjtJoint.mjJNT_BALL: (4, 3)}[kind]
        for k in range(several[attribute == "qvel"]):
            if kind != mujoco.mjtJoint.mjJNT_FREE or attribute == "qvel" or not body:
                yield None
            elif k < 3:
                yield Place(f"body/{body}/pos[{k}]", f"position of body {body}", False)
            else:
                yield Place(f"body/{body}/quat[{k - 3}]", f"orientation of body {body}", False)


def _numbers_of(read: _Name, count: int, elements: Sequence[_Element]) -> list[Place | None]:
    """The numbers of the only sensor or body that a vector can be."""
    fitting = [one for one in elements if one.size == count > 1 and one.quantity in read.quantities]
    named = [one for one in fitting if _names(read, one.words)]
    # By its name, or because the model has only one such sensor.
    for several in (_plain(named), [one for one in fitting if one.what.startswith("sensor")]):
        if len(several) == 1:
            return [Place(f"{several[0].name}[{k}]", several[0].what, False) for k in range(count)]
    return []
