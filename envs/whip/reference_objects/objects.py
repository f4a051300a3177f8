"""The four FEM reference objects, one for each real DLO of section VI-B, table I."""

import dataclasses
import functools
import json
from pathlib import Path

from jaxlfi.envs.whip.rig import SECTION

LIGHT = 75.0
"""Density of the median DLO of inference, in kg/m^3. Real DLOs are thirteen times denser."""
FILE = Path(__file__).parents[1] / "data" / "objects.json"
"""The calibrated properties of the objects, and the measurements they follow from."""


@dataclasses.dataclass(frozen=True)
class ReferenceObject:
    """A DLO of silicone.

    Attributes:
        name: in file names.
        hardness: of the real DLO, on the Shore scale.
        length: at rest, in m.
        mass: in kg.
        effective_young: Young's modulus of the beam that bends alike, in Pa.
        young: Young's modulus of the finite elements, in Pa.
        damping: viscosity of the finite elements over their modulus, in s.
        poisson: Poisson's ratio of the finite elements.
    """

    name: str
    hardness: str
    length: float
    mass: float
    effective_young: float
    young: float
    damping: float
    poisson: float = 0.35

    @property
    def density(self) -> float:
        """Density in kg/m^3."""
        return self.mass / (SECTION**2 * self.length)

    @property
    def light_young(self) -> float:
        """Young's modulus of a DLO of 75 kg/m^3 that hangs and swings alike, in Pa, which inference should find.

        Without contact, the motion of a DLO depends on the ratio of its modulus to its density only.
        """
        return self.effective_young * LIGHT / self.density


MEDIUM_SOFT = {"hardness": "A-40", "effective_young": 1.4e6, "young": 1.4e6, "damping": 0.010}
SOFT = {"hardness": "00-50", "effective_young": 2e5, "young": 2e5, "damping": 0.015}
EXTRA_SOFT = {"hardness": "00-20", "effective_young": 1e5, "young": 1e5, "damping": 0.020}
"""Silicones. The paper gives no moduli: these have the order of the hardnesses and the magnitude of such silicones."""

TABLE = (
    ReferenceObject("dlo-0", length=0.200, mass=0.04747, **MEDIUM_SOFT),
    ReferenceObject("dlo-1", length=0.200, mass=0.04294, **EXTRA_SOFT),
    ReferenceObject("dlo-2", length=0.270, mass=0.05780, **SOFT),
    ReferenceObject("dlo-3", length=0.290, mass=0.06394, **EXTRA_SOFT),
)
"""Lengths, hardnesses and masses of table I, before calibration finds the modulus of the finite elements.

The light DLOs of inference that move alike have 100, 8, 16 and 8 kPa: dlo-0 is outside of the initial support, the
others are inside.
"""


@functools.cache
def load(name: str) -> ReferenceObject:
    """One of the calibrated objects, "dlo-0" to "dlo-3".

    Raises:
        ValueError: for another name.
    """
    known = json.loads(FILE.read_text())["objects"]
    if name not in known:
        raise ValueError(f"name: expected one of {', '.join(known)}, got {name!r}")
    return ReferenceObject(**{field.name: known[name][field.name] for field in dataclasses.fields(ReferenceObject)})
