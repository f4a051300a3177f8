"""Corner plots: the last posterior's marginal of every parameter, and of every pair of them."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator

from jaxlfi.figures.history import History
from jaxlfi.figures.style import TRUTH, Look, looks, parameter_label, shade, symbol

MOST = 6
"""Parameters that a corner plot has room for."""
SHARES = (0.95, 0.8, 0.5)
"""Shares of the draws inside the contours, from the outermost on."""
_SHADES = (0.68, 0.3, -0.2)
_BINS = 48
_TRUTH_LINE = {"color": "black", "linestyle": (0, (4, 2)), "linewidth": 0.8}
_TRUTH_POINT = TRUTH | {"markersize": 4.5, "markeredgewidth": 0.5}
_BEFORE = {"linestyle": (0, (1, 1.2)), "linewidth": 0.8}


def drawable(history: History) -> bool:
    """Whether draws of the last posterior were saved, of no more parameters than there is room for."""
    return history.draws is not None and history.dim <= MOST and bool(np.isfinite(history.draws).all())


def window(histories: Sequence[History], d: int) -> tuple[float, float]:
    """Axis limits of a parameter: all but the farthest draws, the truth, and the bounds that are not far off."""
    ends = np.concatenate([np.quantile(h.draws[:, d], [0.003, 0.997]) for h in histories])
    ends = np.concatenate([ends, [h.truth[d] for h in histories if np.isfinite(h.truth[d])]])
    low, high = float(ends.min()), float(ends.max())
    bounds = np.concatenate([np.stack(h.supports)[:, [0, -1], d].ravel() for h in histories])
    reach = 0.35 * ((high - low) or np.ptp(bounds))
    near = bounds[(bounds >= low - reach) & (bounds <= high + reach)]
    low, high = min([low, *near]), max([high, *near])
    margin = 0.06 * ((high - low) or np.ptp(bounds))
    return low - margin, high + margin


def smoothed(draws: np.ndarray, box: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A density estimate from draws of two parameters: their histogram, smoothed by a normal kernel.

    The histogram ends at the bounds of the box, and what the kernel would spread beyond is reflected.

    Args:
        draws: shape [n, 2].
        box: lower and upper bounds of the two, shape [2, 2].

    Returns:
        Two axes of cell centres, [B] each, and the share of the draws in each cell, [B, B], the second parameter first.
    """
    low, high = np.quantile(draws, [0.002, 0.998], axis=0)
    margin = 0.15 * np.maximum(high - low, 0.02 * (box[1] - box[0]))
    low, high = np.maximum(low - margin, box[0]), np.minimum(high + margin, box[1])
    counts, *edges = np.histogram2d(*draws.T, bins=_BINS, range=list(zip(low, high, strict=True)))
    reach = np.arange(-8, 9)
    kernel = np.exp(-0.5 * (reach / 2.2) ** 2)
    kernel /= kernel.sum()
    share = np.pad(counts, reach[-1], mode="symmetric")
    for axis in (0, 1):
        share = np.apply_along_axis(np.convolve, axis, share, kernel, mode="valid")
    x, y = ((e[1:] + e[:-1]) / 2 for e in edges)
    return x, y, share.T / share.sum()


def levels(share: np.ndarray, shares: Sequence[float] = SHARES) -> np.ndarray:
    """The least density inside the smallest region that holds each of the shares of the draws.

    Args:
        share: of the draws in each cell, any shape, of sum 1.
        shares: in (0, 1).
    """
    ordered = np.sort(share, axis=None)[::-1]
    return ordered[np.searchsorted(np.cumsum(ordered), shares).clip(max=ordered.size - 1)]


def draw_marginal(axes: Axes, history: History, d: int, look: Look) -> None:
    """A histogram of one parameter's draws, with the support's bounds and the truth.

    Args:
        axes: to draw on.
        history: the run.
        d: index of the parameter.
        look: of the configuration.
    """
    style = {"histtype": "stepfilled", "color": shade(look.colour, 0.45), "gid": "marginal"}
    heights, _, _ = axes.hist(history.draws[:, d], bins=24, density=True, **style)
    for bounds, style in _boxes(history, look):
        for bound in bounds:
            axes.axvline(bound[d], **style)
    if np.isfinite(history.truth[d]):
        axes.axvline(history.truth[d], gid="truth", **_TRUTH_LINE)
    axes.set_ylim(0, 1.12 * heights.max())
    axes.set_yticks([])


def draw_pair(axes: Axes, history: History, pair: tuple[int, int], look: Look) -> None:
    """Filled contours around shares of the draws of two parameters, with the support and the truth.

    Args:
        axes: to draw on.
        history: the run.
        pair: indices of the parameters, the horizontal one first.
        look: of the configuration.
    """
    chosen = list(pair)
    low, high = history.supports
    x, y, share = smoothed(history.draws[:, chosen], np.stack([low[-1, chosen], high[-1, chosen]]))
    steps = np.append(levels(share), 1.0)
    if np.all(np.diff(steps) > 0):
        axes.contourf(x, y, share, steps, colors=[shade(look.colour, amount) for amount in _SHADES], zorder=1)
    for (low, high), style in _boxes(history, look):
        axes.add_patch(Rectangle(low[chosen], *(high - low)[chosen], fill=False, zorder=2, **style))
    if np.isfinite(history.truth[chosen]).all():
        axes.plot(*history.truth[chosen], zorder=3, gid="truth", **_TRUTH_POINT)


