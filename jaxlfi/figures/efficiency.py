"""Simulations run in each round, and how many of them failed."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxlfi.figures import statistics
from jaxlfi.figures.collection import Runs, first_of, seed_count
from jaxlfi.figures.legends import of_configurations
from jaxlfi.figures.style import iterations_axis, looks

PANELS = {"attempted": "simulations", "success_rate": "success rate [%]", "cumulative": "cumulative failures"}


def quantities(runs: Runs, configuration: str) -> dict[str, np.ndarray]:
    """The values of a configuration by panel, shape [seeds, R] each."""
    attempted = np.stack([h.attempted for h in runs[configuration]]).astype(float)
    failed = np.stack([h.failed for h in runs[configuration]]).astype(float)
    rate = np.where(attempted > 0, 100 * (1 - failed / np.maximum(attempted, 1)), np.nan)
    return {"attempted": attempted, "success_rate": rate, "cumulative": np.cumsum(failed, axis=1)}


def draw(figure: Figure, runs: Runs) -> None:
    """Simulations, success rate and cumulative failures over iterations: means over seeds, and each seed."""
    look = looks(list(runs))
    axes = dict(zip(PANELS, figure.subplots(1, len(PANELS)), strict=True))
    rounds = first_of(runs).rounds
    for name in runs:
        for panel, values in quantities(runs, name).items():
            iteration = np.arange(1, rounds + 1)
            if len(values) > 1:
                axes[panel].plot(iteration, values.T, color=look[name].colour, linewidth=0.4, alpha=0.6)
            axes[panel].plot(iteration, statistics.mean(values, 0), **look[name].line)
    for panel, title in PANELS.items():
        axes[panel].set_title(title)
        axes[panel].grid(True)
        axes[panel].yaxis.set_major_locator(MaxNLocator(nbins=5, integer=True, steps=[1, 2, 5, 10]))
        iterations_axis(axes[panel], rounds)
    low, _ = axes["success_rate"].get_ylim()
    axes["success_rate"].set_ylim(max(low, -3.0), 103.0)
    axes["cumulative"].set_ylim(bottom=0)
    seeds = seed_count(runs)
    of_configurations(figure, look, f"mean over {seeds} seeds, thin: each seed" if seeds > 1 else "one seed")
