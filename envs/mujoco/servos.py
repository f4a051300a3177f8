"""Gains of servos, which are stored in two places of an actuator: with one of them alone it would not be a servo.

MJCF's position servo has the force kp (ctrl - length) - kv velocity, and its velocity servo kv (ctrl - velocity); a
model holds both as `gainprm` and `biasprm`.
"""

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

GAINS = ("kp", "kv")


def places(actuator: Any) -> Mapping[str, tuple[tuple[str, int, float], ...]]:
    """Where an actuator's gains are stored: attributes, indices and signs; none if the actuator is not a servo.

    Args:
        actuator: of a specification.
    """
    gain, bias = actuator.gainprm[0], actuator.biasprm
    affine = actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED and actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE
    if affine and gain != 0 and bias[1] == -gain:
        return {"kp": (("gainprm", 0, 1.0), ("biasprm", 1, -1.0)), "kv": (("biasprm", 2, -1.0),)}
    if affine and gain != 0 and bias[1] == 0 and bias[2] == -gain:
        return {"kv": (("gainprm", 0, 1.0), ("biasprm", 2, -1.0))}
    return {}


def check_whole(actuator: Any, attribute: str, index: int | None, name: str) -> None:
    """Refuse a gain that an actuator does not have, and a part of one.

    Raises:
        ValueError: naming the gain, in one line.
    """
    known = places(actuator)
    if attribute in GAINS and (attribute not in known or index is not None):
        raise ValueError(
            f"parameters: {name!r}: expected kp or kv of a position servo, or kv of a velocity servo, without an index"
        )
    for gain, several in known.items():
        if len(several) > 1 and any((attribute, index or 0) == (own, place) for own, place, _ in several):
            both = " and ".join(f"{own}[{place}]" for own, place, _ in several)
            raise ValueError(
                f"parameters: {name!r}: expected {name.rpartition('/')[0]}/{gain}, which changes {both} of the servo "
                "alike: with one of them alone it does not go where its control says"
            )


def set_gain(actuator: Any, gain: str, number: float) -> None:
    """Give a servo's gain a value.

    Raises:
        ValueError: for a negative one, which MuJoCo would take for a damping ratio.
    """
    if not number >= 0:
        raise ValueError(f"{gain}: expected a gain of at least 0, got {number:g}")
    for attribute, index, sign in places(actuator)[gain]:
        values = np.array(getattr(actuator, attribute), float)
        values[index] = sign * number
        setattr(actuator, attribute, values)
