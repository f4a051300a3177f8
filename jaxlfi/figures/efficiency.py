"""How many simulations each round attempted, and how many of them failed."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxlfi.figures import statistics
from jaxlfi.figures.bands import draw_band, legend
from jaxlfi.figures.collection import Runs
from jaxlfi.figures.style import iterations_axis, looks

PANELS = {
    "attempted": "attempted simulations",
    "success_rate": "success rate [%]",
    "cumulated": "cumulated failures",
}


def quantities(runs: Runs, configuration: str) -> dict[str, np.ndarray]:
    """What the panels show of a configuration, by panel, each of shape [seeds, R]."""
    attempted = np.stack([h.attempted for h in runs[configuration]]).astype(float)
    failed = np.stack([h.failed for h in runs[configuration]]).astype(float)
    rate = np.where(attempted > 0, 100 * (1 - failed / np.maximum(attempted, 1)), np.nan)
    return {"attempted": attempted, "success_rate": rate, "cumulated": np.cumsum(failed, axis=1)}


def draw(figure: Figure, runs: Runs) -> None:
    """Simulations, success rate and failures so far over iterations; mean over seeds, and its sd as a band.

    Args:
        figure: empty.
        runs: configurations with their seeds.
    """
    look = looks(list(runs))
    axes = dict(zip(PANELS, figure.subplots(1, len(PANELS)), strict=True))
    rounds = next(iter(runs.values()))[0].rounds
    for name in runs:
        for panel, values in quantities(runs, name).items():
            middle, spread = statistics.mean(values, 0), statistics.sd(values, 0)
            draw_band(axes[panel], np.arange(1, rounds + 1), middle, spread, look[name])
    for panel, title in PANELS.items():
        axes[panel].set_title(title)
        axes[panel].grid(True)
        axes[panel].yaxis.set_major_locator(MaxNLocator(nbins=5, integer=True, steps=[1, 2, 5, 10]))
        iterations_axis(axes[panel], rounds)
    low, _ = axes["success_rate"].get_ylim()
    axes["success_rate"].set_ylim(max(low, -3.0), 103.0)
    axes["cumulated"].set_ylim(bottom=0)
    seeds = max(len(histories) for histories in runs.values())
    legend(figure, look, f"mean ± standard deviation over {seeds} seeds" if seeds > 1 else "one seed")
