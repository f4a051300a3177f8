"""What beam a soft body is like: its effective Young's modulus and its stretch, measured at rest."""

import dataclasses

import mujoco
import numpy as np

from jaxlfi.envs.whip.reference_objects.elastica import heavy_cantilever, number_of_sag
from jaxlfi.envs.whip.reference_objects.objects import SECTION, Object
from jaxlfi.envs.whip.reference_objects.scene import cantilever_model, centreline

GRAVITY = 9.81
MODERATE = 5.0
"""Elasto-gravity number of the trial: the sag is half the length, where it tells most of the stiffness."""


@dataclasses.dataclass(frozen=True)
class Calibration:
    """What was measured of an object.

    Attributes:
        effective_young: modulus of the beam of 15 x 15 mm that sags as much, in Pa.
        sag, reach: of the horizontal cantilever's tip at the trial's gravity, as fractions of the length.
        beam_reach: of the beam that sags as much.
        trial_gravity: in m/s^2.
        hanging_length: in m, at the real gravity.
    """

    effective_young: float
    sag: float
    reach: float
    beam_reach: float
    trial_gravity: float
    hanging_length: float


def calibrate(thing: Object) -> Calibration:
    """Measure the static sag of an object as a horizontal cantilever, and its length as it hangs.

    Trilinear cells are too stiff in bending, and their section is that of their nodes, so the material's modulus is not
    the one of the beam. At the real gravity soft objects hang down nearly straight whatever their modulus, so the trial
    has less of it.
    """
    weight = thing.density * SECTION**2 * thing.length**3 / (SECTION**4 / 12)
    trial = MODERATE * thing.young / weight
    tip = at_rest(thing, (trial, 0.0, 0.0))[-1]
    sag, reach = float(tip[0]) / thing.length, -float(tip[2]) / thing.length
    number = number_of_sag(sag)
    hanging = at_rest(thing, (0.0, 0.0, -GRAVITY))
    return Calibration(
        effective_young=weight * trial / number,
        sag=sag,
        reach=reach,
        beam_reach=heavy_cantilever(number)[0],
        trial_gravity=trial,
        hanging_length=float(hanging[0, 2] - hanging[-1, 2]),
    )


def calibrated(thing: Object) -> tuple[Object, Calibration]:
    """The object with a material such that it has its effective modulus, and what it then measures.

    The effective modulus is in proportion to the material's, as the trial's gravity is, so one correction is enough.
    """
    young = thing.young * thing.effective_young / calibrate(thing).effective_young
    thing = dataclasses.replace(thing, young=float(f"{young:.4g}"))
    return thing, calibrate(thing)


def at_rest(thing: Object, gravity: tuple[float, float, float]) -> np.ndarray:
    """The centreline once nothing moves, in m, shape [P, 3].

    Args:
        thing: its own damping is not used.
        gravity: in m/s^2, in the frame in which the object hangs along -z from the origin.

    Raises:
        ValueError: where it does not come to rest.
    """
    beat = np.sqrt(thing.length / np.linalg.norm(gravity))  # of a pendulum, which it needs a few of
    damped = dataclasses.replace(thing, damping=beat / 2)
    model = cantilever_model(damped, gravity, timestep=beat / 20)
    data, before = mujoco.MjData(model), np.inf
    for _ in range(200):
        mujoco.mj_step(model, data, nstep=10)
        line = centreline(thing, data)
        if np.abs(line - before).max() < 1e-7:
            return line
        before = line
    raise ValueError(f"thing: expected an object that comes to rest, got {thing}")
