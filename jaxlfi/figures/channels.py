"""Errors of the last posterior's simulations, channel by channel."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxlfi.figures import predictive
from jaxlfi.figures.collection import Runs, seed_count
from jaxlfi.figures.history import History
from jaxlfi.figures.legends import above, balanced
from jaxlfi.figures.natural import scale_ticks
from jaxlfi.figures.style import Look, looks, plain

UNIT = "observed sd, or measurement noise where larger"
"""Unit of the errors."""


def errors(history: History) -> np.ndarray:
    """Root mean square difference of each simulation and channel from the observation, shape [n, C].

    The unit is the channel's observed standard deviation, or that of its noise if it is larger
    (`jaxlfi.diagnostics.channel_errors`). Missing values of the observation are left out.
    """
    observed, simulated = history.observed, history.predictions
    if observed is None or simulated is None:
        raise ValueError(f"{history.folder}: expected an observation, and simulations of the last posterior")
    scale = np.maximum(np.nanstd(observed, axis=0), history.channel_noise)
    return np.sqrt(np.nanmean(((simulated - observed) / np.where(scale > 0, scale, 1.0)) ** 2, axis=1))


def drawable(history: History) -> bool:
    """Whether the last posterior was simulated, and an observation of the same shape has several channels."""
    if history.observed is None or not predictive.drawable(history):
        return False
    return history.observed.shape[1] > 1 and bool(np.isfinite(history.observed).any(axis=0).all())


def by_seed(histories: Sequence[History]) -> np.ndarray:
    """Errors of each seed, averaged over simulations, or those of each simulation of a single seed, shape [dots, C]."""
    return np.stack([errors(h).mean(0) for h in histories]) if len(histories) > 1 else errors(histories[0])


def shown(runs: Runs) -> list[int]:
    """Indices of the channels that differ from the observation in any run; actions never do."""
    every = np.concatenate([by_seed(histories) for histories in runs.values()])
    return np.flatnonzero(every.max(0) > 0).tolist()


def draw(figure: Figure, runs: Runs) -> None:
    """Draw a row for each channel: a dot for each seed, or each simulation of a single seed, and the median.

    The medians of a single configuration are also written as numbers.

    Args:
        figure: empty figure.
        runs: configurations with their seeds, all `drawable`.
    """
    axes, look, rows = figure.subplots(), looks(list(runs)), shown(runs)
    for place, (name, histories) in enumerate(runs.items()):
        offset = 0.8 * ((place + 0.5) / len(runs) - 0.5)
        draw_rows(axes, by_seed(histories)[:, rows], offset, 0.7 / len(runs), look[name])
    axes.set_yticks(range(len(rows)), [plain(next(iter(runs.values()))[0].channels[c]) for c in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.set_xscale("log")
    scale_ticks(axes.xaxis, 5)
    axes.set_xlabel(f"error [{UNIT}]")
    axes.grid(True, axis="x")
    if len(runs) == 1:
        right = axes.secondary_yaxis("right")
        medians = np.median(by_seed(next(iter(runs.values())))[:, rows], axis=0)
        right.set_yticks(range(len(rows)), [f"{value:.2g}" for value in medians])
        right.set_ylabel("median")
    handles = [Line2D([], [], **(own.line | {"linestyle": "none"})) for own in look.values()]
    handles.append(Line2D([], [], color="black", marker="|", markersize=7, linestyle="none", label="median"))
    seeds = seed_count(runs)
    title = f"one dot for each of {seeds} seeds" if seeds > 1 else "one dot for each simulation"
    above(figure, handles, title, balanced([*look.values(), Look("median", "black", "|", "")], figure))


def draw_rows(axes: Axes, values: np.ndarray, offset: float, width: float, look: Look) -> None:
    """Draw dots [n, rows] around a height in each row, and their medians as strokes."""
    jitter = width * ((np.arange(len(values)) * 0.6180339887) % 1.0 - 0.5)
    for row, own in enumerate(values.T):
        there = own > 0
        dots = {"marker": look.marker, "markersize": 2.8, "markeredgewidth": 0.0, "linestyle": "none", "alpha": 0.6}
        axes.plot(own[there], row + offset + jitter[there], color=look.colour, gid="dots", **dots)
        axes.plot([np.median(own)] * 2, row + offset + width * np.array([-0.6, 0.6]), color="black", gid="median")
