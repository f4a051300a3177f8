"""Radar plots: errors of posterior samples by parameter, and of their simulations by summary."""

import re
import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.projections.polar import PolarAxes
from matplotlib.ticker import MaxNLocator

from jaxlfi.figures import statistics
from jaxlfi.figures.history import History
from jaxlfi.figures.legends import below
from jaxlfi.figures.pairs import parameter_key
from jaxlfi.figures.style import GREY, Look, looks, or_labels, plain, symbol

MIN_SPOKES, MAX_SPOKES = 3, 20
"""Fewer spokes enclose no area, and more cannot be distinguished."""


def reference(histories: Sequence[History]) -> History:
    """The run whose first round gives the units of all errors: the one with the OK support, or the first."""
    return next((h for h in histories if h.configuration == "ok"), histories[0])


def parameter_errors(history: History, unit: History) -> np.ndarray | None:
    """|theta - theta_gt| of the last posterior's samples in widths of `unit`'s first support, shape [N, D], or None."""
    low, high = unit.supports
    if history.theta_error is None or not MIN_SPOKES <= history.dim <= MAX_SPOKES:
        return None
    return history.theta_error[-1] / (high[0] - low[0])


def named(history: History) -> bool:
    """Whether the summaries have names. Trajectory records have none; they are in the posterior predictive picture."""
    return not all(re.fullmatch(r"x_\d+", name) for name in history.summaries)


def summary_errors(history: History, unit: History) -> np.ndarray | None:
    """|x - x^r| of the samples' simulations in standard deviations of `unit`'s first round, shape [N, S], or None."""
    if history.final_x is None or history.x is None or unit.x_scale is None:
        return None
    if not MIN_SPOKES <= len(history.x) <= MAX_SPOKES:
        return None
    if not named(history):
        return None
    # A summary that never varied has no unit, so its spoke stays empty.
    scale = np.where(unit.x_scale > 0, unit.x_scale, np.nan)
    return np.abs(history.final_x - history.x) / scale


def panels(histories: Sequence[History]) -> dict[str, list[np.ndarray]]:
    """The rows to draw, "parameters" and "summaries", each with the errors [N, spokes] of every run.

    The errors of a run whose simulations all failed are NaN.
    """
    unit = reference(histories)
    every = {
        "parameters": [parameter_errors(h, unit) for h in histories],
        "summaries": [summary_errors(h, unit) for h in histories],
    }
    shown = {}
    for name, errors in every.items():
        some = next((e for e in errors if e is not None), None)
        if some is not None:
            shown[name] = [np.full_like(some, np.nan) if e is None else e for e in errors]
    return shown


def draw_radar(axes: PolarAxes, errors: np.ndarray, names: Sequence[str], look: Look) -> None:
    """Draw the mean of errors [N, spokes] over samples, and a band of one standard deviation; NaN is left out."""
    mean, sd = statistics.mean(errors, 0), statistics.sd(errors, 0)
    angle = np.linspace(0, 2 * np.pi, len(mean), endpoint=False)
    known = np.flatnonzero(np.isfinite(mean))
    if known.size:
        closed = np.append(known, known[0])
        around, mean, sd = angle[closed], mean[closed], sd[closed]
        axes.fill_between(around, np.maximum(mean - sd, 0), mean + sd, color=look.colour, alpha=0.22, linewidth=0)
        axes.plot(around, mean, color=look.colour, marker=look.marker, markersize=2.6, linewidth=1.0, gid="mean")
    else:
        axes.text(0, 0, "none", ha="center", va="center", color=look.colour)
    axes.set_theta_offset(np.pi / 2)
    axes.set_theta_direction(-1)
    axes.set_xticks(angle, names, fontsize=6)
    for label, right, up in zip(axes.get_xticklabels(), np.sin(angle), np.cos(angle), strict=True):
        label.set_horizontalalignment("center" if abs(right) < 0.2 else "left" if right > 0 else "right")
        label.set_verticalalignment("center" if abs(up) < 0.9 else "bottom" if up > 0 else "top")
    axes.tick_params(axis="x", pad=-3)
    axes.tick_params(axis="y", labelsize=5.5, labelcolor="#555555")
    axes.set_rlabel_position(180 / len(names))
    axes.yaxis.set_major_locator(MaxNLocator(nbins=4, prune="lower"))
    axes.spines["polar"].set_linewidth(0.4)


def draw(figure: Figure, histories: Sequence[History], titles: Sequence[str] | None = None) -> None:
    """Draw one column per run: errors by parameter above and by summary below, each row on one scale."""
    look = looks([h.configuration for h in histories])
    first = histories[0]
    rows = panels(histories)
    titles = or_labels(titles, [look[h.configuration] for h in histories])
    spokes = {
        "parameters": [symbol(d) for d in range(first.dim)],
        "summaries": [textwrap.fill(plain(name), 9, break_long_words=False) for name in first.summaries],
    }
    # Row names and column titles have their own cells, as the layout reserves no room beside a circle.
    widths, heights = [0.06] + [1.0] * len(histories), [0.12] + [1.0] * len(rows)
    grid = figure.add_gridspec(len(heights), len(widths), width_ratios=widths, height_ratios=heights)
    for column, history in enumerate(histories, 1):
        colour = look[history.configuration].colour
        _write(figure.add_subplot(grid[0, column]), titles[column - 1], color=colour, fontsize="medium")
    for row, (name, errors) in enumerate(rows.items(), 1):
        _write(figure.add_subplot(grid[row, 0]), name, rotation=90)
        reach = np.concatenate([statistics.mean(e, 0) + statistics.sd(e, 0) for e in errors])
        top = float(np.max(reach[np.isfinite(reach)], initial=0.0))
        for column, (history, own_errors) in enumerate(zip(histories, errors, strict=True), 1):
            axes = figure.add_subplot(grid[row, column], projection="polar")
            draw_radar(axes, own_errors, spokes[name], look[history.configuration])
            axes.set_rlim(0, 1.05 * top or 1.0)
    handles = [
        Line2D([], [], color=GREY, marker="o", markersize=2.6, linewidth=1.0, label="mean over posterior samples"),
        Patch(color=GREY, alpha=0.3, linewidth=0, label="± standard deviation"),
    ]
    names = parameter_key(first, figure) if "parameters" in rows else None
    below(figure, handles, at_most=2, title=names)


def _write(axes: Axes, text: str, **style) -> None:
    """Write text in the middle of a cell, without axes."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, ha="center", va="center", fontweight="bold", **style)
