"""Figures: from the saved arrays of runs to pictures and a page; the only package that imports matplotlib.

`report(folder)` draws all pictures that apply to a run folder. Each picture is a module with a function `draw`
from loaded runs to a matplotlib figure, for use on its own. What is said here is not repeated there: `figure` is empty,
`axes` are those to draw on, `runs` are configurations with their seeds, `histories` one run for each column, all of the
same parameters, with `titles` that are the configurations' names by default, `look` is that of a configuration, `d` the
index of a parameter, `pair` those of two or one, with a `window` of axis limits each, and `arrays` are those of
diagnostics.npz.

    from jaxlfi.figures import curves, open_collection, style

    runs = open_collection("runs/compare").runs
    with style.context():
        figure = style.new_figure(style.COLUMN_WIDTH, 4.5)
        curves.draw(figure, {name: runs[name] for name in ("ok", "misspecified+edge")})
        figure.savefig("curves.pdf")
"""

from jaxlfi.figures.collection import Collection, open_collection, read_table, representative
from jaxlfi.figures.history import History, load
from jaxlfi.figures.reporting import report

__all__ = ["Collection", "History", "load", "open_collection", "read_table", "report", "representative"]
