"""Style of the figures: one colour, marker and line for each configuration, and sizes for a two-column paper."""

import contextlib
import dataclasses
import io
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import BoundaryNorm, Colormap, LinearSegmentedColormap, ListedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxlfi.io import files

COLUMN_WIDTH = 3.5
"""Width of one column of a paper, in inches."""
TEXT_WIDTH = 7.16
"""Width of both columns of a paper, in inches."""
NOTEBOOK_DPI = 150
"""Resolution of a figure displayed in a notebook."""

_TICKS = {"labelsize": 7.0, "color": "#333333", "major.size": 2.0, "major.width": 0.6, "major.pad": 2.0,
          "minor.size": 1.2, "minor.width": 0.4}  # fmt: skip
STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 7.0,
    "axes.titlesize": 7.5,
    "axes.labelsize": 7.0,
    "axes.linewidth": 0.6,
    "axes.edgecolor": "#555555",
    "axes.titlepad": 3.0,
    "axes.labelpad": 2.0,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.5,
    **{f"{axis}tick.{name}": value for axis in "xy" for name, value in _TICKS.items()},
    "legend.fontsize": 7.0,
    "legend.frameon": False,
    "legend.handlelength": 2.2,
    "legend.columnspacing": 1.4,
    "legend.borderaxespad": 0.2,
    "lines.linewidth": 1.2,
    "lines.markersize": 3.2,
    "figure.facecolor": "white",
    "figure.constrained_layout.w_pad": 0.03,
    "figure.constrained_layout.h_pad": 0.03,
}
"""matplotlib settings of all figures, which `context` applies."""

SUPPORT_COLOURS = {
    "ok": "#30B9EB",
    "misspecified": "#C52B21",
    "broad": "#15158B",
    "broader": "#995FDD",
    "broadest": "#369060",
}
"""Colours of fixed supports, after the paper's."""

HEURISTIC_COLOURS = {"edge": "#F5A025", "mode": "#025358", "centre": "#45200E", "truncate": "#3C46FF"}
"""Colours of adapted supports. Any two of these nine differ by 22 in CIELAB in each kind of colour blindness."""

OTHER_COLOURS = ("#7F7F7F", "#C2578F", "#8A8A1F", "#4F7CAC", "#B0713B", "#2E2E2E")
"""Colours of configurations with any other name, in order of appearance."""

SET_COLOURS = ("#15158B", "#F5A025", "#025358", "#C52B21", "#30B9EB", "#45200E", "#995FDD", "#369060")
"""Colours of sets of samples that belong to no configuration, from the nine above."""
_SET_LINES: tuple[str | tuple, ...] = ("-", (0, (4, 1.2)), (0, (1, 1)), (0, (6, 1, 1, 1)))

GREY = "#777777"
"""Colour of legend entries that apply to all configurations."""

_MARKERS: dict[str, tuple[str, str | tuple]] = {
    "ok": ("o", "-"),
    "misspecified": ("X", (0, (4, 1.2))),
    "broad": ("s", (0, (1, 1))),
    "broader": ("D", (0, (1, 2))),
    "broadest": ("p", (0, (5, 1, 1, 1, 1, 1))),
    "edge": ("^", "-"),
    "mode": ("v", (0, (6, 1, 1, 1))),
    "centre": ("P", (0, (3, 1, 1, 1, 1, 1))),
    "truncate": ("H", (0, (2, 1))),
}
_OTHER_MARKERS = ("<", ">", "h", "d", "8", "*")
_SHADES = {"ok": 0.45, "broad": -0.35, "broader": 0.25, "broadest": -0.2}

TRUTH = {
    "marker": "*",
    "color": "#FFD400",
    "markeredgecolor": "black",
    "markeredgewidth": 0.6,
    "markersize": 7.0,
    "linestyle": "none",
}
"""Marker of the true parameters in plots of two parameters."""
TRUTH_LINE = {"color": "black", "linestyle": (0, (4, 2)), "linewidth": 0.9}
"""Line at a true parameter on its axis."""


