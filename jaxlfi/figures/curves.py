"""Accuracy exp(-error) of posterior samples over iterations, for trajectories and for each parameter."""

import numpy as np
from matplotlib.figure import Figure

from jaxlfi.figures import statistics
from jaxlfi.figures.bands import draw_band, over
from jaxlfi.figures.collection import Runs, all_of, first_of, seed_count
from jaxlfi.figures.legends import of_configurations
from jaxlfi.figures.style import grid_shape, iterations_axis, looks, parameter_name

COLUMNS = 5
"""Largest number of panels side by side."""


def trajectory_curve(runs: Runs, configuration: str, alpha: float = 1.0) -> np.ndarray | None:
    """exp(-alpha L) of the trajectories, shape [seeds, R, N]; 0 for a sample whose simulation failed."""
    errors = [h.trajectory_error for h in runs[configuration] if h.trajectory_error is not None]
    if not errors:
        return None
    stacked = np.stack(errors)
    return np.exp(-alpha * np.where(np.isnan(stacked), np.inf, stacked))


def theta_curve(runs: Runs, configuration: str, alpha: float = 1.0) -> np.ndarray | None:
    """exp(-alpha L) of the parameters, shape [seeds, R, N, D], or None if the truth is unknown."""
    errors = [h.theta_error for h in runs[configuration] if h.theta_error is not None]
    return np.exp(-alpha * np.stack(errors)) if errors else None


def by_seed(values: np.ndarray) -> np.ndarray:
    """Curves of the band of values [seeds, R, N]: means of each seed [seeds, R], or samples of a single one [N, R]."""
    return statistics.mean(values, 2) if len(values) > 1 else values[0].T


def drawable(runs: Runs) -> bool:
    """Whether there is a discrepancy to show."""
    return any(h.trajectory_error is not None or h.theta_error is not None for h in all_of(runs))


def draw(figure: Figure, runs: Runs, alpha: float = 1.0) -> None:
    """Draw a panel of exp(-alpha L) for trajectories, if there are any, and for each parameter, if truth is known."""
    look = looks(list(runs))
    first = first_of(runs)
    trajectories = {name: trajectory_curve(runs, name, alpha) for name in runs}
    thetas = {name: theta_curve(runs, name, alpha) for name in runs}
    # The trajectory's panel, then one per parameter.
    panels: list[int | None] = [None] * any(v is not None for v in trajectories.values())
    panels += [*range(first.dim)] * any(v is not None for v in thetas.values())
    rows, columns = grid_shape(len(panels), COLUMNS)
    # One scale for all panels, so that parameters can be compared with one another and with the trajectory.
    every = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for place, (d, axes) in enumerate(zip(panels, every, strict=False)):
        for name in runs:
            values = trajectories[name] if d is None else thetas[name]
            if values is not None:
                values = values if d is None else values[..., d]
                draw_band(axes, np.arange(1, first.rounds + 1), by_seed(values), look[name])
        axes.set_title("trajectory" if d is None else parameter_name(first.names, d))
        axes.grid(True)
        iterations_axis(axes, first.rounds, label=place + columns >= len(panels))
    for axes in every[len(panels) :]:
        axes.remove()
    factor = "" if alpha == 1 else rf"{alpha:g}\,"
    for axes in every[: len(panels) : columns]:
        axes.set_ylabel(rf"accuracy $\exp(-{factor}\mathrm{{error}})$")
    every[0].set_ylim(0, None)
    of_configurations(figure, look, over(seed_count(runs), "median and quartiles of one seed's posterior samples"))
