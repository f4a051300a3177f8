"""Designs: the expected information of all rated ones, and the interval widths after the chosen ones."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxlfi.figures.style import SET_COLOURS, TEXT_WIDTH, TRUTH, context, parameter_name, save
from jaxlfi.io import files

SHOWN = 6
"""Largest number of design variables that are drawn."""
NAME = "design.png"
HEIGHT = 2.2
"""Height of the upper panels, in inches."""


def report(folder: Path) -> Path:
    """Draw the picture of a folder that `Recommendation.save` wrote."""
    with context():
        return save(figure_of(files.read_arrays(folder / "design.npz")), folder / NAME, dpi=200)


def figure_of(arrays: Mapping[str, np.ndarray]) -> Figure:
    """A figure of bits over each design variable, and below it the interval widths of the parameters afterwards."""
    count, low = min(len(arrays["labels"]), SHOWN), 0.7 + 0.22 * len(arrays["names"])
    figure = Figure(figsize=(TEXT_WIDTH, HEIGHT + low), layout="constrained")
    panels = figure.add_gridspec(2, count, height_ratios=[HEIGHT, low])
    first: Axes | None = None
    spread = int(arrays["spread"])
    for k in range(count):
        axes = figure.add_subplot(panels[0, k], sharey=first)
        first = first or axes
        axes.plot(arrays["designs"][:spread, k], arrays["bits"][:spread], ".", color="#B0B0B0", label="spread evenly")
        axes.plot(arrays["designs"][spread:, k], arrays["bits"][spread:], ".", color=SET_COLOURS[4], label="searched")
        axes.plot(arrays["designs"][:1, k], arrays["bits"][:1], "s", color=SET_COLOURS[3], label="nominal")
        axes.plot(arrays["chosen"][:, k], arrays["chosen_bits"], **TRUTH, label="chosen")
        margin = 0.03 * (arrays["high"][k] - arrays["low"][k])
        axes.set(xlabel=str(arrays["labels"][k]), xlim=(arrays["low"][k] - margin, arrays["high"][k] + margin))
        axes.grid(True)
        axes.tick_params(labelleft=k == 0)
    assert first is not None
    first.set_ylabel("expected information, bits")
    handles = first.get_legend_handles_labels()[0]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles))
    _intervals(figure.add_subplot(panels[1, :]), arrays)
    return figure


def _intervals(axes: Axes, arrays: Mapping[str, np.ndarray]) -> None:
    names = [str(name) for name in arrays["names"]]
    now, after = arrays["widths"]
    rows = np.arange(len(names))
    axes.barh(rows, np.ones(len(names)), height=0.6, color="#E4E4E4")
    axes.barh(rows, after / now, height=0.6, color=SET_COLOURS[0])
    axes.set_yticks(rows, [parameter_name(names, d) for d in range(len(names))])
    axes.set(xlabel="expected width of the 90 % interval afterwards, as a fraction of what it is now", xlim=(0, 1.02))
    axes.invert_yaxis()
