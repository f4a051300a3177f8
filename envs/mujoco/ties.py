"""Parameters that act on several elements: patterns as names, and what one number means for each match.

| `tie =` | of `joint/*/damping` |
|---|---|
| `"shared"` | all joints have this damping |
| `"scaled"` | each joint has its own damping times this factor |
| `"mirrored"` | each has this number with the sign of its own, as the two sides of a robot |
| `{ "left*" = 1, "right*" = -1 }` | joints with such names have this number times the factor |

`*` stands for any letters, `?` for one. Free joints, the world, bodies without a mass, and actuators without the gain
are passed over.
"""

import re
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from jaxlfi.envs.mujoco import parameters, servos
from jaxlfi.envs.mujoco.parameters import FORM, INERTIAL, KINDS, Edit, near

Tie = str | Mapping[str, float] | None


def expression(pattern: str) -> re.Pattern[str]:
    """The regular expression of a pattern, in which only `*` and `?` have a special meaning."""
    return re.compile(re.escape(pattern).replace(r"\*", ".*").replace(r"\?", "."))


def edit(spec: mujoco.MjSpec, model: mujoco.MjModel, name: str, tie: Tie) -> tuple[Edit, list[tuple]]:
    """The function that sets an attribute of all elements that a name matches, and the keys of what it sets.

    Args:
        spec: of the model.
        model: as compiled, unchanged.
        name: "KIND/PATTERN/attribute", or of one element.
        tie: what a number means for each.

    Raises:
        ValueError: for a name that matches nothing, in one line.
    """
    several = matches(spec, model, name)
    edits = [(parameters.edit(spec, model, one), _factor(spec, model, one, tie, name)) for one in several]

    def apply(spec: mujoco.MjSpec, number: float) -> None:
        for one, factor in edits:
            one.apply(spec, factor * number)

    only, factor = edits[0]
    whole = only if len(edits) == 1 and factor == 1.0 and only.name == name else Edit(name, apply)
    return whole, [parameters.key(spec, one) for one in several]


def matches(spec: mujoco.MjSpec, model: mujoco.MjModel, name: str) -> list[str]:
    """Names of all parameters that a pattern matches; a name without a pattern matches itself.

    Raises:
        ValueError: for a pattern that matches nothing, in one line.
    """
    if not parameters.PATTERN.search(name):
        return [name]
    match = FORM.fullmatch(name)
    kind, _, pattern = match["element"].partition("/") if match else ("", "", "")
    if match is None or kind not in KINDS:
        raise ValueError(f"parameters: {name!r}: expected a pattern that begins with {near(kind, KINDS)}")
    known = {one.name or str(i): one for i, one in enumerate(parameters.elements(spec, kind))}
    called = [own for own, one in known.items() if _has(model, kind, own, one, match["attribute"])]
    found = [own for own in called if expression(pattern).fullmatch(own)]
    if not found:
        raise ValueError(
            f"parameters: {name!r}: expected a pattern that matches the name of a {kind}, "
            f"{near(pattern, called)}, got {pattern!r}"
        )
    rest = name[len(match["element"]) :]
    return [f"{kind}/{own}{rest}" for own in found]


def _has(model: mujoco.MjModel, kind: str, own: str, element, attribute: str) -> bool:
    """Whether a pattern for all elements includes this element's attribute."""
    if kind == "joint":
        return element.type != mujoco.mjtJoint.mjJNT_FREE
    if kind == "body":
        return own != "world" and (attribute not in INERTIAL or model.body(own).mass[0] > 0)
    return kind != "actuator" or attribute not in servos.GAINS or attribute in servos.places(element)


def _factor(spec: mujoco.MjSpec, model: mujoco.MjModel, one: str, tie: Tie, name: str) -> float:
    """What a number is multiplied by for an element."""
    if tie in (None, "shared"):
        return 1.0
    if isinstance(tie, Mapping):
        match = FORM.fullmatch(one)
        own = (match["element"] if match else one).partition("/")[2]
        found = {float(factor) for pattern, factor in tie.items() if expression(pattern).fullmatch(own)}
        if len(found) != 1:
            got = "none" if not found else "several"
            raise ValueError(f"parameters: {name!r}: tie: expected one factor for {own}, got {got}")
        return found.pop()
    value = parameters.value(spec, model, one)
    if not np.isfinite(value):
        raise ValueError(f"parameters: {name!r}: tie: expected a number of {one} in the model, got none")
    return value if tie == "scaled" else float(np.sign(value))


def refuse_overlaps(keys: Sequence[tuple[str, Sequence[tuple]]]) -> None:
    """Refuse parameters that set the same number.

    Args:
        keys: names of parameters, and the keys of what each sets.

    Raises:
        ValueError: naming two, in one line.
    """
    taken: dict[tuple, str] = {}
    for name, several in keys:
        for key in several:
            if (other := taken.setdefault(key, name)) != name:
                what = "/".join(str(part) for part in key[:3])
                raise ValueError(f"parameters: expected one for each number, got {other!r} and {name!r} of {what}")
