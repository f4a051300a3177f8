"""The parameters simulated in each round, and the last posterior."""

import itertools
from collections.abc import Sequence

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch, Rectangle
from matplotlib.ticker import MaxNLocator

from jaxlfi.figures import density
from jaxlfi.figures.history import History
from jaxlfi.figures.legends import below
from jaxlfi.figures.natural import scales
from jaxlfi.figures.style import (
    TRUTH,
    TRUTH_LINE,
    Look,
    integer_ticks,
    iteration_bar,
    iteration_colours,
    looks,
    or_labels,
)

_ARROW = {
    **{"arrowstyle": "-|>,head_length=2.2,head_width=1.0", "mutation_scale": 1, "shrinkA": 0, "shrinkB": 0},
    **{"linewidth": 0.6, "color": "black", "zorder": 5},
    "path_effects": [patheffects.withStroke(linewidth=1.5, foreground="white")],
}


def pairs(dim: int) -> list[tuple[int, ...]]:
    """Consecutive pairs of parameters; an odd last one is paired with the first, and a single one stands alone."""
    if dim == 1:
        return [(0,)]
    return [(d, d + 1) if d + 1 < dim else (d, 0) for d in range(0, dim, 2)]


def limits(histories: Sequence[History], d: int) -> tuple[float, float]:
    """Axis limits of a parameter that show all supports, the truth, and the means unless they are far outside."""
    boxes = np.concatenate([np.concatenate(h.supports)[:, d] for h in histories])
    boxes = np.concatenate([boxes, [h.truth[d] for h in histories]])
    low, high = float(np.nanmin(boxes)), float(np.nanmax(boxes))
    width = high - low
    means = np.concatenate([h.weighted_means[:, d] for h in histories])
    means = means[np.isfinite(means)].clip(low - 0.15 * width, high + 0.15 * width)
    low, high = min([low, *means]), max([high, *means])
    return low - 0.04 * width, high + 0.04 * width


def closer_limits(histories: Sequence[History], d: int) -> tuple[float, float]:
    """Axis limits of a parameter around the last mixtures, the path of the weighted means, and the truth."""
    shown = [np.concatenate([h.weighted_means[:, d] for h in histories]), [h.truth[d] for h in histories]]
    for history in histories:
        weight = density.weights(history.logits[-1])
        heavy = weight > 0.2 * weight.max()
        mean = history.means[-1, heavy, d]
        scale = np.sqrt(np.sum(history.scale_tril[-1, heavy, d] ** 2, axis=-1))
        shown += [mean - 3 * scale, mean + 3 * scale]
    every = np.concatenate(shown)
    every = every[np.isfinite(every)]
    outer = limits(histories, d)
    if not every.size:
        return outer
    margin = 0.06 * np.ptp(every)
    low, high = max(every.min() - margin, outer[0]), min(every.max() + margin, outer[1])
    return (float(low), float(high)) if low < high else outer


def draw(figure: Figure, histories: Sequence[History], titles: Sequence[str] | None = None) -> None:
    """Draw one column per run: proposals by iteration above, the last mixture below, for each pair of parameters.

    A single run has them side by side.
    """
    look = looks([h.configuration for h in histories])
    titles = or_labels(titles, [look[h.configuration] for h in histories])
    shown = pairs(histories[0].dim)
    upper, lower = _panels(figure, len(shown), len(histories))
    for column, history in enumerate(histories):
        own = look[history.configuration]
        if len(histories) > 1:
            upper[0, column].set_title(titles[column], color=own.colour, fontweight="bold")
        else:
            figure.suptitle(titles[0], color=own.colour, fontweight="bold", fontsize="medium")
        for row, pair in enumerate(shown):
            draw_proposals(upper[row, column], history, pair, [limits(histories, d) for d in pair])
            draw_mixture(lower[row, column], history, pair, [closer_limits(histories, d) for d in pair], own)
            if column:
                upper[row, column].tick_params(labelleft=False)
                upper[row, column].set_ylabel("")
                lower[row, column].tick_params(labelleft=len(pair) == 1)
                lower[row, column].set_ylabel("")
    if len(shown[0]) == 2:
        iteration_bar(figure, upper, histories[0].rounds)
    legend(figure, histories)


