"""Trajectories simulated from the posterior, and the observed one."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxlfi.figures.history import History
from jaxlfi.figures.legends import below
from jaxlfi.figures.style import GREY, Look, grid_shape, is_wide, looks, or_labels, plain

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
ROWS = 5
"""Largest number of panels one above the other; a single run has up to two such columns."""
MAX_POINTS = 40
"""Largest number of records for which an observation is drawn as points; with more, it is drawn as a line."""


def quantiles(history: History) -> np.ndarray:
    """Quantiles of the simulated trajectories, shape [5, T, C]; failed simulations are left out."""
    return np.quantile(history.predictions, QUANTILES, axis=0)


def drawable(history: History) -> bool:
    """Whether there are simulations of the last posterior, and an observation of the same shape."""
    simulated, observed = history.predictions, history.observed
    if simulated is None or observed is None:
        return False
    return simulated.shape[1:] == observed.shape and len(observed) > 1


def draw_channel(axes: Axes, history: History, channel: int, look: Look) -> None:
    """Draw bands of 5-95 % and 25-75 %, the median, and the observation of one channel."""
    bands = quantiles(history)[..., channel]
    axes.fill_between(history.times, bands[0], bands[4], color=look.colour, alpha=0.18, linewidth=0)
    axes.fill_between(history.times, bands[1], bands[3], color=look.colour, alpha=0.32, linewidth=0)
    axes.plot(history.times, bands[2], color=look.colour, gid="median")
    axes.plot(history.times, history.observed[:, channel], gid="observed", **_observed(history))
    axes.margins(x=0.02 if _few(history) else 0)


def shown(histories: Sequence[History]) -> list[int]:
    """Indices of the channels that are drawn: all, or if there is no room, those with the largest observed ranges."""
    observed = histories[0].observed
    ranges = np.nan_to_num(np.nanmax(observed, axis=0) - np.nanmin(observed, axis=0))
    room = ROWS * (2 if len(histories) == 1 else 1)
    return sorted(np.argsort(-ranges, kind="stable")[:room].tolist())


def grid(histories: Sequence[History]) -> tuple[int, int]:
    """Rows and columns of panels: a column for each run, or up to two for the channels of a single one."""
    channels = len(shown(histories))
    return (channels, len(histories)) if len(histories) > 1 else grid_shape(channels, 1 if channels <= ROWS else 2)


def draw(figure: Figure, histories: Sequence[History], titles: Sequence[str] | None = None) -> None:
    """Draw a column for each run and a row for each channel; many channels of a single run are in two columns."""
    look = looks([h.configuration for h in histories])
    titles = or_labels(titles, [look[h.configuration] for h in histories])
    first, channels = histories[0], shown(histories)
    rows, columns = grid(histories)
    several = len(histories) > 1
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey="row" if several else False)
    if several:
        places = [(h, c, panels[row, column]) for column, h in enumerate(histories) for row, c in enumerate(channels)]
    else:
        places = [(first, c, axes) for c, axes in zip(channels, panels.ravel(), strict=False)]
        for axes in panels.ravel()[len(channels) :]:
            axes.remove()
    for history, channel, axes in places:
        draw_channel(axes, history, channel, look[history.configuration])
        axes.grid(True)
        if not several or history is first:
            axes.set_ylabel(plain(first.channels[channel]))
            _robust_limits(axes, histories, channel)
    lowest = panels[-1] if several else [axes for _, _, axes in places[-columns:]]
    for axes in lowest:
        axes.set_xlabel(plain(first.record_label))
        axes.tick_params(labelbottom=True)
        axes.locator_params(axis="x", nbins=5)
    for title, history, axes in zip(titles, histories, panels[0], strict=False):
        axes.set_title(title, color=look[history.configuration].colour, fontweight="bold")
    handles = [
        Line2D([], [], label="observed", **_observed(first)),
        Line2D([], [], color=GREY, label="median of posterior simulations"),
        Patch(color=GREY, alpha=0.5, linewidth=0, label="central 50 %"),
        Patch(color=GREY, alpha=0.2, linewidth=0, label="central 90 %"),
    ]
    below(figure, handles, at_most=4 if is_wide(figure) else 2)


def _few(history: History) -> bool:
    return len(history.observed) <= MAX_POINTS


def _observed(history: History) -> dict:
    if _few(history):
        return {"color": "black", "marker": "o", "markersize": 3.0, "linestyle": "none"}
    return {"color": "black", "linewidth": 0.9}


def _robust_limits(axes: Axes, histories: Sequence[History], channel: int) -> None:
    """Set limits that show all of the observation, and predictions up to three times its range beyond it."""
    observed = np.concatenate([h.observed[:, channel] for h in histories])
    predicted = np.concatenate([quantiles(h)[..., channel].ravel() for h in histories])
    low, high = float(np.nanmin(observed)), float(np.nanmax(observed))  # NaN where a number is missing
    reach = 3.0 * ((high - low) or abs(high) or 1.0)
    bottom, top = min(low, max(predicted.min(), low - reach)), max(high, min(predicted.max(), high + reach))
    margin = 0.05 * ((top - bottom) or 1.0)
    axes.set_ylim(bottom - margin, top + margin)
