"""Lines with bands over iterations."""

import numpy as np
from matplotlib.axes import Axes

from jaxlfi.figures.style import Look


def draw_band(axes: Axes, x: np.ndarray, middle: np.ndarray, deviation: np.ndarray, look: Look) -> None:
    """A configuration's line, and a band of one `deviation` to either side of it where that is not zero.

    Args:
        axes: to draw on.
        x: shape [R].
        middle: shape [R].
        deviation: standard deviation or error, shape [R].
        look: of the configuration.
    """
    if np.any(deviation > 0):
        axes.fill_between(x, middle - deviation, middle + deviation, color=look.colour, alpha=0.16, linewidth=0)
    axes.plot(x, middle, **look.line)