def _panels(figure: Figure, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Axes of proposals and of mixtures, [rows, columns] each: one above the other, or side by side."""
    if columns == 1:
        axes = figure.subplots(rows, 2, squeeze=False)
        return axes[:, :1], axes[:, 1:]
    axes = figure.subplots(2 * rows, columns, squeeze=False)
    return axes[:rows], axes[rows:]


def draw_proposals(
    axes: Axes, history: History, pair: tuple[int, ...], window: Sequence[tuple[float, float]] | None = None
) -> None:
    """Draw proposals of all iterations over a pair of parameters (or one), with the supports they were drawn from."""
    window = window or [limits([history], d) for d in pair]
    colours, norm = iteration_colours(history.rounds)
    iteration = np.broadcast_to(np.arange(1, history.rounds + 1)[:, None], history.counted.shape)
    points = _plane(history.theta, pair, iteration)
    failed = history.counted & (history.failure != 0)
    by_iteration = {"cmap": colours, "norm": norm}
    for chosen, style in (
        (failed, {"marker": "x", "s": 5, "linewidths": 0.45}),
        (history.kept, {"s": 3.5, "linewidths": 0}),
    ):
        chosen = chosen & np.isfinite(points).all(-1)
        axes.scatter(*points[chosen].T, c=iteration[chosen], alpha=0.75, zorder=2, **by_iteration, **style)
    for i in range(history.rounds):
        low, high = history.proposal_low[i], history.proposal_high[i]
        _add_box(axes, low, high, pair, i + 1, edgecolor=colours(norm(i + 1)), linewidth=0.9, zorder=3)
    mean = _plane(history.accumulated_means, pair, iteration[:, 0])
    marked = {"s": 22, "edgecolors": "white", "linewidths": 0.6, "gid": "accumulated mean"}
    axes.scatter(*mean.T, c=iteration[:, 0], zorder=4, **by_iteration, **marked)
    _mark_truth(axes, history, pair)
    _frame(axes, history, pair, window)
    if len(pair) == 1:
        axes.set_ylim(history.rounds + 0.7, 0.3)
        integer_ticks(axes.yaxis)
        axes.set_ylabel("iteration")


def draw_mixture(
    axes: Axes,
    history: History,
    pair: tuple[int, ...],
    window: Sequence[tuple[float, float]] | None = None,
    look: Look | None = None,
    bar: bool = True,
) -> None:
    """Draw the last mixture's marginal over a pair of parameters (or one), and the path of the weighted means.

    `bar` adds a colour bar for the density of a pair.
    """
    window = window or [closer_limits([history], d) for d in pair]
    look = look or looks([history.configuration])[history.configuration]
    weight = density.weights(history.logits[-1])
    mean, covariance = density.marginal(history.means[-1], history.scale_tril[-1], pair)
    if np.isfinite(weight).all() and np.isfinite(mean).all() and np.isfinite(covariance).all():
        _draw_density(axes, weight, mean, covariance, window, look, bar)
    else:
        axes.text(0.5, 0.5, "posterior is not finite", transform=axes.transAxes, ha="center", va="center")
    low, high = (bound[-1] for bound in history.supports)
    if len(pair) == 2:
        _add_box(axes, low, high, pair, 0, edgecolor=look.colour, linewidth=0.9, zorder=2)
        if history.adapts:
            first = (bound[0] for bound in history.supports)
            _add_box(axes, *first, pair, 0, edgecolor=look.colour, linestyle=(0, (1, 1.2)), linewidth=0.9, zorder=2)
    else:
        axes.axvspan(low[pair[0]], high[pair[0]], color=look.colour, alpha=0.08, linewidth=0, zorder=0)
    _draw_path(axes, history, pair)
    _mark_truth(axes, history, pair)
    _frame(axes, history, pair, window)


def _draw_density(axes: Axes, weight, mean, covariance, window, look: Look, with_bar: bool) -> None:
    scale = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    there = weight > 1e-3
    grids = [density.grid(*window[i], mean[there, i], scale[there, i]) for i in range(mean.shape[1])]
    points = np.stack(np.meshgrid(*grids, indexing="xy"), -1)
    values = density.density(points, weight, mean, covariance)
    if len(grids) == 1:
        axes.fill_between(grids[0], values, color=look.colour, alpha=0.25, linewidth=0)
        axes.plot(grids[0], values, color=look.colour, gid="density")
        axes.set_ylim(0, 1.15 * values.max() or 1.0)
        axes.set_ylabel("posterior density")
        return
    mesh: QuadMesh = axes.pcolormesh(*grids, values, cmap=look.density, vmin=0, shading="nearest", zorder=1)
    if not with_bar:
        return
    # The bar is as wide as the panel, so that columns of panels stay aligned.
    bar = axes.figure.colorbar(mesh, cax=axes.inset_axes([0.0, 1.03, 1.0, 0.045]), orientation="horizontal")
    bar.locator = MaxNLocator(nbins=3, min_n_ticks=2)
    bar.formatter.set_powerlimits((-2, 3))
    bar.update_ticks()
    bar.ax.xaxis.set_ticks_position("top")
    bar.ax.xaxis.set_label_position("top")
    bar.ax.tick_params(pad=0.5, length=1.5)
    bar.set_label("posterior density", labelpad=1.5)
    bar.outline.set_linewidth(0.4)


def _draw_path(axes: Axes, history: History, pair: tuple[int, ...]) -> None:
    """Draw arrows from each iteration's weighted mean to the next one's."""
    if len(pair) == 1:
        heights = axes.get_ylim()[1] * np.linspace(0.95, 0.05, history.rounds)
        path = np.stack([history.weighted_means[:, pair[0]], heights], -1)
    else:
        path = history.weighted_means[:, list(pair)]
    path = path[np.isfinite(path).all(-1)]
    axes.plot(
        *path.T, "o", color="black", markersize=1.6, markeredgecolor="white", markeredgewidth=0.3, gid="weighted mean"
    )
    for start, end in itertools.pairwise(path):
        if not np.array_equal(start, end):
            axes.add_patch(FancyArrowPatch(start, end, **_ARROW))


def _plane(theta: np.ndarray, pair: tuple[int, ...], iteration: np.ndarray) -> np.ndarray:
    """Points [..., 2] to draw: two parameters, or one and its iteration, jittered so that points do not overlap."""
    if len(pair) == 2:
        return theta[..., list(pair)]
    height = iteration.astype(float)
    if theta.ndim == 3:
        golden = (np.arange(theta.shape[1]) * 0.6180339887) % 1.0
        height = height + 0.6 * (golden - 0.5)
    return np.stack([theta[..., pair[0]], height], -1)


def _add_box(axes: Axes, low: np.ndarray, high: np.ndarray, pair: tuple[int, ...], iteration: int, **style) -> None:
    if len(pair) == 2:
        corner, size = low[list(pair)], (high - low)[list(pair)]
    else:
        corner, size = (low[pair[0]], iteration - 0.42), (high[pair[0]] - low[pair[0]], 0.84)
    axes.add_patch(Rectangle(corner, *size, fill=False, **style))


def _mark_truth(axes: Axes, history: History, pair: tuple[int, ...]) -> None:
    truth = history.truth[list(pair)]
    if not np.isfinite(truth).all():
        return
    if len(pair) == 2:
        axes.plot(*truth, zorder=10, gid="truth", **TRUTH)
    else:
        axes.axvline(truth[0], zorder=10, gid="truth", **TRUTH_LINE)


def _frame(axes: Axes, history: History, pair: tuple[int, ...], window: Sequence[tuple[float, float]]) -> None:
    axes.set_xlim(*window[0])
    scale = scales(history.names, history.units)
    scale[pair[0]].show(axes.xaxis, 5)
    if len(pair) == 2:
        axes.set_ylim(*window[1])
        scale[pair[1]].show(axes.yaxis, 5)


def legend(
    figure: Figure,
    histories: Sequence[History],
    at_most: int | None = None,
    others: Sequence[Line2D] = (),
    proposals: bool = True,
) -> None:
    """Add a legend below panels of `draw_proposals` and `draw_mixture`.

    Args:
        figure: figure to add it to.
        histories: runs that are drawn.
        at_most: largest number of columns.
        others: additional entries.
        proposals: whether proposals are drawn.
    """

    def marker(shape: str, size: float, label: str, **style) -> Line2D:
        style = {"color": "#3B528B", "linestyle": "none", **style}
        return Line2D([], [], marker=shape, markersize=size, label=label, **style)

    failed = any((history.failed > 0).any() for history in histories)
    of_proposals = [
        marker("o", 2.5, "simulated", markeredgewidth=0),
        *[marker("x", 3, "failed", markeredgewidth=0.7)] * failed,
        marker("o", 5.5, "mean of data", markeredgecolor="white"),
    ]
    handles = [
        *(of_proposals if proposals else ()),
        marker("s", 6, "support (dotted: first guess)", markerfacecolor="none"),
        marker(r"$\rightarrow$", 7, "weighted mean", color="black", markeredgewidth=0.3),
        *others,
    ]
    if any(np.isfinite(h.truth).all() for h in histories):
        handles.append(Line2D([], [], label="truth", **(TRUTH_LINE if histories[0].dim == 1 else TRUTH)))
    below(figure, handles, at_most, handletextpad=0.2, columnspacing=1.2)
