"""Lines with bands: the median of several seeds, and where the middle half of them lies."""

import numpy as np
from matplotlib.axes import Axes

from jaxlfi.figures import statistics
from jaxlfi.figures.style import Look


def draw_band(axes: Axes, x: np.ndarray, values: np.ndarray, look: Look) -> None:
    """The median of seeds [seeds, R] over x [R], and a band of their quartiles where they differ; NaN is left out."""
    low, middle, high = statistics.quartiles(values)
    if np.any(high > low):
        axes.fill_between(x, low, high, color=look.colour, alpha=0.16, linewidth=0)
    axes.plot(x, middle, **look.line)


def over(seeds: int, otherwise: str = "one seed", fewest: int | None = None) -> str:
    """What bands show, for a legend's title: of several seeds (of some, the fewest), or of what there is of one."""
    count = f"{seeds}" if fewest in (None, seeds) else f"{fewest} to {seeds}"
    return f"median of {count} seeds, band: quartiles" if seeds > 1 else otherwise