@dataclasses.dataclass(frozen=True)
class Look:
    """How one configuration is drawn."""

    label: str  # name shown to the reader
    colour: str  # colour of lines, boxes and titles
    marker: str  # matplotlib marker
    linestyle: str | tuple  # matplotlib line style

    @property
    def line(self) -> dict:
        """Keyword arguments for `Axes.plot`."""
        return {
            "color": self.colour,
            "marker": self.marker,
            "linestyle": self.linestyle,
            "markeredgecolor": "white",
            "markeredgewidth": 0.3,
            "label": self.label,
        }

    @property
    def density(self) -> Colormap:
        """A colour map from white to the configuration's colour and on towards black."""
        dark = shade(self.colour, -0.45)
        return LinearSegmentedColormap.from_list(self.label, ["#FFFFFF", self.colour, dark])


def shade(colour: str, amount: float) -> str:
    """A colour mixed with white (amount > 0) or black (amount < 0)."""
    end = 1.0 if amount > 0 else 0.0
    mixed = [round(255 * (c + (end - c) * abs(amount))) for c in to_rgb(colour)]
    return "#" + "".join(f"{c:02X}" for c in mixed)


def looks(configurations: Sequence[str]) -> dict[str, Look]:
    """The look of each configuration; a name from the paper has the same look in all figures.

    Args:
        configurations: names such as "ok" or "misspecified+edge"; others get colours from `OTHER_COLOURS`.
    """
    result: dict[str, Look] = {}
    spare = 0
    for name in configurations:
        support, _, heuristic = name.partition("+")
        if not heuristic and support in SUPPORT_COLOURS:
            colour, (marker, line) = SUPPORT_COLOURS[support], _MARKERS[support]
        elif heuristic in HEURISTIC_COLOURS:
            amount = _SHADES.get(support, 0.0)
            colour, (marker, line) = HEURISTIC_COLOURS[heuristic], _MARKERS[heuristic]
            colour = shade(colour, amount) if amount else colour
        else:
            colour, marker = OTHER_COLOURS[spare % len(OTHER_COLOURS)], _OTHER_MARKERS[spare % len(_OTHER_MARKERS)]
            line, spare = "-", spare + 1
        result[name] = Look(configuration_label(name), colour, marker, line)
    return result


def set_looks(labels: Sequence[str]) -> list[Look]:
    """The looks of sets of samples with these labels."""
    return [
        Look(plain(label), SET_COLOURS[i % len(SET_COLOURS)], "o", _SET_LINES[i % len(_SET_LINES)])
        for i, label in enumerate(labels)
    ]


def or_labels(titles: Sequence[str] | None, look: Sequence[Look]) -> list[str]:
    """The titles, or the labels of the looks if no titles are given."""
    return [own.label for own in look] if titles is None else list(titles)


def configuration_label(name: str) -> str:
    """A configuration's name as shown to the reader: "misspecified + EDGE"."""
    support, _, heuristic = name.partition("+")
    support = "OK" if support == "ok" else plain(support)
    if not heuristic:
        return support
    return f"{support} + {heuristic.upper() if heuristic in HEURISTIC_COLOURS else plain(heuristic)}"


def plain(text: str) -> str:
    """Text that matplotlib draws literally, without mathematics, with spaces for underscores."""
    return text.replace("$", r"\$").replace("_", " ")


def symbol(d: int) -> str:
    """The symbol theta_d, counted from 1 as in the paper."""
    return rf"$\theta_{{{d + 1}}}$"


def is_log(name: str) -> bool:
    """Whether a parameter of this name in inference space is a natural logarithm."""
    return name.startswith("ln ")


def natural(name: str) -> str:
    """The name of a parameter, without the logarithm of inference space."""
    return name.removeprefix("ln ")


def plain_unit(unit: str) -> str:
    """The unit of a parameter, without the logarithm of inference space; "" for a dimensionless one.

    Example:
        >>> plain_unit("ln(1/year)"), plain_unit("mm"), plain_unit("-")
        ('1/year', 'mm', '')
    """
    unit = unit[3:-1] if unit.startswith("ln(") and unit.endswith(")") else unit
    return "" if unit in ("1", "-") else unit