def draw(figure: Figure, histories: Sequence[History], titles: Sequence[str] | None = None) -> None:
    """A corner plot for each run, all on the same axes.

    Args:
        figure: empty.
        histories: runs of the same parameters, of which draws were saved.
        titles: of the plots; by default the configurations' names.
    """
    look = looks([h.configuration for h in histories])
    dim = histories[0].dim
    rows, columns = arrangement(len(histories), dim)
    windows = [window(histories, d) for d in range(dim)]
    # Groups of panels with a gap beside and a title above them: one grid keeps all panels of one size.
    widths = [1.0] * dim + ([0.16] + [1.0] * dim) * (columns - 1)
    heights = ([0.32] + [1.0] * dim) * rows
    grid = figure.add_gridspec(len(heights), len(widths), width_ratios=widths, height_ratios=heights)
    for place, history in enumerate(histories):
        own = look[history.configuration]
        top, left = (dim + 1) * (place // columns) + 1, (dim + 1) * (place % columns)
        header = figure.add_subplot(grid[top - 1, left : left + dim])
        header.set_axis_off()
        title = own.label if titles is None else titles[place]
        header.text(0, 0, title, color=own.colour, fontweight="bold", fontsize="medium", va="bottom")
        for i in range(dim):
            for j in range(i + 1):
                axes = figure.add_subplot(grid[top + i, left + j])
                if i == j:
                    draw_marginal(axes, history, i, own)
                else:
                    draw_pair(axes, history, (j, i), own)
                _frame(axes, (j, i), windows, last=i == dim - 1, labelled=left == 0)
    figure.align_labels()
    _legend(figure, histories)


def arrangement(count: int, dim: int) -> tuple[int, int]:
    """Rows and columns of corner plots, so that no more than a dozen panels stand side by side."""
    most = min(4, 12 // dim)
    rows = -(-count // most)
    return rows, -(-count // rows)


def parameter_key(history: History, figure: Figure) -> str:
    """What the symbols of the parameters stand for, in lines of the figure's width."""
    names = [parameter_label(history.names, history.units, d, 99).replace("\n", " ") for d in range(history.dim)]
    across = 4 if figure.get_size_inches()[0] > 5 else 2
    return "\n".join(",  ".join(names[i : i + across]) for i in range(0, len(names), across))


def _boxes(history: History, look: Look) -> list[tuple[tuple[np.ndarray, np.ndarray], dict]]:
    """The last support, and the first one where it is another."""
    low, high = history.supports
    last = (low[-1], high[-1]), {"color": look.colour, "linewidth": 0.9}
    first = (low[0], high[0]), {"color": look.colour, **_BEFORE}
    return [last, first] if history.adapts else [last]


def _frame(axes: Axes, pair: tuple[int, int], windows: list[tuple[float, float]], last: bool, labelled: bool) -> None:
    """Limits and ticks; numbers and symbols at the corner's left and lower sides."""
    x, y = pair
    axes.set_xlim(*windows[x])
    axes.xaxis.set_major_locator(MaxNLocator(nbins=3, steps=[1, 2, 2.5, 5, 10]))
    axes.tick_params(labelsize=6, labelbottom=last, pad=1.2)
    axes.tick_params(axis="x", labelrotation=90)
    if last:
        axes.set_xlabel(symbol(x))
    if x == y:
        return
    axes.set_ylim(*windows[y])
    axes.yaxis.set_major_locator(MaxNLocator(nbins=3, steps=[1, 2, 2.5, 5, 10]))
    axes.tick_params(axis="y", labelleft=x == 0 and labelled)
    if x == 0:
        axes.set_ylabel(symbol(y))


def _legend(figure: Figure, histories: Sequence[History]) -> None:
    grey = "#777777"
    handles = [
        Patch(color=shade(grey, amount), linewidth=0, label=f"{share:.0%} of the draws")
        for share, amount in zip(SHARES[::-1], _SHADES[::-1], strict=True)
    ]
    handles.append(Line2D([], [], color=grey, linewidth=0.9, label="support"))
    if any(h.adapts for h in histories):
        handles.append(Line2D([], [], color=grey, label="first support", **_BEFORE))
    if any(np.isfinite(h.truth).all() for h in histories):
        handles.append(Line2D([], [], label="truth", **_TRUTH_POINT))
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=len(handles) if figure.get_size_inches()[0] > 5 else 3,
        title=parameter_key(histories[0], figure),
        title_fontsize=7,
        handlelength=1.6,
    )
