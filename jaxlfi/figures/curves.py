"""exp(-loss) of posterior samples over iterations: trajectories above, each parameter in a grid below."""

import numpy as np
from matplotlib.figure import Figure

from jaxlfi.figures import statistics
from jaxlfi.figures.bands import draw_band
from jaxlfi.figures.collection import Runs, all_of, first_of, seed_count
from jaxlfi.figures.legends import of_configurations
from jaxlfi.figures.style import iterations_axis, looks, parameter_name


def trajectory_curve(runs: Runs, configuration: str, alpha: float = 1.0) -> np.ndarray | None:
    """exp(-alpha L) of the trajectories, shape [seeds, R, N]; 0 for a sample whose simulation failed."""
    errors = [h.trajectory_error for h in runs[configuration] if h.trajectory_error is not None]
    if not errors:
        return None
    stacked = np.stack(errors)
    return np.exp(-alpha * np.where(np.isnan(stacked), np.inf, stacked))


def theta_curve(runs: Runs, configuration: str, alpha: float = 1.0) -> np.ndarray | None:
    """exp(-alpha L) of the parameters, shape [seeds, R, N, D], or None where the truth is unknown."""
    errors = [h.theta_error for h in runs[configuration] if h.theta_error is not None]
    return np.exp(-alpha * np.stack(errors)) if errors else None


def middle_and_error(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard error of values [seeds, R, N]: over seeds' means, or over a single seed's samples."""
    count = len(values) if len(values) > 1 else values.shape[2]
    deviation = statistics.sd(statistics.mean(values, 2), 0) if len(values) > 1 else statistics.sd(values[0], 1)
    return statistics.mean(values, (0, 2)), deviation / np.sqrt(count)


def drawable(runs: Runs) -> bool:
    """Whether there is a discrepancy to show."""
    return any(h.trajectory_error is not None or h.theta_error is not None for h in all_of(runs))


def draw(figure: Figure, runs: Runs, alpha: float = 1.0) -> None:
    """Panels of exp(-alpha loss): of trajectories, if there are any, and of each parameter, if the truth is known."""
    look = looks(list(runs))
    first = first_of(runs)
    trajectories = {name: trajectory_curve(runs, name, alpha) for name in runs}
    thetas = {name: theta_curve(runs, name, alpha) for name in runs}
    columns = 2 if first.dim <= 4 else 3
    below = [[f"{d}" for d in range(r, min(r + columns, first.dim))] for r in range(0, first.dim, columns)]
    mosaic = [["trajectory"] * columns] if any(v is not None for v in trajectories.values()) else []
    if any(v is not None for v in thetas.values()):
        # The last row's panels fill its width.
        mosaic += [row + [row[-1]] * (columns - len(row)) for row in below]
    heights = [1.5 if row[0] == "trajectory" else 1.0 for row in mosaic]
    panels = figure.subplot_mosaic(mosaic, gridspec_kw={"height_ratios": heights})
    for name in runs:
        for panel, axes in panels.items():
            values = trajectories[name] if panel == "trajectory" else thetas[name]
            if values is None:
                continue
            values = values if panel == "trajectory" else values[..., int(panel)]
            draw_band(axes, np.arange(1, first.rounds + 1), *middle_and_error(values), look[name])
    for panel, axes in panels.items():
        axes.set_title("trajectory" if panel == "trajectory" else parameter_name(first.names, int(panel)))
        axes.grid(True)
        left = panel == "trajectory" or int(panel) % columns == 0
        factor = "" if alpha == 1 else rf"{alpha:g}\,"
        axes.set_ylabel(rf"$\exp(-{factor}\mathcal{{L}})$" if left else "")
        iterations_axis(axes, first.rounds, label=panel in mosaic[-1])
    # Parameters are compared with one another: one scale for all of them.
    top = max((axes.get_ylim()[1] for panel, axes in panels.items() if panel != "trajectory"), default=1.0)
    for panel, axes in panels.items():
        axes.set_ylim(0, None if panel == "trajectory" else top)
    seeds = seed_count(runs)
    over = f"{seeds} seeds" if seeds > 1 else "the posterior samples of one seed"
    of_configurations(figure, look, f"mean ± standard error over {over}")
