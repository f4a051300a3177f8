"""Pictures of the measurements, from the saved arrays."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from experiments.whip_physics.measure import DEFAULT, ELEMENTS, NUMBERS
from experiments.whip_physics.models import KINDS

LOOKS = {
    "plain cable": {"color": "#7F7F7F", "marker": "x"},
    "ball joints": {"color": "#F5A025", "marker": "o", "markerfacecolor": "none", "markersize": 6.0},
    "planar hinges": {"color": "#025358", "marker": "."},
}
COLOURS = ("#30B9EB", "#369060", "#025358", "#F5A025", "#C52B21", "#995FDD", "#15158B")
"""Colours of elasto-gravity numbers."""


def convergence(figure: Figure, arrays: Mapping[str, np.ndarray]) -> None:
    """Draw errors of statics over the number of elements, with a line that falls with its square.

    Args:
        figure: an empty figure.
        arrays: arrays of `measure.against_theory` and `measure.sags`.
    """
    tip, sag = figure.subplots(1, 2, sharex=True)
    for kind, errors in zip(KINDS, arrays["tip"], strict=True):
        tip.loglog(ELEMENTS, 100 * np.abs(errors), label=kind, **LOOKS[kind])
    tip.set(ylabel="error of the tip's deflection [%]", title="small load at the tip")
    for i, (number, colour) in enumerate(zip(NUMBERS, COLOURS, strict=True)):
        exact = arrays["elastica"][i, -1, 1]
        errors = [abs(arrays[f"sag {elements}"][i, -1, 1] / exact - 1) for elements in ELEMENTS]
        sag.loglog(ELEMENTS, 100 * np.array(errors), color=colour, marker=".", label=f"G = {number:g}")
    sag.set(ylabel="error of the sag [%]", title="own weight, planar hinges")
    for axes, start in ((tip, 0.6), (sag, 0.5)):
        over_elements(axes, start)
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def sag(figure: Figure, arrays: Mapping[str, np.ndarray]) -> None:
    """Draw shapes of DLOs held horizontally at the left: the elastica, and nodes of chains of 12 elements.

    Args:
        figure: an empty figure.
        arrays: arrays of `measure.sags`.
    """
    axes = figure.subplots()
    for i, (number, colour) in enumerate(zip(NUMBERS, COLOURS, strict=True)):
        axes.plot(*arrays["elastica"][i].T, color=colour, linewidth=0.9, label=f"elastica, G = {number:g}")
        axes.plot(*arrays[f"sag {DEFAULT}"][i].T, ".", color=colour, markersize=4)
        axes.plot(*arrays["plain"][i].T, "x", color=colour, markersize=3, markeredgewidth=0.6)
    axes.plot([], [], ".", color="#333333", label="planar hinges")
    axes.plot([], [], "x", color="#333333", label="plain cable")
    axes.set(xlabel="from the clamp [L]", ylabel="below the clamp [L]", aspect="equal")
    axes.invert_yaxis()
    axes.grid(True)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def frequencies(figure: Figure, arrays: Mapping[str, np.ndarray]) -> None:
    """Draw errors of the first two natural frequencies over the number of elements, for a beam with rotary inertia.

    Args:
        figure: an empty figure.
        arrays: arrays of `measure.against_theory`.
    """
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for mode, (axes, name) in enumerate(zip(panels, ("first", "second"), strict=True)):
        for kind, errors in zip(KINDS, arrays["rotary"][..., mode], strict=True):
            axes.loglog(ELEMENTS, 100 * np.abs(errors), label=kind, **LOOKS[kind])
        over_elements(axes, 0.7)
        axes.set(title=f"{name} mode")
    panels[0].set(ylabel="error of the frequency [%]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center")


def over_elements(axes: Axes, start: float) -> None:
    """Set up an axis for the number of elements, and draw a line from `start` that falls with its square."""
    axes.loglog(ELEMENTS, start * (ELEMENTS[0] / np.array(ELEMENTS)) ** 2, ":k", linewidth=0.8, label="∝ N⁻²")
    axes.set_xlabel("elements N")
    axes.set_xticks(ELEMENTS, [str(elements) for elements in ELEMENTS])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.grid(True)


FIGURES = {"convergence": (convergence, 7.16, 2.3), "sag": (sag, 4.6, 3.2), "frequencies": (frequencies, 7.16, 2.2)}
"""Figures by name: drawing function, and width and height in inches."""
