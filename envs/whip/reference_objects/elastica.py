"""The heavy elastica: an inextensible beam that sags under its own weight, with large deflections."""

import numpy as np
from scipy.integrate import simpson, solve_bvp
from scipy.optimize import brentq

LIMITS = (0.1, 100.0)
"""Range of elasto-gravity numbers that `number_of_sag` searches."""


def heavy_cantilever(number: float) -> tuple[float, float]:
    """The position of a horizontal cantilever's tip at rest.

    Solves theta'' = -G (1 - s) cos theta with theta(0) = 0 and theta'(1) = 0 for the slope theta downwards along the
    arc s in [0, 1] (Wang, 1986), by continuation in G.

    Args:
        number: the elasto-gravity number G = rho g A L^3 / (E I).

    Returns:
        Horizontal reach and sag of the tip, as fractions of the length.
    """
    arc = np.linspace(0, 1, 201)
    slope = np.stack([number * (1 - (1 - arc) ** 3) / 6, number * (1 - arc) ** 2 / 2]) * min(1, 1 / number)
    for load in np.geomspace(min(1, number), number, 12):
        solution = solve_bvp(
            lambda s, y, load=load: np.stack([y[1], -load * (1 - s) * np.cos(y[0])]),
            lambda start, end: np.array([start[0], end[1]]),
            arc,
            slope,
            tol=1e-7,
            max_nodes=20_000,
        )
        if not solution.success:
            raise ValueError(f"number: expected one whose elastica can be solved for, got {number}: {solution.message}")
        slope = solution.sol(arc)
    return float(simpson(np.cos(slope[0]), x=arc)), float(simpson(np.sin(slope[0]), x=arc))


def number_of_sag(sag: float) -> float:
    """The elasto-gravity number of a cantilever whose tip sags by this fraction of its length.

    Raises:
        ValueError: for sags of numbers outside of 0.1 to 100.
    """
    low, high = (heavy_cantilever(number)[1] for number in LIMITS)
    if not low < sag < high:
        raise ValueError(f"sag: expected a fraction of the length from {low:.3g} to {high:.3g}, got {sag:.3g}")
    excess = lambda log: heavy_cantilever(float(np.exp(log)))[1] - sag
    return float(np.exp(brentq(excess, *np.log(LIMITS), xtol=1e-6)))
