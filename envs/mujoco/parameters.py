"""Uncertain parameters: numbers of a model by element and attribute, as named in MJCF.

| name | what |
|---|---|
| `joint/hinge/damping`, `geom/foot/friction[0]`, `actuator/motor/gear[0]` | attributes of elements |
| `actuator/0/gear[0]` | of the model's first actuator, which needs no name |
| `actuator/servo/kp`, `actuator/servo/kv` | gains of position and velocity servos (`servos`) |
| `body/link/mass`, `body/link/inertia[1]`, `body/link/ipos[0]` | of a body as a whole, even if they follow from geoms |
| `body/link/inertial[0]` to `[9]` | its whole inertia (`inertia`) |
| `joint/*/damping` | of all joints, with a `tie` that says what one number means for them (`ties`) |
| `option/gravity[0]` | of the whole model |
| `initial/hinge/qpos`, `initial/hinge/qvel`, `initial/box/qpos[2]` | the state that episodes begin in |
| `episode/1/initial/hinge/qpos` | that of the second episode only |
| `sensor/angle/bias`, `sensor/angle/noise` | what a sensor adds: an offset, and the standard deviation of its noise |
| `sensor/angle/gain`, `sensor/angle/delay` | the factor of a sensor, and its delay in seconds |
| `control/delay` | seconds after which a control acts |
| `clock/jitter` | the standard deviation, in seconds, of the times at which controls act |

Every simulation compiles a model of its own, so that everything that depends on a number is derived from it. A body's
mass scales its inertia, as another density would.
"""

import dataclasses
import difflib
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from jaxlfi.envs.mujoco import servos

KINDS = ("body", "joint", "geom", "site", "actuator", "tendon", "equality", "pair")
"""Elements of models whose attributes can be inferred."""
INERTIAL = ("mass", "inertia", "ipos", "iquat")
"""Attributes of a body that may follow from its geoms."""
PATTERN = re.compile(r"[*?]")
TIES = ("shared", "scaled", "mirrored")
AT_LEAST_ZERO = re.compile(r"sensor/.+/(delay|noise)|clock/jitter")
"""Parameters that cannot be below 0."""
FORM = re.compile(r"(?P<element>.+)/(?P<attribute>[a-z_]+)(?:\[(?P<index>\d+)\])?")


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A number that is inferred.

    Attributes:
        name: see above.
        support: its bounds in Theta_0.
        feasible: its bounds in Phi; by default those of Theta_0, which then cannot grow.
        unit: for tables and plots.
        log: whether its logarithm is inferred.
        truth: true value, if known.
        tie: what the number means for each of several elements that the name matches (`ties`).

    Raises:
        ValueError: for reversed bounds, a support that is not within Phi, and an unknown tie.
    """

    name: str
    support: tuple[float, float]
    feasible: tuple[float, float] | None = None
    unit: str = ""
    log: bool = False
    truth: float | None = None
    tie: str | Mapping[str, float] | None = None

    def __post_init__(self):
        if (PATTERN.search(self.name) and not self.tie) or (self.tie not in (None, *TIES) and not _factors(self.tie)):
            expected = f"{', '.join(TIES)} or a factor for each pattern"
            raise ValueError(f"parameters: {self.name!r}: tie: expected {expected}, got {self.tie or 'none'}")
        for label, bounds in (("support", self.support), ("feasible", self.feasible or self.support)):
            if not (len(bounds) == 2 and bounds[0] < bounds[1]):  # also refuses NaN
                raise ValueError(f"parameters: {self.name!r}: {label}: expected LOW below HIGH, got {list(bounds)}")
        (low, high), (least, most) = self.support, self.feasible or self.support
        if least < 0 and AT_LEAST_ZERO.fullmatch(self.name):
            raise ValueError(f"parameters: {self.name!r}: expected bounds of at least 0, got [{least:g}, {most:g}]")
        if low < least or high > most:
            raise ValueError(
                f"parameters: {self.name!r}: support: expected bounds within feasible, [{least:g}, {most:g}], "
                f"got [{low:g}, {high:g}]"
            )


@dataclasses.dataclass(frozen=True)
class Edit:
    """A function that sets a value in a model's specification."""

    name: str
    apply: Callable[[mujoco.MjSpec, float], None]


