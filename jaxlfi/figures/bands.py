"""Lines with bands: the median and the quartiles of several seeds."""

import numpy as np
from matplotlib.axes import Axes

from jaxlfi.figures import statistics
from jaxlfi.figures.style import Look


def draw_band(axes: Axes, x: np.ndarray, values: np.ndarray, look: Look) -> None:
    """Draw the median of seeds [seeds, R] over x [R], and a band of their quartiles if they differ; NaN is left out."""
    low, middle, high = statistics.quartiles(values)
    if np.any(high > low):
        axes.fill_between(x, low, high, color=look.colour, alpha=0.16, linewidth=0)
    axes.plot(x, middle, **look.line)


def over(seeds: int, otherwise: str = "one seed", fewest: int | None = None) -> str:
    """The meaning of bands, for a legend's title: `fewest` to `seeds` seeds, or `otherwise` for a single one."""
    count = f"{seeds}" if fewest in (None, seeds) else f"{fewest} to {seeds}"
    return f"median of {count} seeds, band: quartiles" if seeds > 1 else otherwise
