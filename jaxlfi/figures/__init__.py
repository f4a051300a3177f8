"""Figures: pictures and an HTML page from the saved arrays of runs; the only package that imports matplotlib.

`report(folder)` draws all pictures that apply to a run folder. Each picture is a module with a function `draw`, which
draws loaded runs on a matplotlib figure and can be used on its own. These arguments are the same in all modules:
`figure` is an empty figure, and `axes` are the axes to draw on. `runs` are configurations with their seeds. `histories`
are one run for each column, all with the same parameters; their `titles` are by default the configurations' names.
`look` is the style of a configuration. `d` is the index of a parameter, and `pair` holds the indices of two or one,
each with a `window` of axis limits. `arrays` are those of diagnostics.npz.

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
