"""What a clamped beam does in theory: the Euler-Bernoulli cantilever, and the heavy elastica."""

import numpy as np
from scipy import integrate, optimize


def tip_deflection(load: float, length: float, rigidity: float) -> float:
    """Of a cantilever under a small load across its tip, P L^3 / (3 E I), in m."""
    return load * length**3 / (3 * rigidity)


def frequency(mode: int, length: float, rigidity: float, line_density: float, gyration: float = 0.0) -> float:
    """Natural frequency of a cantilever, beta^2 sqrt(E I / (rho A L^4)) where cos(beta) cosh(beta) = -1, in rad/s.

    Args:
        mode: 1 for the slowest.
        length: in m.
        rigidity: E I, in N m^2.
        line_density: rho A, in kg/m.
        gyration: radius of gyration of the section, in m. Euler and Bernoulli's beam has none; the section's rotary
            inertia slows a beam that has, to first order by Rayleigh's quotient with the same mode shapes.
    """
    low, high = (mode - 1) * np.pi + 1e-9, mode * np.pi
    beta = optimize.brentq(lambda b: np.cos(b) + 1 / np.cosh(b), low, high, xtol=1e-13)
    turn = beta * (np.sinh(beta) - np.sin(beta)) / (np.cosh(beta) + np.cos(beta))
    rotary = 1 + (gyration / length) ** 2 * turn * (2 + turn)  # the mode's mean squared slope over that of itself
    return beta**2 * np.sqrt(rigidity / (line_density * length**4 * rotary))


def heavy_elastica(number: float, at: np.ndarray) -> np.ndarray:
    """Shape of a horizontally clamped, inextensible beam that sags under its own weight, in lengths of the beam.

    The angle below the horizontal obeys theta'' = -G (1 - s) cos(theta), theta(0) = 0, theta'(1) = 0, with the
    elasto-gravity number G = rho g A L^3 / (E I). Solved by collocation, from small G on so that it stays on the branch
    that hangs down.

    Args:
        number: G.
        at: arc lengths between 0 and 1, shape [n].

    Returns:
        How far each point lies from the clamp, and how far below it, shape [n, 2].

    Raises:
        RuntimeError: if collocation does not converge.
    """
    arc = np.linspace(0, 1, 51)
    guess = np.stack([np.zeros_like(arc), np.zeros_like(arc), arc, np.zeros_like(arc)])
    for load in np.geomspace(min(0.1, number), number, 12):

        def slope(s, y, load=load):
            return np.stack([y[1], -load * (1 - s) * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])])

        def ends(clamp, tip):
            return np.array([clamp[0], tip[1], clamp[2], clamp[3]])

        solved = integrate.solve_bvp(slope, ends, arc, guess, tol=1e-8, max_nodes=20_000)
        if not solved.success:
            raise RuntimeError(f"heavy_elastica: expected a solution for G = {load:g}, got {solved.message}")
        arc, guess = solved.x, solved.y
    return solved.sol(at)[2:].T
