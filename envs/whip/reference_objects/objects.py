"""The four objects that stand in for the real DLOs (section VI-B, table I)."""

import dataclasses
import functools
import json
from pathlib import Path

SECTION = 0.015
"""Side of a DLO's square section, in m."""
LIGHT = 75.0
"""Density of inference's median DLO, in kg/m^3. Real ones are thirteen times heavier."""
FILE = Path(__file__).parents[1] / "data" / "objects.json"
"""Their calibrated properties, with what was measured of them."""


@dataclasses.dataclass(frozen=True)
class Object:
    """A DLO of silicone.

    Attributes:
        name: for files.
        hardness: on the Shore scale of the real one.
        length: at rest, in m.
        mass: in kg.
        effective_young: Young's modulus of the beam that bends as it does, in Pa.
        young: of the material of its finite elements, in Pa.
        damping: its viscosity over its modulus, in s.
        poisson: its Poisson's ratio.
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
        """In kg/m^3."""
        return self.mass / (SECTION**2 * self.length)

    @property
    def light_young(self) -> float:
        """Young's modulus of the DLO of 75 kg/m^3 that hangs and swings alike, in Pa: what inference may find.

        How a DLO moves without contact depends on its modulus over its density only.
        """
        return self.effective_young * LIGHT / self.density


MEDIUM_SOFT = {"hardness": "A-40", "effective_young": 1.4e6, "young": 1.4e6, "damping": 0.010}
SOFT = {"hardness": "00-50", "effective_young": 2e5, "young": 2e5, "damping": 0.015}
EXTRA_SOFT = {"hardness": "00-20", "effective_young": 1e5, "young": 1e5, "damping": 0.020}
"""Silicones. The paper has no moduli: these are ordered as the hardnesses, and of the size that such silicones have."""

TABLE = (
    Object("dlo-0", length=0.200, mass=0.04747, **MEDIUM_SOFT),
    Object("dlo-1", length=0.200, mass=0.04294, **EXTRA_SOFT),
    Object("dlo-2", length=0.270, mass=0.05780, **SOFT),
    Object("dlo-3", length=0.290, mass=0.06394, **EXTRA_SOFT),
)
"""Lengths, hardnesses and masses of table I, before calibration finds the modulus of the finite elements.

To inference, whose DLOs are light, they are as 100, 8, 16 and 8 kPa: object 0 is outside of the initial support, the
others are inside.
"""


@functools.cache
def load(name: str) -> Object:
    """One of the calibrated objects, "dlo-0" to "dlo-3".

    Raises:
        ValueError: for another name.
    """
    known = json.loads(FILE.read_text())["objects"]
    if name not in known:
        raise ValueError(f"name: expected one of {', '.join(known)}, got {name!r}")
    return Object(**{field.name: known[name][field.name] for field in dataclasses.fields(Object)})
