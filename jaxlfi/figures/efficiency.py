"""Success rate of the simulations of each round, and total numbers of simulations and failures."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxlfi.figures.bands import draw_band, over
from jaxlfi.figures.collection import Runs, first_of, seed_count
from jaxlfi.figures.discrepancy import draw_dots
from jaxlfi.figures.legends import of_configurations
from jaxlfi.figures.style import iterations_axis, looks

PANELS = {
    "success_rate": "success rate [%]",
    "attempted": "simulations in all",
    "failed": "failed simulations in all",
}


def quantities(runs: Runs, configuration: str) -> dict[str, np.ndarray]:
    """The values of a configuration by panel: the rate in each round [seeds, R], and sums over rounds [seeds]."""
    attempted = np.stack([h.attempted for h in runs[configuration]]).astype(float)
    failed = np.stack([h.failed for h in runs[configuration]]).astype(float)
    rate = np.where(attempted > 0, 100 * (1 - failed / np.maximum(attempted, 1)), np.nan)
    return {"success_rate": rate, "attempted": attempted.sum(1), "failed": failed.sum(1)}


def draw(figure: Figure, runs: Runs) -> None:
    """Draw median and quartiles of the success rate over iterations, and a dot for each seed's total counts."""
    look = looks(list(runs))
    axes = dict(zip(PANELS, figure.subplots(1, len(PANELS), width_ratios=(1.6, 1, 1)), strict=True))
    rounds = first_of(runs).rounds
    found = {name: quantities(runs, name) for name in runs}
    for name, own in found.items():
        draw_band(axes["success_rate"], np.arange(1, rounds + 1), own["success_rate"], look[name])
    for panel in ("attempted", "failed"):
        draw_dots(axes[panel], {name: own[panel] for name, own in found.items()}, look)
    for panel, title in PANELS.items():
        axes[panel].set_title(title)
        axes[panel].yaxis.set_major_locator(MaxNLocator(nbins=5, integer=True, steps=[1, 2, 5, 10]))
    axes["success_rate"].grid(True)
    iterations_axis(axes["success_rate"], rounds)
    low, _ = axes["success_rate"].get_ylim()
    axes["success_rate"].set_ylim(max(low, -3.0), 103.0)
    of_configurations(figure, look, over(seed_count(runs)))
