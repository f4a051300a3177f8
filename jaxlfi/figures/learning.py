"""Learning curves: returns of training episodes by domain, one line per seed and their mean."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from jaxlfi.figures.style import context, looks, new_figure, save

WINDOW = 12
"""Updates that a running mean is taken over."""


def draw(figure: Figure, names: Sequence[tuple[str, int]], returns: np.ndarray, steps_per_update: int) -> None:
    """A thin line for each training, a thick one for the mean of a domain's seeds.

    Args:
        figure: empty.
        names: domain and seed of each of the R trainings.
        returns: mean return of the episodes that ended in an update, shape [updates, R]; NaN where none did.
        steps_per_update: environment steps.
    """
    axes = figure.subplots()
    domains = list(dict.fromkeys(domain for domain, _ in names))
    look = looks(domains)
    steps = steps_per_update * (1 + np.arange(len(returns)))
    smooth = running_mean(returns, min(WINDOW, len(returns)))
    for domain in domains:
        own = [place for place, (name, _) in enumerate(names) if name == domain]
        if len(own) > 1:
            axes.plot(steps, smooth[:, own], color=look[domain].colour, alpha=0.35, linewidth=0.7)
        axes.plot(steps, smooth[:, own].mean(axis=1), **look[domain].line)
    axes.set_xlabel("environment steps")
    axes.set_ylabel("return of training episodes")
    axes.legend(frameon=False)


def running_mean(values: np.ndarray, window: int) -> np.ndarray:
    """Means of the last `window` rows that are known, shape of `values`; NaN before there is one."""
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
