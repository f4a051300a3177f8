"""Sensitivity of a heuristic to its hyperparameters: heat maps over every pair of them, as in the appendix.

The maps form a matrix, with one row and one column for each hyperparameter. Trajectory errors are above the diagonal,
parameter errors below it, and both for single hyperparameters on it. A cell is the mean over seeds and over all other
hyperparameters, with the standard deviation of the same runs. Brighter colours are better.
"""

import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxlfi.figures import statistics
from jaxlfi.figures.history import heuristic_name, read_arrays, read_config
from jaxlfi.figures.style import COLUMN_WIDTH, TEXT_WIDTH, plain
from jaxlfi.io.shell import quoted

FORMAT = "jaxlfi-grid"
SYMBOLS = {
    "zone_fraction": r"$\delta$",
    "zone_width": r"$\delta$",
    "mass_threshold": r"$\tau$",
    "expansion": r"$\eta$",
    "shift_threshold": r"$\nu_{TH}$",
    "proximity": r"$\rho$",
}
"""The paper's symbols for hyperparameters."""


@dataclasses.dataclass(frozen=True)
class Measure:
    """A result of each run, and how it is drawn."""

    name: str  # name of the array
    label: str  # label of the colour bar
    colours: str  # colour map whose bright end is the better one
    scale: float = 1.0  # factor applied to the values shown
    smaller_is_better: bool = True  # true for errors


TRAJECTORY = Measure("trajectory_error", "trajectory error [observed sd]", "viridis_r")
PARAMETER = Measure("theta_error", r"parameter error (sum of |θ − θ$_{gt}$|)", "plasma_r")
SUCCESS = Measure("success_rate", "simulation success rate [%]", "cividis", scale=100.0, smaller_is_better=False)


@dataclasses.dataclass(frozen=True)
class Grid:
    """The results of a sensitivity grid."""

    names: tuple[str, ...]  # hyperparameters, in the order of the arrays' leading axes
    values: tuple[tuple[float, ...], ...]  # values of each hyperparameter
    defaults: tuple[float, ...]  # the heuristic's default of each, the paper's value
    arrays: Mapping[str, np.ndarray]  # measures, shape [axis..., seed]
    heuristic: str = ""  # name of the heuristic


def is_grid(folder: Path) -> bool:
    """Whether a folder holds a sensitivity grid."""
    return Path(folder).is_dir() and read_config(Path(folder))["format"] == FORMAT


