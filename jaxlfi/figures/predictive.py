"""Trajectories simulated from the posterior, and the observed one."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxlfi.figures.history import History
from jaxlfi.figures.legends import below
from jaxlfi.figures.style import GREY, Look, is_wide, looks, or_labels, plain

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
MAX_POINTS = 40
"""Records up to which an observation is drawn as points, and as a line beyond."""


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
    """Bands of 5-95 % and 25-75 %, the median, and the observation of one channel.

    Args:
        axes: to draw on.
        history: the run.
        channel: index of the trajectory's column.
        look: of the configuration.
    """
    bands = quantiles(history)[..., channel]
    axes.fill_between(history.times, bands[0], bands[4], color=look.colour, alpha=0.18, linewidth=0)
    axes.fill_between(history.times, bands[1], bands[3], color=look.colour, alpha=0.32, linewidth=0)
    axes.plot(history.times, bands[2], color=look.colour, gid="median")
    axes.plot(history.times, history.observed[:, channel], gid="observed", **_observed(history))
    axes.margins(x=0.02 if _few(history) else 0)


def draw(figure: Figure, histories: Sequence[History], titles: Sequence[str] | None = None) -> None:
    """A column for each run, a row for each channel.

    Args:
        figure: empty.
        histories: one run for each column, of the same task.
        titles: of the columns; by default the configurations' names.
    """
    look = looks([h.configuration for h in histories])
    titles = or_labels(titles, [look[h.configuration] for h in histories])
    first = histories[0]
    axes = figure.subplots(len(first.channels), len(histories), squeeze=False, sharex=True, sharey="row")
    for column, history in enumerate(histories):
        own = look[history.configuration]
        axes[0, column].set_title(titles[column], color=own.colour, fontweight="bold")
        for channel in range(len(first.channels)):
            draw_channel(axes[channel, column], history, channel, own)
            axes[channel, column].grid(True)
        axes[-1, column].set_xlabel(plain(history.record_label))
        axes[-1, column].locator_params(axis="x", nbins=5)
    for channel, name in enumerate(first.channels):
        axes[channel, 0].set_ylabel(plain(name))
        _robust_limits(axes[channel, 0], histories, channel)
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
    """Limits that show all of the observation, and predictions within three times its range."""
    observed = np.concatenate([h.observed[:, channel] for h in histories])
    predicted = np.concatenate([quantiles(h)[..., channel].ravel() for h in histories])
    low, high = float(np.nanmin(observed)), float(np.nanmax(observed))  # NaN where a number is missing
    reach = 3.0 * ((high - low) or abs(high) or 1.0)
    bottom, top = min(low, max(predicted.min(), low - reach)), max(high, min(predicted.max(), high + reach))
    margin = 0.05 * ((top - bottom) or 1.0)
    axes.set_ylim(bottom - margin, top + margin)
