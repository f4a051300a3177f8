"""Theory of a clamped beam: the Euler-Bernoulli cantilever. The heavy elastica is in `reference_objects.elastica`."""

import numpy as np
from scipy import optimize


def tip_deflection(load: float, length: float, rigidity: float) -> float:
    """Deflection of a cantilever's tip under a small transverse load, P L^3 / (3 E I), in m."""
    return load * length**3 / (3 * rigidity)


def frequency(mode: int, length: float, rigidity: float, line_density: float, gyration: float = 0.0) -> float:
    """Natural frequency of a cantilever, beta^2 sqrt(E I / (rho A L^4)) where cos(beta) cosh(beta) = -1, in rad/s.

    Args:
        mode: number of the mode, 1 for the slowest.
        length: length L, in m.
        rigidity: E I, in N m^2.
        line_density: rho A, in kg/m.
        gyration: radius of gyration of the section, in m; 0 for the Euler-Bernoulli beam. The section's rotary inertia
            lowers the frequency, here to first order by Rayleigh's quotient with the same mode shapes.
    """
    low, high = (mode - 1) * np.pi + 1e-9, mode * np.pi
    beta = optimize.brentq(lambda b: np.cos(b) + 1 / np.cosh(b), low, high, xtol=1e-13)
    turn = beta * (np.sinh(beta) - np.sin(beta)) / (np.cosh(beta) + np.cos(beta))
    rotary = 1 + (gyration / length) ** 2 * turn * (2 + turn)  # mean squared slope over mean squared deflection
    return beta**2 * np.sqrt(rigidity / (line_density * length**4 * rotary))
