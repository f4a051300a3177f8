"""Intervals: how often posterior intervals covered the truth, and the factor by which their widths are wrong."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxlfi.figures.legends import below as legend_below
from jaxlfi.figures.natural import scale_ticks
from jaxlfi.figures.style import SET_COLOURS, parameter_name

MARKERS = ("o", "s")
"""Markers of the references."""
APART = 0.18
"""Distance between the marks of two references for one parameter, in rows."""
REACH = 10.0
"""Largest width factor that is drawn; the smallest is its inverse, and unbounded intervals extend beyond."""


def height(arrays: Mapping[str, np.ndarray]) -> float:
    """Height in inches that `draw` needs."""
    return 1.2 + 0.32 * (arrays["widths_held"].shape[1] + 1)


def draw(figure: Figure, arrays: Mapping[str, np.ndarray]) -> None:
    """Draw the fraction of truths inside intervals of each level (left), and the factors of their widths (right)."""
    left, right = figure.subplots(1, 2, sharey=True)
    names = [str(name) for name in arrays["names"]]
    references = [str(reference) for reference in arrays["widths_reference"]]
    held = np.concatenate([arrays["widths_held"], arrays["widths_regions_held"][:, None]], axis=1)
    for level in arrays["widths_level"]:
        left.axvline(level, color="#555555", linewidth=0.6)
    right.axvline(1, color="#555555", linewidth=0.6)
    for r in range(len(references)):
        shift = APART * (r - (len(references) - 1) / 2)
        look = {"marker": MARKERS[r % len(MARKERS)], "color": SET_COLOURS[r]}
        for place in range(len(arrays["widths_level"])):
            _marks(left, held[r, :, place], shift, look, f"held-{r}-{place}")
        _marks(right, np.clip(arrays["widths_factor"][r], 1 / (1.2 * REACH), 1.2 * REACH), shift, look, f"factor-{r}")
    left.set(xlim=(-0.02, 1.02), xlabel="fraction of truths inside")
    left.set_title(" and ".join(f"{100 * level:.0f} %" for level in arrays["widths_level"]) + " intervals")
    right.set_xscale("log")
    inside = arrays["widths_factor"][np.isfinite(arrays["widths_factor"])]
    reach = np.clip(1.15 * max(2.0, inside.max(initial=1.0), 1 / max(inside.min(initial=1.0), 1 / REACH)), 2.0, REACH)
    right.set(xlim=(1 / reach, reach), xlabel="right width / theirs: above 1 too narrow, below 1 too wide")
    scale_ticks(right.xaxis, 6)
    right.set_title(f"how many times as wide {100 * arrays['widths_level'][-1]:.0f} % intervals should be")
    left.set_yticks(range(len(names) + 1), [*(parameter_name(names, d) for d in range(len(names))), "all together"])
    left.set_ylim(len(names) + 0.5, -0.5)
    for axes in (left, right):
        axes.grid(True, axis="x")
    handles = [
        Line2D([], [], linestyle="none", marker=MARKERS[r % len(MARKERS)], color=SET_COLOURS[r], label=reference)
        for r, reference in enumerate(references)
    ]
    legend_below(figure, handles)


def _marks(axes: Axes, estimates: np.ndarray, shift: float, look: Mapping[str, str], gid: str) -> None:
    """Draw estimates [n, 3] with their intervals, one per row."""
    value, low, high = estimates.T
    rows = np.arange(len(value)) + shift
    axes.hlines(rows, low, high, color=look["color"], linewidth=0.9)
    axes.plot(value, rows, linestyle="none", gid=gid, **look)
