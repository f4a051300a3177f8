"""Lines with bands over iterations."""

import numpy as np
from matplotlib.axes import Axes

from jaxlfi.figures.style import Look


def draw_band(axes: Axes, x: np.ndarray, middle: np.ndarray, deviation: np.ndarray, look: Look) -> None:
    """A configuration's line over x, with a band of one deviation to either side where there is one; all [R]."""
    if np.any(deviation > 0):
        axes.fill_between(x, middle - deviation, middle + deviation, color=look.colour, alpha=0.16, linewidth=0)
    axes.plot(x, middle, **look.line)
