"""Designs: what all that were rated are expected to tell, and the intervals that the chosen ones leave."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from jaxlfi.figures.legends import below as legend_below
from jaxlfi.figures.style import SET_COLOURS, TEXT_WIDTH, TRUTH, context, parameter_name, save
from jaxlfi.io import files

SHOWN = 6
"""Variables of a design that are drawn, at most."""
NAME = "design.png"


def report(folder: Path) -> Path:
    """Draw the picture of a folder that `Recommendation.save` wrote."""
    with context():
        return save(figure_of(files.read_arrays(folder / "design.npz")), folder / NAME, dpi=200)


def figure_of(arrays: Mapping[str, np.ndarray]) -> Figure:
    """Bits over each variable of the designs, and below the intervals of the parameters now and afterwards."""
    count = min(len(arrays["labels"]), SHOWN)
    figure = Figure(figsize=(TEXT_WIDTH, 2.2 + 0.9 + 0.25 * len(arrays["names"])), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=[2.2, 0.9 + 0.25 * len(arrays["names"])])
    axes = above.subplots(1, count, squeeze=False, sharey=True)[0]
    spread = int(arrays["spread"])
    for k, one in enumerate(axes):
        one.plot(arrays["designs"][:spread, k], arrays["bits"][:spread], ".", color="#B0B0B0", label="spread evenly")
        one.plot(arrays["designs"][spread:, k], arrays["bits"][spread:], ".", color=SET_COLOURS[4], label="searched")
        one.plot(arrays["designs"][:1, k], arrays["bits"][:1], "s", color=SET_COLOURS[3], label="nominal")
        one.plot(arrays["chosen"][:, k], arrays["chosen_bits"], **TRUTH, label="chosen")
        one.set(xlabel=str(arrays["labels"][k]), xlim=(arrays["low"][k], arrays["high"][k]))
        one.grid(True)
    axes[0].set_ylabel("expected information, bits")
    legend_below(above, axes[0].get_legend_handles_labels()[0])
    _intervals(below, arrays)
    return figure


def _intervals(figure: Figure, arrays: Mapping[str, np.ndarray]) -> None:
    axes = figure.subplots()
    names = [str(name) for name in arrays["names"]]
    now, after = arrays["widths"]
    rows = np.arange(len(names))
    axes.barh(rows, np.ones(len(names)), height=0.6, color="#E4E4E4", label="now")
    axes.barh(rows, after / now, height=0.6, color=SET_COLOURS[0], label="expected afterwards")
    axes.set_yticks(rows, [parameter_name(names, d) for d in rows])
    axes.set(xlabel="width of the 90 % interval, as a fraction of what it is now", xlim=(0, 1.02))
    axes.invert_yaxis()
    legend_below(figure, axes.get_legend_handles_labels()[0])
