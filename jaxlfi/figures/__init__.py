"""Figures: from the saved arrays of runs to pictures and a page; the only package that imports matplotlib.

`report(folder)` draws all pictures that apply to a run folder. Each picture is a module with a function `draw`
from loaded runs to a matplotlib figure, for use on its own:

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