def edit(spec: mujoco.MjSpec, model: mujoco.MjModel, name: str) -> Edit:
    """The function that sets an attribute of an element.

    Args:
        spec: of the model.
        model: as compiled, unchanged.
        name: "KIND/ELEMENT/attribute", with [index] for one of several numbers.

    Raises:
        ValueError: for a name that matches nothing, or several numbers, or no number, in one line.
    """
    match = FORM.fullmatch(name)
    if match is None:
        raise ValueError(f"parameters: expected names as joint/hinge/damping or geom/foot/friction[0], got {name!r}")
    element, attribute = match["element"], match["attribute"]
    index = None if match["index"] is None else int(match["index"])
    found = _found(spec, element, name)
    if element == "body/world":
        raise ValueError(f"parameters: {name!r}: expected a body that moves, got the world")
    if element.startswith("body/") and attribute in INERTIAL:
        return _inertial(model, element.partition("/")[2], attribute, index, name)
    if element.startswith("actuator/"):
        servos.check_whole(found, attribute, index, name)
        if attribute in servos.GAINS:
            return Edit(name, lambda spec, number: servos.set_gain(_found(spec, element, name), attribute, number))
    value = getattr(found, attribute, None) if not attribute.startswith("_") else None
    if not _is_number(value):
        known = [other for other in dir(found) if _is_number(getattr(found, other, None))]
        raise ValueError(f"parameters: {name!r}: expected an attribute {near(attribute, known)}, got {attribute!r}")
    where = place(value, index, name, first=attribute in ("damping", "stiffness"))

    def apply(spec: mujoco.MjSpec, number: float) -> None:
        target = _found(spec, element, name)
        if where is None:
            setattr(target, attribute, number)
        else:
            values = np.array(getattr(target, attribute), float)
            values[where] = number
            setattr(target, attribute, values)

    return Edit(name, apply)


def _found(spec: mujoco.MjSpec, element: str, name: str) -> Any:
    """The element of a specification that a parameter is of."""
    if element == "option":
        return spec.option
    kind, _, own = element.partition("/")
    if kind not in KINDS or not own:
        raise ValueError(f"parameters: {name!r}: expected one that begins with {near(kind, [*KINDS, 'option'])}")
    found = getattr(spec, kind)(own)
    if found is None and kind == "actuator" and own.isdecimal() and int(own) < len(spec.actuators):
        return spec.actuators[int(own)]  # it may be unnamed
    if found is None:
        names = [one.name for one in elements(spec, kind) if one.name]
        raise ValueError(f"parameters: {name!r}: expected a {kind} {near(own, names)}, got {own!r}")
    return found


def elements(spec: mujoco.MjSpec, kind: str) -> Sequence[Any]:
    """All elements of a kind."""
    return getattr(spec, {"body": "bodies", "equality": "equalities"}.get(kind, f"{kind}s"))


def value(spec: mujoco.MjSpec, model: mujoco.MjModel, name: str) -> float:
    """The model's own value of the number that a parameter sets (`edit` refuses other names)."""
    match = FORM.fullmatch(name)
    if match is None:
        raise ValueError(f"parameters: expected names as joint/hinge/damping, got {name!r}")
    element, attribute, index = match["element"], match["attribute"], int(match["index"] or 0)
    found = _found(spec, element, name)
    if element.startswith("body/") and attribute in INERTIAL:
        return float(np.ravel(getattr(model.body(found.name), attribute))[index])
    if element.startswith("actuator/") and attribute in servos.GAINS:
        own, where, sign = servos.places(found)[attribute][0]
        return sign * float(getattr(found, own)[where])
    return float(np.ravel(getattr(found, attribute))[index])


