"""Calibration: ranks of the true parameters among posterior draws, and coverage of credible regions."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxlfi.figures.legends import below as legend_below
from jaxlfi.figures.style import grid_shape, is_wide, parameter_name

COLUMNS = 4
"""Largest number of parameters side by side."""
COLOUR = "#15158B"
BAND = "#8C8C8C"
"""Colours of curves and of bands."""
NARROW, WIDE = 0.45, 0.2
"""Opacities of the pointwise and of the simultaneous band."""
RANKS, COVERAGE, DISTANCE = "ranks_fraction", "coverage_fraction", "distance_fraction"
"""Arrays of cumulative fractions: of ranks, and of truths in highest-density regions and around random points."""

Arrays = Mapping[str, np.ndarray]
"""The arrays of diagnostics.npz."""


def rows(arrays: Arrays) -> int:
    """Number of rows of panels that `draw_ranks` needs, each a histogram above a curve."""
    return grid_shape(len(arrays["names"]), COLUMNS)[0]


def draw_ranks(figure: Figure, arrays: Arrays) -> None:
    """Draw for each parameter a histogram of ranks, and below it their cumulative fraction minus the expected one."""
    names = [str(name) for name in arrays["names"]]
    columns = min(len(names), COLUMNS)
    heights = [1.0, 0.7] * rows(arrays)
    panels = figure.subplots(
        len(heights), columns, squeeze=False, sharex=True, sharey="row", gridspec_kw={"height_ratios": heights}
    )
    for d in range(rows(arrays) * columns):
        above, below = panels[2 * (d // columns), d % columns], panels[2 * (d // columns) + 1, d % columns]
        if d >= len(names):
            above.remove()
            below.remove()
            continue
        draw_histogram(above, arrays, d)
        draw_difference(below, arrays, d)
        above.set_title(parameter_name(names, d))
        if d + columns >= len(names):
            below.set_xlabel("normalised rank of the truth")
            below.tick_params(labelbottom=True)
        if d % columns == 0:
            above.set_ylabel("number of truths")
            below.set_ylabel("ECDF − uniform")
    _legend(figure, "truths", "bin")


def draw_histogram(axes: Axes, arrays: Arrays, d: int) -> None:
    """Draw the number of truths in each bin of ranks, with the binomial band of each bin."""
    edges = arrays["bin_edges"] / arrays["bin_edges"][-1]
    low, high = (np.append(side, side[-1]) for side in arrays["bin_band"])
    axes.fill_between(edges, low, high, step="post", color=BAND, alpha=NARROW, linewidth=0)
    axes.stairs(arrays["bin_count"][d], edges, color=COLOUR, linewidth=1.0, gid="count")
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1.06 * max(arrays["bin_count"].max(), high.max()))  # all parameters share the axis


def draw_difference(axes: Axes, arrays: Arrays, d: int) -> None:
    """Draw the cumulative fraction of ranks minus the level, with its simultaneous band."""
    level = _with_ends(arrays["level"])
    low, high = (_with_ends(side) - level for side in arrays["ranks_simultaneous"])
    axes.fill_between(level, low, high, color=BAND, alpha=WIDE, linewidth=0)
    axes.axhline(0, color="#555555", linewidth=0.6)
    axes.plot(level, _with_ends(arrays[RANKS][d]) - level, color=COLOUR, gid="difference")
    axes.grid(True)


def draw_coverage(figure: Figure, arrays: Arrays) -> None:
    """Expected coverage: the fraction of truths in the highest-density region of each level."""
    _draw_curve(figure, arrays, COVERAGE, "level of the highest-density region", "fraction of truths inside")


def draw_tarp(figure: Figure, arrays: Arrays) -> None:
    """TARP: the fraction of truths in the region of each level around random points."""
    _draw_curve(figure, arrays, DISTANCE, "level of the region around a random point", "fraction of truths inside")


def _draw_curve(figure: Figure, arrays: Arrays, name: str, xlabel: str, ylabel: str) -> None:
    axes = figure.subplots()
    level = _with_ends(arrays["level"])
    for band, opacity in (("simultaneous", WIDE), ("pointwise", NARROW)):
        low, high = (_with_ends(side) for side in arrays[band])
        axes.fill_between(level, low, high, color=BAND, alpha=opacity, linewidth=0)
    axes.plot([0, 1], [0, 1], color="#555555", linewidth=0.6)
    axes.plot(level, _with_ends(arrays[name]), color=COLOUR, gid="fraction")
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel=xlabel, ylabel=ylabel)
    axes.set_aspect("equal")
    axes.grid(True)
    _legend(figure, "this run's method", "level")


def _with_ends(values: np.ndarray) -> np.ndarray:
    """The values with 0 prepended and 1 appended."""
    return np.concatenate([[0.0], values, [1.0]])


def _legend(figure: Figure, drawn: str, unit: str) -> None:
    handles = [
        Line2D([], [], color=COLOUR, label=drawn),
        Patch(color=BAND, alpha=NARROW, linewidth=0, label=f"95 % band of a calibrated method, each {unit}"),
        Patch(color=BAND, alpha=WIDE, linewidth=0, label="99 % band of a calibrated method, whole curve"),
    ]
    legend_below(figure, handles, at_most=3 if is_wide(figure) else 1)