def load(folder: Path) -> Grid:
    """Read a grid's results.

    Raises:
        ValueError: for a folder that is damaged or holds no finished grid.
    """
    folder = Path(folder)
    config = read_config(folder)
    measures = (TRAJECTORY.name, PARAMETER.name, SUCCESS.name)
    if not (folder / "grid.npz").is_file():
        resume = quoted("jaxlfi", "resume", folder)
        raise ValueError(f"{folder}: expected a finished grid, found no grid.npz: continue with {resume}")
    arrays = read_arrays(folder / "grid.npz", ("axes", *measures), measures)
    try:
        names = tuple(str(name) for name in arrays["axes"])
        defaults = {axis["name"]: axis["default"] for axis in config["axes"]}
        return Grid(
            names,
            tuple(tuple(arrays[f"values/{name}"].astype(float).tolist()) for name in names),
            tuple(float(defaults[name]) for name in names),
            {name: arrays[name] for name in measures},
            heuristic_name(config["heuristic"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{folder}: expected config.json and grid.npz of one grid, got: {error!r}") from error


def marginal(values: np.ndarray, *axes: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation over all axes but the given ones, in the order given; NaN is left out."""
    front = np.moveaxis(values, axes, range(len(axes)))
    pooled = front.reshape(*front.shape[: len(axes)], -1)
    return statistics.mean(pooled, -1), statistics.sd(pooled, -1)


def errors(grid: Grid) -> tuple[Measure, ...]:
    """The errors to draw: of trajectories, if any were simulated from the posteriors, and of parameters."""
    simulated = np.isfinite(grid.arrays[TRAJECTORY.name]).any()
    return (TRAJECTORY, PARAMETER) if simulated else (PARAMETER,)


def size(grid: Grid, bars: int) -> tuple[float, float]:
    """Width and height in inches of a figure with colour bars: one column if cells stay readable, or else two."""
    cells = sum(len(values) for values in grid.values)
    width = COLUMN_WIDTH if cells <= 10 else TEXT_WIDTH
    square = width * (0.93 if len(grid.names) > 1 else 0.25 * bars)
    return width, square + 0.4 * bars


def draw(figure: Figure, grid: Grid) -> None:
    """Draw the trajectory error, if known, above the diagonal, and the parameter error below it (see `size`)."""
    *above, below = errors(grid)
    _matrix(figure, grid, above=above[0] if above else None, below=below)


def draw_success(figure: Figure, grid: Grid) -> None:
    """Draw the simulation success rate over all rounds, only below the diagonal, as the matrix is symmetric."""
    _matrix(figure, grid, above=None, below=SUCCESS)


def _matrix(figure: Figure, grid: Grid, above: Measure | None, below: Measure) -> None:
    counts = [len(values) for values in grid.values]
    panels = figure.subplots(
        len(counts), len(counts), squeeze=False, gridspec_kw={"width_ratios": counts, "height_ratios": counts}
    )
    figure.get_layout_engine().set(w_pad=0.018, h_pad=0.018, wspace=0.0, hspace=0.0)
    shown = [measure for measure in (above, below) if measure]
    scales = {measure.name: _scale(grid, measure) for measure in shown}
    font = _font(figure, sum(counts))
    for row, column in itertools.product(range(len(counts)), repeat=2):
        axes = panels[row, column]
        if row == column:
            _diagonal(axes, grid, row, shown, scales, font)
        elif measure := (above if row < column else below):
            _pair(axes, grid, row, column, measure, scales[measure.name], font)
        else:
            axes.set_axis_off()
    _label(panels, grid, upper=above is not None)
    figure.align_ylabels(panels[:, 0])
    for measure, place in zip(shown, ("top", "bottom") if above else ("bottom",), strict=True):
        bar = figure.colorbar(
            ScalarMappable(scales[measure.name], measure.colours),
            ax=list(panels.ravel()),
            location=place,
            fraction=0.03,
            aspect=45,
            pad=0.015,
        )
        bar.locator = MaxNLocator(6, steps=[1, 2, 5, 10])
        bar.update_ticks()
        side = {"top": "above", "bottom": "below"}[place] + (" the diagonal" if len(counts) > 1 else "")
        bar.set_label(f"{side}: {measure.label}" if above else measure.label)
        bar.outline.set_linewidth(0.4)


def _scale(grid: Grid, measure: Measure) -> Normalize:
    """Colour scale from the smallest to the largest mean shown; if all are equal, all have the best colour.

    For a success rate it ranges from a multiple of 10 % to 100 %, so that differences are not exaggerated.
    """
    pairs = [pair for r in (1, 2) for pair in itertools.combinations(range(len(grid.names)), r)]
    means = [marginal(measure.scale * grid.arrays[measure.name], *pair)[0].ravel() for pair in pairs]
    means = np.concatenate(means)
    means = means[np.isfinite(means)]
    low, high = (means.min(), means.max()) if means.size else (0.0, 1.0)
    if high > low:
        return Normalize(low, high) if measure.smaller_is_better else Normalize(10 * np.floor(low / 10), max(high, 100))
    width = 0.01 * max(abs(low), 1.0)
    return Normalize(low, low + width) if measure.smaller_is_better else Normalize(low - width, low)


def _font(figure: Figure, cells: int) -> float:
    """Font size of the numbers in cells, in points; 0 if cells are too small for readable numbers."""
    room = 72 * 0.78 * figure.get_size_inches()[0] / cells
    points = min(room / 3.6, 6.5)
    return points if points >= 3.0 else 0.0


def _pair(axes: Axes, grid: Grid, row: int, column: int, measure: Measure, scale: Normalize, font: float) -> None:
    mean, sd = marginal(measure.scale * grid.arrays[measure.name], row, column)
    chosen = np.outer(_chosen(grid, row), _chosen(grid, column))
    _cells(axes, mean, sd, chosen, measure, scale, font)


def _diagonal(
    axes: Axes, grid: Grid, place: int, shown: list[Measure], scales: Mapping[str, Normalize], font: float
) -> None:
    """Draw a band for each measure, with a cell for each value of a single hyperparameter."""
    for band, measure in enumerate(shown):
        mean, sd = marginal(measure.scale * grid.arrays[measure.name], place)
        _cells(axes, mean[None], sd[None], _chosen(grid, place)[None], measure, scales[measure.name], font, band)
    axes.set(ylim=(len(shown) - 0.5, -0.5))
    for band in range(1, len(shown)):
        axes.axhline(band - 0.5, color="white", linewidth=2.0)


def _cells(
    axes: Axes,
    mean: np.ndarray,
    sd: np.ndarray,
    chosen: np.ndarray,
    measure: Measure,
    scale: Normalize,
    font: float,
    first: int = 0,
) -> None:
    """Draw coloured cells with their numbers; the upper row is `first`."""
    rows, columns = mean.shape
    colours = matplotlib.colormaps[measure.colours].with_extremes(bad="#EEEEEE")
    axes.imshow(
        np.ma.masked_invalid(mean),
        cmap=colours,
        norm=scale,
        aspect="auto",
        extent=(-0.5, columns - 0.5, first + rows - 0.5, first - 0.5),
        gid=measure.name,
    )
    axes.vlines(np.arange(columns - 1) + 0.5, first - 0.5, first + rows - 0.5, color="white", linewidth=0.4)
    axes.hlines(first + np.arange(rows - 1) + 0.5, -0.5, columns - 0.5, color="white", linewidth=0.4)
    if not font:
        return
    for (row, column), value in np.ndenumerate(mean):
        known = np.isfinite(value)
        number = _number if measure.smaller_is_better else "{:.0f}".format
        text = f"{number(value)}\n±{number(sd[row, column])}" if known else "–"
        red, green, blue, _ = colours(scale(value)) if known else (1, 1, 1, 1)
        axes.text(
            column,
            first + row,
            text,
            color="black" if 0.299 * red + 0.587 * green + 0.114 * blue > 0.5 else "white",
            fontsize=font,
            weight="bold" if chosen[row, column] else "normal",
            ha="center",
            va="center",
            linespacing=1.05,
        )


def _label(panels: np.ndarray, grid: Grid, upper: bool) -> None:
    """Label the left and bottom sides with names; each triangle has its values on its own outer sides."""
    last = len(grid.names) - 1
    for axes in panels.ravel():
        axes.set(xticks=[], yticks=[])
    for place, name in enumerate(grid.names):
        label = f"{plain(name)} {SYMBOLS.get(name, '')}".strip()
        panels[last, place].set_xlabel(label)
        panels[place, 0].set_ylabel(label)
        _ticks(panels[last, place].xaxis, grid, place)
        if place > 0:
            _ticks(panels[place, 0].yaxis, grid, place)
        if upper and place > 0:
            panels[0, place].xaxis.tick_top()
            _ticks(panels[0, place].xaxis, grid, place)
        if upper and place < last:
            panels[place, last].yaxis.tick_right()
            _ticks(panels[place, last].yaxis, grid, place)


def _ticks(axis, grid: Grid, place: int) -> None:
    values = grid.values[place]
    axis.set_ticks(range(len(values)), [f"{value:g}" for value in values])
    axis.set_tick_params(length=0, labelsize=5.8)
    for text, chosen in zip(axis.get_ticklabels(), _chosen(grid, place), strict=True):
        text.set_weight("bold" if chosen else "normal")


def _chosen(grid: Grid, place: int) -> np.ndarray:
    """Which of a hyperparameter's values is the heuristic's default."""
    return np.isclose(grid.values[place], grid.defaults[place], rtol=1e-6, atol=0)


def _number(value: float) -> str:
    """A number in about four characters."""
    if not np.isfinite(value) or value == 0:
        return "0" if value == 0 else "–"
    return f"{value:.0f}" if abs(value) >= 99.5 else f"{value:.1f}" if abs(value) >= 9.95 else f"{value:.2f}"