def parameter_name(names: Sequence[str], d: int, width: int = 26) -> str:
    """A parameter's symbol and name, wrapped to `width`."""
    return "\n".join(textwrap.wrap(f"{symbol(d)} {plain(natural(names[d]))}", width + len(symbol(d))))


def unit_label(units: Sequence[str], d: int) -> str:
    """A parameter's natural unit in brackets, or ""."""
    unit = plain(plain_unit(units[d]))
    return f"[{unit}]" if unit else ""


def named_with_unit(text: str, unit: str) -> str:
    """A label, with the unit, if any, on a separate line."""
    return f"{text}\n[{plain(unit)}]" if unit else text


def parameter_label(names: Sequence[str], units: Sequence[str], d: int, width: int = 26) -> str:
    """Axis label: symbol and name, with the natural unit on a separate line."""
    return named_with_unit(parameter_name(names, d, width), plain_unit(units[d]))


def round_ticks(axis: Axis, count: int) -> None:
    """Set at most `count` + 1 ticks at round numbers."""
    axis.set_major_locator(MaxNLocator(nbins=count, steps=[1, 2, 2.5, 5, 10]))


def integer_ticks(axis: Axis, count: int = 6) -> None:
    """Set at most `count` + 1 ticks at integers."""
    axis.set_major_locator(MaxNLocator(nbins=count, integer=True, min_n_ticks=1))


def grid_shape(count: int, most: int) -> tuple[int, int]:
    """Rows and columns for `count` panels, at most `most` of them side by side, in rows of equal lengths."""
    rows = -(-count // most)
    return rows, -(-count // rows)


def is_wide(figure: Figure) -> bool:
    """Whether a figure is as wide as a paper's text rather than a column."""
    return bool(figure.get_size_inches()[0] > 5)


def iteration_colours(rounds: int) -> tuple[ListedColormap, BoundaryNorm]:
    """One colour for each iteration, counted from 1, dark to light."""
    base = matplotlib.colormaps["viridis"]
    colours = [base(0.93 * i / max(rounds - 1, 1)) for i in range(rounds)]
    edges = [i + 0.5 for i in range(rounds + 1)]
    return ListedColormap(colours), BoundaryNorm(edges, rounds)


def iterations_axis(axes: Axes, rounds: int, first: int = 1, label: bool = True) -> None:
    """Set integer ticks for iterations `first` to `rounds`, and the axis label."""
    axes.set_xlim(first - 0.35, rounds + 0.35)
    integer_ticks(axes.xaxis)
    if label:
        axes.set_xlabel("iteration")


def iteration_bar(figure: Figure, axes: np.ndarray, rounds: int) -> Colorbar:
    """Add a colour bar of iterations to the right of some axes."""
    colours, norm = iteration_colours(rounds)
    bar = figure.colorbar(ScalarMappable(norm, colours), ax=list(axes.ravel()), label="iteration", aspect=40, pad=0.01)
    bar.locator = MaxNLocator(nbins=10, integer=True, min_n_ticks=1)
    bar.minorticks_off()
    bar.update_ticks()
    return bar


@contextlib.contextmanager
def context() -> Iterator[None]:
    """Apply `STYLE` to figures made, drawn and saved inside; the settings are restored afterwards."""
    with matplotlib.rc_context(STYLE):
        yield


class SelfShowing(Figure):
    """A figure that a notebook shows as the last value of a cell, although it is not registered with pyplot.

    IPython calls `_repr_png_` of a value. If `%matplotlib inline` has registered a formatter for every `Figure`,
    IPython uses that instead, so that the figure is shown only once.
    """

    def _repr_png_(self) -> bytes:
        with context():
            return png(self, NOTEBOOK_DPI)


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of a size in inches, laid out without overlaps and not registered with pyplot."""
    figure = SelfShowing(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: Path, dpi: float) -> Path:
    """Write a figure as png and return the path."""
    content = png(figure, dpi)
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write_bytes(path, content)
    return path


def png(figure: Figure, dpi: float) -> bytes:
    """A figure as the content of a .png file."""
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi)
    return content.getvalue()