def key(spec: mujoco.MjSpec, name: str) -> tuple:
    """A key of the number that a parameter sets, whatever name is used (`edit` refuses other names)."""
    match = FORM.fullmatch(name)
    if match is None or match["element"] == "option":
        return (name,)
    kind, _, own = match["element"].partition("/")
    names = [one.name for one in elements(spec, kind)]
    number = names.index(own) if own in names else int(own)
    return kind, names[number] or own, match["attribute"], int(match["index"] or 0)


def _factors(tie: Any) -> bool:
    return isinstance(tie, Mapping) and all(
        isinstance(one, int | float) and not isinstance(one, bool) for one in tie.values()
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, float) or (isinstance(value, np.ndarray) and value.dtype.kind == "f")


def place(value: Any, index: int | None, name: str, first: bool = False) -> int | None:
    """Index of a parameter in an attribute; of the coefficients of a joint's damping, the first is the damping."""
    count = np.size(value)
    if not isinstance(value, np.ndarray):
        if index is not None:
            raise ValueError(f"parameters: {name!r}: expected no index, as it is a single number")
        return None
    if index is None and (first or count == 1):
        return 0
    if index is None:
        raise ValueError(f"parameters: {name!r}: expected one of its {count} numbers, as {name}[0], got all of them")
    if index >= count:
        raise ValueError(f"parameters: {name!r}: expected an index from 0 to {count - 1}, got {index}")
    return index


def _inertial(model: mujoco.MjModel, body: str, attribute: str, index: int | None, name: str) -> Edit:
    """The edit of one number of a body's inertial frame, which is made explicit, otherwise as compiled."""
    compiled = model.body(body)
    own = {key: np.array(getattr(compiled, key)) for key in INERTIAL}
    if own["mass"][0] <= 0 and attribute != "mass":
        raise ValueError(f"parameters: {name!r}: expected a body that has a mass, got one without")
    where = place(own[attribute] if attribute != "mass" else float(own["mass"][0]), index, name)

    def apply(spec: mujoco.MjSpec, number: float) -> None:
        target = spec.body(body)
        if not target.explicitinertial:
            make_explicit(target, own)
        if attribute == "mass":
            target.inertia = np.array(target.inertia) * (number / target.mass if target.mass > 0 else 1.0)
            target.mass = number
        else:
            values = np.array(getattr(target, attribute))
            values[where] = number
            setattr(target, attribute, values)

    return Edit(name, apply)


def make_explicit(body: mujoco.MjsBody, own: Mapping[str, np.ndarray]) -> None:
    """Give a body its inertial frame explicitly.

    Args:
        body: of a specification.
        own: the numbers of `INERTIAL` by name, as compiled.
    """
    for key in INERTIAL:
        setattr(body, key, float(own[key][0]) if key == "mass" else own[key])
    body.explicitinertial = True
    body.fullinertia = np.full((6, 1), np.nan)  # states the same as `inertia` and `iquat`


def check_effect(spec: mujoco.MjSpec, one: Edit, support: tuple[float, float]) -> None:
    """Refuse a parameter that the compiled model does not depend on.

    Raises:
        ValueError: naming it.
    """
    compiled = []
    for number in support:
        changed = spec.copy()
        one.apply(changed, number)
        try:
            compiled.append(changed.compile())
        except ValueError as error:
            raise ValueError(
                f"parameters: {one.name!r}: MuJoCo refuses a model with {number:g}: {' '.join(str(error).split())}"
            ) from error
    if saved(compiled[0]) == saved(compiled[1]):
        raise ValueError(
            f"parameters: {one.name!r}: expected a number that the model depends on: it is the same with "
            f"{support[0]:g} and {support[1]:g} (another attribute may override it, as an explicit inertial "
            "overrides a density)"
        )


def saved(model: mujoco.MjModel) -> bytes:
    """A compiled model as bytes."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def near(got: str, known: Sequence[str]) -> str:
    """The known names that are most similar to the given one."""
    near = difflib.get_close_matches(got, known, 4, 0.4) or sorted(known)[:8]
    return f"such as {', '.join(near)}" if near else "(there are none with a name)"
