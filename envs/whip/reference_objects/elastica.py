"""The heavy elastica: an inextensible beam that sags under its own weight, with large deflections."""

import numpy as np
from scipy import integrate, optimize

LIMITS = (0.1, 100.0)
"""Range of elasto-gravity numbers that `number_of_sag` searches."""


def heavy_elastica(number: float, at: np.ndarray) -> np.ndarray:
    """Shape of a horizontally clamped, inextensible beam that sags under its own weight, in lengths of the beam.

    Solves theta'' = -G (1 - s) cos theta with theta(0) = 0 and theta'(1) = 0 for the slope theta downwards along the
    arc s in [0, 1] (Wang, 1986) by collocation. Continuation in G keeps it on the branch that hangs down.

    Args:
        number: the elasto-gravity number G = rho g A L^3 / (E I).
        at: arc lengths between 0 and 1, shape [n].

    Returns:
        The distance of each point from the clamp, horizontally and downwards, shape [n, 2].

    Raises:
        ValueError: if collocation does not converge.
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
            raise ValueError(f"number: expected one whose elastica can be solved for, got {number}: {solved.message}")
        arc, guess = solved.x, solved.y
    return solved.sol(at)[2:].T


def heavy_cantilever(number: float) -> tuple[float, float]:
    """Horizontal reach and sag of a horizontal cantilever's tip, as fractions of the length; see `heavy_elastica`."""
    reach, sag = heavy_elastica(number, np.ones(1))[0]
    return float(reach), float(sag)


def number_of_sag(sag: float) -> float:
    """The elasto-gravity number of a cantilever whose tip sags by this fraction of its length.

    Raises:
        ValueError: for sags of numbers outside of 0.1 to 100.
    """
    low, high = (heavy_cantilever(number)[1] for number in LIMITS)
    if not low < sag < high:
        raise ValueError(f"sag: expected a fraction of the length from {low:.3g} to {high:.3g}, got {sag:.3g}")
    excess = lambda log: heavy_cantilever(float(np.exp(log)))[1] - sag
    return float(np.exp(optimize.brentq(excess, *np.log(LIMITS), xtol=1e-6)))
