"""Legends outside the panels."""

from collections.abc import Mapping, Sequence

from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxlfi.figures.style import Look, grid_shape, is_wide


def above(figure: Figure, handles: Sequence[Artist], title: str | None = None, columns: int | None = None) -> None:
    """Add a legend above the panels, by default in one row."""
    figure.legend(
        handles=handles, loc="outside upper center", ncols=columns or len(handles), title=title, title_fontsize=7
    )


def below(figure: Figure, handles: Sequence[Artist], at_most: int | None = None, **options) -> None:
    """Add a legend below the panels, by default in one row if the figure is wide, or else in 3 columns."""
    columns = min(at_most or (len(handles) if is_wide(figure) else 3), len(handles))
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, **{"title_fontsize": 7} | options)


def of_configurations(figure: Figure, look: Mapping[str, Look], title: str) -> None:
    """Add a legend of the configurations' lines above the panels."""
    handles = [Line2D([], [], **own.line) for own in look.values()]
    above(figure, handles, title, balanced(list(look.values()), figure))


def balanced(look: Sequence[Look], figure: Figure) -> int:
    """Number of legend columns that fit into a figure's width and give rows of equal lengths."""
    inches = 0.46 + 0.053 * max(len(own.label) for own in look)
    return grid_shape(len(look), max(1, int(figure.get_size_inches()[0] / inches)))[1]
