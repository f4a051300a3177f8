"""Pair plots: the marginals of all parameters and the joint distributions of all pairs, from draws."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from jaxlfi.figures.extent import cells, extent
from jaxlfi.figures.history import History
from jaxlfi.figures.legends import below
from jaxlfi.figures.natural import Scale, scales
from jaxlfi.figures.style import (
    GREY,
    TRUTH,
    TRUTH_LINE,
    Look,
    grid_shape,
    is_wide,
    looks,
    or_labels,
    parameter_label,
    shade,
    symbol,
)

MAX_PARAMETERS = 6
"""Largest number of parameters for pair plots in a report, where those of several runs stand side by side."""
FRACTIONS = (0.95, 0.8, 0.5)
"""Fractions of the draws that the contours enclose, from the outermost contour inwards."""
_SHADES = (0.68, 0.3, -0.2)
_CELLS = {"per_half": 8.6, "fewest": 48, "most": 192}
"""Numbers of cells of a two-dimensional density along each axis."""
_BINS = {"per_half": 5.9, "fewest": 24, "most": 96}
"""Numbers of bins of a histogram."""
_TRUTH_POINT = TRUTH | {"markersize": 5.5, "markeredgewidth": 0.5}
_POINT = {"markersize": 4, "markeredgewidth": 0.5, "markeredgecolor": "white", "linewidth": 1.3}
_MARKERS = "DsvP^X<>"
_SUPPORT = {"linestyle": "-", "linewidth": 0.9}
_FIRST_SUPPORT = {"linestyle": (0, (1, 1.2)), "linewidth": 0.8}

TITLE = 0.3
"""Height of a title above a pair plot, in inches."""
ROOMY = 1.4
"""Smallest width of a panel, in inches, at which horizontal tick labels fit below it."""

Box = tuple[np.ndarray, np.ndarray]
"""Lower and upper bounds of the parameters, shape [D] each."""


@dataclasses.dataclass(frozen=True)
class Cloud:
    """Draws of one distribution over D parameters, with their support and true parameters."""

    draws: np.ndarray  # shape [n, D]
    look: Look  # how they are drawn
    truth: np.ndarray  # shape [D], NaN where unknown
    support: Box | None = None  # box that holds all draws, or None; densities do not fade towards its bounds
    first_support: Box | None = None  # support before adaptation, or None if it is the same

    @property
    def dim(self) -> int:
        """Number of parameters D."""
        return self.draws.shape[1]

    @property
    def boxes(self) -> list[tuple[Box, dict]]:
        """The supports that are known, the last one first, each with its line style."""
        both = (self.support, _SUPPORT), (self.first_support, _FIRST_SUPPORT)
        return [(box, style) for box, style in both if box is not None]


@dataclasses.dataclass(frozen=True)
class Point:
    """An estimate of D parameters."""

    value: np.ndarray  # shape [D]
    interval: np.ndarray  # interval of each parameter, shape [D, 2]; NaN where there is none
    look: Look  # how it is drawn


def drawable(history: History) -> bool:
    """Whether finite draws of the last posterior were saved, with at most `MAX_PARAMETERS` parameters."""
    return history.draws is not None and history.dim <= MAX_PARAMETERS and bool(np.isfinite(history.draws).all())


def cloud_of(history: History, look: Look) -> Cloud:
    """A run's saved draws with its last support, its first one if that differs, and the truth."""
    low, high = history.supports
    first = (low[0], high[0]) if history.adapts else None
    return Cloud(history.draws, look, history.truth, (low[-1], high[-1]), first)


