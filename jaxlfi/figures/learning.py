"""Learning curves: returns of training episodes by domain, with the median and quartiles of seeds."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import StrMethodFormatter

from jaxlfi.figures.bands import draw_band, over
from jaxlfi.figures.style import Look, context, looks, new_figure, round_ticks, save

WINDOW = 12
"""Number of updates in a running mean."""


def draw(figure: Figure, names: Sequence[tuple[str, int]], returns: np.ndarray, steps_per_update: int) -> None:
    """Draw a line for the median of each domain's seeds, and a band of their quartiles.

    Args:
        figure: empty figure.
        names: domain and seed of each of the R training runs.
        returns: mean return of the episodes that ended in an update, shape [updates, R]; NaN if none did.
        steps_per_update: number of environment steps per update.
    """
    domains = list(dict.fromkeys(domain for domain, _ in names))
    own = {domain: returns[:, [name == domain for name, _ in names]] for domain in domains}
    draw_curves(
        figure.subplots(), {look.label: (look, own[name]) for name, look in looks(domains).items()}, steps_per_update
    )


def draw_curves(axes: Axes, curves: Mapping[str, tuple[Look, np.ndarray]], steps_per_update: int) -> None:
    """Draw running means of returns over environment steps, with a legend.

    Args:
        axes: axes to draw on.
        curves: look and mean returns, shape [updates, seeds], by label.
        steps_per_update: number of environment steps per update.
    """
    for label, (look, returns) in curves.items():
        steps = steps_per_update * (1 + np.arange(len(returns)))
        smooth = running_mean(returns, min(WINDOW, len(returns)))
        draw_band(axes, steps, smooth.T, dataclasses.replace(look, label=label))
        axes.lines[-1].set_markevery(max(1, len(returns) // 8))
    counts = [returns.shape[1] for _, returns in curves.values()]
    axes.set_xlabel("environment steps")
    axes.set_ylabel("return of training episodes")
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
    round_ticks(axes.xaxis, 5)
    axes.grid(True)
    axes.legend(title=over(max(counts), fewest=min(counts)), title_fontsize="medium", loc="lower right")


def running_mean(values: np.ndarray, window: int) -> np.ndarray:
    """Means of the known values in the last `window` rows, shape of `values`; NaN if there are none."""
    known = np.isfinite(values)
    sums = np.cumsum(np.where(known, values, 0.0), axis=0)
    counts = np.cumsum(known, axis=0)
    late = lambda cumulated: cumulated - np.concatenate([np.zeros_like(cumulated[:window]), cumulated[:-window]])
    with np.errstate(invalid="ignore", divide="ignore"):
        return late(sums) / late(counts)


def save_curves(path: Path, names: Sequence[tuple[str, int]], returns: np.ndarray, steps_per_update: int) -> Path:
    """Write the learning curves as a picture."""
    with context():
        figure = new_figure(5.0, 3.2)
        draw(figure, names, returns, steps_per_update)
        return save(figure, path, dpi=200)
