"""The beam that a soft body is equivalent to: its effective Young's modulus and its stretch, measured at rest."""

import dataclasses
from typing import Any

import mujoco
import numpy as np

from jaxlfi.envs.whip.reference_objects.elastica import heavy_cantilever, number_of_sag
from jaxlfi.envs.whip.reference_objects.objects import ReferenceObject
from jaxlfi.envs.whip.reference_objects.scene import cantilever_model, centreline
from jaxlfi.envs.whip.rig import GRAVITY, SECTION

MODERATE = 5.0
"""Elasto-gravity number of the trial: the sag is half the length, where it is most sensitive to the stiffness."""


@dataclasses.dataclass(frozen=True)
class Calibration:
    """Measurements of one reference object.

    Attributes:
        effective_young: Young's modulus of the beam of 15 x 15 mm that sags as much, in Pa.
        sag, reach: vertical and horizontal position of the horizontal cantilever's tip at the trial's gravity, as
            fractions of the length.
        beam_reach: reach of the beam that sags as much.
        trial_gravity: gravity of the trial, in m/s^2.
        hanging_length: length of the hanging object at the real gravity, in m.
    """

    effective_young: float
    sag: float
    reach: float
    beam_reach: float
    trial_gravity: float
    hanging_length: float


def calibrate(dlo: ReferenceObject) -> Calibration:
    """Measure the static sag of an object as a horizontal cantilever, and its length as it hangs.

    Trilinear cells are too stiff in bending, and their section is that of their nodes, so that the modulus of the
    material is not that of the equivalent beam. At the real gravity soft objects of any modulus hang down nearly
    straight, so the trial has less gravity.
    """
    weight = dlo.density * SECTION**2 * dlo.length**3 / (SECTION**4 / 12)
    trial = MODERATE * dlo.young / weight
    tip = at_rest(dlo, (trial, 0.0, 0.0))[-1]
    sag, reach = float(tip[0]) / dlo.length, -float(tip[2]) / dlo.length
    number = number_of_sag(sag)
    hanging = at_rest(dlo, (0.0, 0.0, -GRAVITY))
    return Calibration(
        effective_young=weight * trial / number,
        sag=sag,
        reach=reach,
        beam_reach=heavy_cantilever(number)[0],
        trial_gravity=trial,
        hanging_length=float(hanging[0, 2] - hanging[-1, 2]),
    )


def calibrated(dlo: ReferenceObject) -> tuple[ReferenceObject, Calibration]:
    """The object with the modulus of its material set such that it has its effective modulus, and its measurements.

    The effective modulus is in proportion to the material's, as the trial's gravity is, so one correction is enough.
    """
    young = dlo.young * dlo.effective_young / calibrate(dlo).effective_young
    dlo = dataclasses.replace(dlo, young=float(f"{young:.4g}"))
    return dlo, calibrate(dlo)


def at_rest(dlo: ReferenceObject, gravity: tuple[float, float, float]) -> np.ndarray:
    """The centreline at rest, in m, shape [P, 3].

    Args:
        dlo: the object; its own damping is not used.
        gravity: in m/s^2, in the frame in which the object hangs along -z from the origin.

    Raises:
        ValueError: where it does not come to rest.
    """
    beat = np.sqrt(dlo.length / np.linalg.norm(gravity))  # time scale of a pendulum
    damped = dataclasses.replace(dlo, damping=beat / 2)
    model = cantilever_model(damped, gravity, timestep=beat / 20)
    before: Any = np.inf
    data = mujoco.MjData(model)
    for _ in range(200):
        mujoco.mj_step(model, data, nstep=10)
        line = centreline(dlo, data)
        if np.abs(line - before).max() < 1e-7:
            return line
        before = line
    raise ValueError(f"dlo: expected an object that comes to rest, got {dlo}")
