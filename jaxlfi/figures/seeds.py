"""One result of every seed, by configuration."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxlfi.figures.legends import above
from jaxlfi.figures.natural import scale_ticks
from jaxlfi.figures.style import GREY, looks


def draw(figure: Figure, values: Mapping[str, np.ndarray], label: str) -> None:
    """Draw strips of points with boxes on a logarithmic scale; mean and median are marked."""
    axes = figure.subplots()
    draw_strips(axes, values)
    axes.set_ylabel(label)
    handles = [
        Line2D([], [], marker="o", markersize=3, color=GREY, markeredgewidth=0, linestyle="none", label="one seed"),
        Line2D([], [], color="black", linewidth=1.2, label="median (box: quartiles)"),
        Line2D([], [], linestyle="none", label="mean", **_MEAN),
    ]
    above(figure, handles)


def draw_strips(axes: Axes, values: Mapping[str, np.ndarray]) -> None:
    """Draw a strip of points, a box of quartiles, and mean and median for each configuration."""
    look = looks(list(values))
    for place, (name, every) in enumerate(values.items()):
        every = np.asarray(every, float)
        every = every[np.isfinite(every) & (every > 0)]
        if not every.size:
            continue
        colour = look[name].colour
        axes.boxplot(
            every,
            positions=[place],
            widths=0.62,
            showfliers=False,
            patch_artist=True,
            manage_ticks=False,
            boxprops={"facecolor": (colour, 0.22), "edgecolor": colour, "linewidth": 0.8},
            whiskerprops={"color": colour, "linewidth": 0.8},
            capprops={"color": colour, "linewidth": 0.8},
            medianprops={"color": "black", "linewidth": 1.2},
        )
        across = place + 0.4 * ((np.arange(every.size) * 0.6180339887) % 1.0 - 0.5)
        axes.plot(across, every, "o", color=colour, markersize=2.6, markeredgewidth=0, alpha=0.8, gid=name)
        axes.plot(place, every.mean(), linestyle="none", zorder=5, gid="mean", **_MEAN)
    axes.set_yscale("log")
    scale_ticks(axes.yaxis, 6)
    axes.set_xticks(range(len(values)), [look[name].label.replace(" + ", "\n+ ") for name in values])
    if len(values) > 7:
        for text in axes.get_xticklabels():
            text.set(rotation=25, ha="right", rotation_mode="anchor")
    axes.set_xlim(-0.6, len(values) - 0.4)
    axes.grid(True, axis="y")


_MEAN = {"marker": "D", "markersize": 3.6, "color": "white", "markeredgecolor": "black", "markeredgewidth": 0.8}
