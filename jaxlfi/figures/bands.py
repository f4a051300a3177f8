"""Lines with bands over iterations, and the legend they share."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxlfi.figures.style import Look


def draw_band(axes: Axes, x: np.ndarray, middle: np.ndarray, spread: np.ndarray, look: Look) -> None:
    """A configuration's line, and a band of `spread` to either side of it where that is not zero.

    Args:
        axes: to draw on.
        x: shape [R].
        middle: shape [R].
        spread: shape [R].
        look: of the configuration.
    """
    if np.any(spread > 0):
        axes.fill_between(x, middle - spread, middle + spread, color=look.colour, alpha=0.16, linewidth=0)
    axes.plot(x, middle, **look.line)


def legend(figure: Figure, look: Mapping[str, Look], title: str, loc: str = "outside upper center") -> None:
    """A legend of configurations outside of the axes, with a line on what is drawn."""
    handles = [Line2D([], [], **own.line) for own in look.values()]
    columns = balanced(list(look.values()), figure.get_size_inches()[0])
    figure.legend(handles=handles, loc=loc, ncols=columns, title=title, title_fontsize=7)


def balanced(look: Sequence[Look], width: float) -> int:
    """Columns of a legend that fit into a width in inches and leave rows of equal lengths."""
    inches = 0.46 + 0.053 * max(len(own.label) for own in look)
    fitting = max(1, int(width / inches))
    rows = -(-len(look) // fitting)
    return -(-len(look) // rows)