def window(clouds: Sequence[Cloud], d: int, points: Sequence[Point] = ()) -> tuple[float, float]:
    """Axis limits of a parameter that show the draws except outliers, truth, points, and bounds near these."""
    ends = np.concatenate([extent(cloud.draws[:, d]) for cloud in clouds])
    ends = np.concatenate([ends, [cloud.truth[d] for cloud in clouds if np.isfinite(cloud.truth[d])]])
    marked = np.array([end for point in points for end in (point.value[d], *point.interval[d])])
    ends = np.concatenate([ends, marked[np.isfinite(marked)]])
    low, high = float(ends.min()), float(ends.max())
    bounds = np.array([bound[d] for cloud in clouds for box, _ in cloud.boxes for bound in box])
    reach = 0.35 * (high - low)
    near = bounds[(bounds >= low - reach) & (bounds <= high + reach)]
    low, high = min([low, *near]), max([high, *near])
    margin = 0.06 * (high - low)
    return low - margin, high + margin


def smoothed(draws: np.ndarray, box: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A density estimate from draws of two parameters: their histogram, smoothed with a normal kernel.

    The histogram ends at the bounds of the box, where the kernel is reflected. It leaves out a few outliers, which are
    missing from the fractions.

    Args:
        draws: draws of the two parameters, shape [n, 2].
        box: lower and upper bounds of the two, shape [2, 2]; infinite where there are none. The bounds of a parameter
            are ignored if any draw lies beyond them.

    Returns:
        Two axes of cell centres, [B] and [B'], and the fraction of draws in each cell, [B', B], with the second
        parameter along the first axis.
    """
    low, high = np.transpose([extent(column) for column in draws.T])
    margin = 0.15 * (high - low)
    inside = ((draws >= box[0]) & (draws <= box[1])).all(0)
    low = np.where(inside, np.maximum(low - margin, box[0]), low - margin)
    high = np.where(inside, np.minimum(high + margin, box[1]), high + margin)
    bins = [cells(*one, **_CELLS) for one in zip(draws.T, high - low, strict=True)]
    counts, *edges = np.histogram2d(*draws.T, bins=bins, range=list(zip(low, high, strict=True)))
    reach = np.arange(-8, 9)
    kernel = np.exp(-0.5 * (reach / 2.2) ** 2)
    kernel /= kernel.sum()
    fraction = np.pad(counts, reach[-1], mode="symmetric")
    for axis in (0, 1):
        fraction = np.apply_along_axis(np.convolve, axis, fraction, kernel, mode="valid")
    x, y = ((e[1:] + e[:-1]) / 2 for e in edges)
    return x, y, fraction.T * (counts.sum() / len(draws) / fraction.sum())


def levels(fraction: np.ndarray, enclosed: Sequence[float] = FRACTIONS) -> np.ndarray:
    """The lowest density inside the smallest region that holds each given fraction of the draws.

    Args:
        fraction: fraction of the draws in each cell, any shape; the sum is 1, or less if some draws are in no cell.
        enclosed: fractions of the draws to enclose, in (0, 1).
    """
    ordered = np.sort(fraction, axis=None)[::-1]
    return ordered[np.searchsorted(np.cumsum(ordered), enclosed).clip(max=ordered.size - 1)]


def histogram(draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The density of draws [n] in bins over their `extent`, shape [B], and the bins' edges, [B + 1].

    Draws beyond the extent count too: the densities of all bins integrate to one minus their fraction.
    """
    low, high = extent(draws)
    bins = cells(draws, high - low, **_BINS | {"most": max(_BINS["fewest"], min(_BINS["most"], len(draws) // 10))})
    counts, edges = np.histogram(draws, bins, (low, high))
    return counts / (len(draws) * (edges[1] - edges[0])), edges


def draw_marginal(axes: Axes, clouds: Sequence[Cloud], d: int, points: Sequence[Point] = ()) -> None:
    """Draw histograms of one parameter's draws, with the supports' bounds and the truth, and points above them."""
    found = [histogram(cloud.draws[:, d]) for cloud in clouds]
    highest = max(heights.max() for heights, _ in found)
    for cloud, (heights, edges) in zip(clouds, found, strict=True):
        look = cloud.look
        fill = {"color": shade(look.colour, 0.45)} if len(clouds) == 1 else {"color": look.colour, "alpha": 0.25}
        drawn = {"x": (edges[1:] + edges[:-1]) / 2, "bins": edges, "weights": heights / highest}
        axes.hist(histtype="stepfilled", gid="marginal", **drawn, **fill)
        if len(clouds) > 1:
            line = {"color": look.colour, "linestyle": look.linestyle, "linewidth": 0.9}
            axes.hist(histtype="step", **drawn, **line)
    for bounds, style in _boxes(clouds):
        for bound in bounds:
            axes.axvline(bound[d], **style)
    for truth in _truths(clouds):
        if np.isfinite(truth[d]):
            axes.axvline(truth[d], gid="truth", **TRUTH_LINE)
    for row, point in enumerate(points):
        height = 1.12 + 0.12 * row
        _draw_point(axes, point, row, [(point.value[d], height)], [(point.interval[d], [height] * 2)])
    axes.set_ylim(0, 1.12 + 0.12 * len(points))
    axes.set_yticks([])


def draw_pair(axes: Axes, clouds: Sequence[Cloud], pair: tuple[int, int], points: Sequence[Point] = ()) -> None:
    """Draw contours around fractions of the draws of two parameters, with the supports, the truth and points.

    The first of the pair is on the horizontal axis. A single cloud has filled contours; several have lines over a light
    fill.
    """
    chosen = list(pair)
    for cloud in clouds:
        _draw_contours(axes, cloud, chosen, filled=len(clouds) == 1)
    for (low, high), style in _boxes(clouds):
        corner, (width, height) = low[chosen], (high - low)[chosen]
        axes.add_patch(Rectangle(corner, width, height, fill=False, zorder=2, **style))
    for truth in _truths(clouds):
        if np.isfinite(truth[chosen]).all():
            axes.plot(*truth[chosen], gid="truth", zorder=3, **_TRUTH_POINT)
    for row, point in enumerate(points):
        (x, y), (across, along) = point.value[chosen], point.interval[chosen]
        _draw_point(axes, point, row, [(x, y)], [(across, [y] * 2), ([x] * 2, along)])


def _draw_point(axes: Axes, point: Point, row: int, places: list, bars: list) -> None:
    """Draw a marker, and lines along its intervals."""
    colour, marker = point.look.colour, _MARKERS[row % len(_MARKERS)]
    for ends in bars:
        axes.plot(*ends, color=colour, gid="interval", zorder=4, linewidth=_POINT["linewidth"])
    axes.plot(*zip(*places, strict=True), color=colour, marker=marker, gid="point", zorder=5, **_POINT)


def _boxes(clouds: Sequence[Cloud]) -> list[tuple[Box, dict]]:
    """The distinct supports of some clouds, with line styles in the colour of a single cloud, or else in grey."""
    boxes = {np.stack(box).tobytes(): (box, style) for cloud in clouds for box, style in cloud.boxes}
    return [(box, {"color": _colour(clouds), **style}) for box, style in boxes.values()]


def _truths(clouds: Sequence[Cloud]) -> list[np.ndarray]:
    """The distinct true parameters of some clouds."""
    return list({cloud.truth.tobytes(): cloud.truth for cloud in clouds}.values())


def _colour(clouds: Sequence[Cloud]) -> str:
    return clouds[0].look.colour if len(clouds) == 1 else GREY


def _draw_contours(axes: Axes, cloud: Cloud, chosen: list[int], filled: bool) -> None:
    draws, look = cloud.draws[:, chosen], cloud.look
    low, high = cloud.support or (np.full(cloud.dim, -np.inf), np.full(cloud.dim, np.inf))
    x, y, fraction = smoothed(draws, np.stack([low[chosen], high[chosen]]))
    steps = np.append(levels(fraction), 1.0)
    if not np.all(np.diff(steps) > 0):  # a constant density has no contours
        axes.plot(*draws.T, ".", color=look.colour, markersize=2, gid="draws")
    elif filled:
        axes.contourf(x, y, fraction, steps, colors=[shade(look.colour, amount) for amount in _SHADES], zorder=1)
    else:
        axes.contourf(x, y, fraction, steps[[0, -1]], colors=[look.colour], alpha=0.15, zorder=1)
        line = {"colors": [look.colour], "linestyles": [look.linestyle], "linewidths": 0.8}
        axes.contour(x, y, fraction, steps[:-1], zorder=1.5, **line)


def draw(figure: Figure, histories: Sequence[History], titles: Sequence[str] | None = None) -> None:
    """Draw a pair plot for each run, side by side, all with the same axis limits."""
    look = looks([h.configuration for h in histories])
    clouds = [cloud_of(history, look[history.configuration]) for history in histories]
    titles = or_labels(titles, [cloud.look for cloud in clouds])
    scale, key = scales(histories[0].names, histories[0].units, 12), None
    if len(histories) > 1:  # names would be too long for panels that small
        scale = [dataclasses.replace(one, label=symbol(d), unit="") for d, one in enumerate(scale)]
        key = parameter_key(histories[0], figure)
    draw_groups(figure, [[cloud] for cloud in clouds], scale, titles)
    handles = [*_fraction_handles(clouds, _colour(clouds)), *_mark_handles(clouds)]
    below(figure, handles, at_most=len(handles) if is_wide(figure) else 2, title=key, handlelength=1.6)


def draw_overlay(figure: Figure, clouds: Sequence[Cloud], scale: Sequence[Scale], points: Sequence[Point] = ()) -> None:
    """Draw all clouds over one another in one pair plot; a point with a cloud's label shares its legend entry."""
    draw_groups(figure, [clouds], scale, points=points)
    own = _cloud_handles(clouds) if len(clouds) > 1 else _fraction_handles(clouds, _colour(clouds))
    shared = {handle.get_label(): handle for handle in own if isinstance(handle, Line2D)}
    for row, point in enumerate(points):
        marker = {"marker": _MARKERS[row % len(_MARKERS)], **_POINT}
        if point.look.label in shared:
            shared[point.look.label].set(**marker)
        else:
            own.append(Line2D([], [], color=point.look.colour, label=point.look.label, **marker))
    if handles := [*own, *_mark_handles(clouds, points)]:
        below(figure, handles, at_most=grid_shape(len(handles), 5 if is_wide(figure) else 2)[1])


def draw_groups(
    figure: Figure,
    groups: Sequence[Sequence[Cloud]],
    scale: Sequence[Scale],
    titles: Sequence[str] | None = None,
    points: Sequence[Point] = (),
) -> None:
    """Draw a pair plot for each group of clouds, which are overlaid; its title has the colour of the first."""
    dim = groups[0][0].dim
    rows, columns = arrangement(len(groups), dim)
    windows = [window([cloud for group in groups for cloud in group], d, points) for d in range(dim)]
    # Groups of panels with gaps between and titles above; one grid keeps all panels the same size.
    widths = [1.0] * dim + ([0.16] + [1.0] * dim) * (columns - 1)
    panel = figure.get_figwidth() / sum(widths)  # inches
    header = TITLE / panel if titles else 0.01
    heights = ([header] + [1.0] * dim) * rows
    grid = figure.add_gridspec(len(heights), len(widths), width_ratios=widths, height_ratios=heights)
    for place, group in enumerate(groups):
        top, left = (dim + 1) * (place // columns) + 1, (dim + 1) * (place % columns)
        if titles:
            header = figure.add_subplot(grid[top - 1, left : left + dim])
            header.set_axis_off()
            style = {"color": group[0].look.colour, "fontweight": "bold", "fontsize": "medium"}
            header.text(0, 0, titles[place], va="bottom", **style)
        for i in range(dim):
            for j in range(i + 1):
                axes = figure.add_subplot(grid[top + i, left + j])
                if i == j:
                    draw_marginal(axes, group, i, points)
                else:
                    draw_pair(axes, group, (j, i), points)
                _frame(axes, (j, i), windows, scale, last=i == dim - 1, numbered=left == 0, upright=panel < ROOMY)
    figure.align_labels()


def arrangement(count: int, dim: int) -> tuple[int, int]:
    """Rows and columns of pair plots, with at most four plots and a dozen panels side by side."""
    return grid_shape(count, max(1, min(4, 12 // dim)))


def parameter_key(history: History, figure: Figure) -> str:
    """Symbols, names and units of the parameters, in lines that fit the figure's width."""
    names = [parameter_label(history.names, history.units, d, 99).replace("\n", " ") for d in range(history.dim)]
    across = 4 if is_wide(figure) else 2
    return "\n".join(",  ".join(names[i : i + across]) for i in range(0, len(names), across))


def _frame(
    axes: Axes,
    pair: tuple[int, int],
    windows: list[tuple[float, float]],
    scale: Sequence[Scale],
    last: bool,
    numbered: bool,
    upright: bool,
) -> None:
    """Set limits and ticks; tick labels are on the left and lower sides of the group, rotated if panels are narrow."""
    x, y = pair
    axes.set_xlim(*windows[x])
    scale[x].show(axes.xaxis, 4)
    axes.tick_params(labelsize=6, labelbottom=last, pad=1.2)
    axes.tick_params(axis="x", labelrotation=90 * upright)
    if not last:
        axes.set_xlabel("")
    if x == y:
        return
    axes.set_ylim(*windows[y])
    scale[y].show(axes.yaxis, 4)
    axes.tick_params(axis="y", labelleft=x == 0 and numbered)
    if x > 0:
        axes.set_ylabel("")


def _fraction_handles(clouds: Sequence[Cloud], colour: str) -> list[Artist]:
    """Legend entries of filled contours, which are drawn only for pairs of parameters."""
    if clouds[0].dim == 1:
        return []
    return [
        Patch(color=shade(colour, amount), linewidth=0, label=f"{100 * fraction:.0f} % of the draws")
        for fraction, amount in zip(FRACTIONS[::-1], _SHADES[::-1], strict=True)
    ]


def _cloud_handles(clouds: Sequence[Cloud]) -> list[Artist]:
    """Legend entries of overlaid clouds."""
    lines = [
        Line2D([], [], color=cloud.look.colour, linestyle=cloud.look.linestyle, label=cloud.look.label)
        for cloud in clouds
    ]
    if clouds[0].dim == 1:
        return lines
    percentages = ", ".join(f"{100 * fraction:.0f}" for fraction in FRACTIONS[::-1])
    return [*lines, Line2D([], [], linestyle="none", label=f"contours: {percentages} % of the draws")]


def _mark_handles(clouds: Sequence[Cloud], points: Sequence[Point] = ()) -> list[Artist]:
    """Legend entries of the supports that have a bound in view, and of the truth if it is known."""
    handles: list[Artist] = []
    windows = np.array([window(clouds, d, points) for d in range(clouds[0].dim)]).T
    in_view = lambda box: box is not None and bool(((box >= windows[0]) & (box <= windows[1])).any())
    if any(in_view(cloud.support) for cloud in clouds):
        handles.append(Line2D([], [], color=_colour(clouds), label="support", **_SUPPORT))
    if any(in_view(cloud.first_support) for cloud in clouds):
        handles.append(Line2D([], [], color=_colour(clouds), label="first guess", **_FIRST_SUPPORT))
    if any(np.isfinite(cloud.truth).any() for cloud in clouds):
        marker = {"label": "truth", **_TRUTH_POINT} if clouds[0].dim > 1 else {"label": "truth", **TRUTH_LINE}
        handles.append(Line2D([], [], **marker))
    return handles
