"""The DLO as a chain of rigid links: its elements, and the stiffness, damping and inertia that make them a beam.

A beam of N elements of length h = l / N bends at the middle of each: a stub of h / 2 is clamped in the gripper, N - 1
links of h follow, and a link of h / 2 ends it. Joints at the middle of elements, of stiffness E I / h, make the tip
deflect as beam theory says to second order in h (0.2 % at N = 12); MuJoCo's own cable, whose first element is rigid, is
off by 12 % there.
"""

import dataclasses

import numpy as np

from jaxlfi.envs.whip.rig import GRAVITY, SECTION

SECOND_MOMENT = SECTION**4 / 12
"""Second moment of area of the DLO's section, I = a^4 / 12, in m^4."""


@dataclasses.dataclass(frozen=True)
class Chain:
    """The division of the DLO into links.

    Attributes:
        elements: number of elements N.
        planar: whether links rotate about y only (hinges) or in space (the ball joints of MuJoCo's cable composite).
        retardation: time tau of the Kelvin-Voigt model, the ratio of viscosity to modulus, in s.
        viscosity: part eta_0 of the viscosity that does not depend on the modulus, in Pa s. Without it the softest DLOs
            are hardly damped and become unstable.
    """

    elements: int = 12
    planar: bool = True
    retardation: float = 0.005
    viscosity: float = 60.0

    @property
    def links(self) -> int:
        """Number of links, the clamped stub included."""
        return self.elements + 1

    @property
    def dofs(self) -> int:
        """Degrees of freedom of a joint."""
        return 1 if self.planar else 3

    @property
    def fractions(self) -> np.ndarray:
        """Lengths of the links as fractions of the DLO's, from the grip on, shape [N + 1]."""
        fractions = np.full(self.links, 1.0 / self.elements)
        fractions[[0, -1]] /= 2
        return fractions

    def stiffness(self, length, young):
        """Stiffness of a joint, E I / h, in N m / rad."""
        return young * SECOND_MOMENT * self.elements / length

    def damping(self, length, young):
        """Damping of a joint, (tau E + eta_0) I / h, in N m s / rad."""
        return self.stiffness(length, self.retardation * young + self.viscosity)


def link_masses(lengths, density):
    """Masses of links of square section, rho a^2 L, in kg."""
    return density * SECTION**2 * lengths


def link_inertias(lengths, density):
    """Moments of inertia of links about their axis and across it, those of a box, in kg m^2."""
    mass = link_masses(lengths, density)
    return mass * SECTION**2 / 6, mass * (SECTION**2 + lengths**2) / 12


def elasto_gravity(length, young, density):
    """The elasto-gravity number rho g A l^3 / (E I): at 1,000 a DLO hangs like a rope, at 1 it is stiff as a rod."""
    return density * GRAVITY * SECTION**2 * length**3 / (young * SECOND_MOMENT)
