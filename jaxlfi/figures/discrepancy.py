"""Distance of the last posterior from the true parameters, and of its trajectories from the observed one."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxlfi.figures.collection import Runs, first_of, seed_count
from jaxlfi.figures.curves import drawable
from jaxlfi.figures.legends import above, balanced
from jaxlfi.figures.natural import logarithmic
from jaxlfi.figures.style import Look, grid_shape, is_log, looks, parameter_name, unit_label

__all__ = ["Panel", "draw", "draw_dots", "drawable", "final_errors", "panels"]


def final_errors(runs: Runs, configuration: str) -> tuple[np.ndarray, np.ndarray]:
    """The last round's errors of each seed, averaged over its samples.

    Returns:
        Errors of the parameters, shape [seeds, D], and of the trajectories without failed ones, shape [seeds]. NaN
        means not measured.
    """
    histories = runs[configuration]
    unknown = np.full(histories[0].dim, np.nan)
    theta = [unknown if h.theta_error is None else h.theta_error[-1].mean(0) for h in histories]
    return np.stack(theta), np.array([h.final_trajectory_error for h in histories])


def draw_dots(axes: Axes, errors: dict[str, np.ndarray], look: dict[str, Look]) -> None:
    """Draw a dot for each seed of each configuration, and a line at their median; NaN is left out."""
    for place, (name, own) in enumerate(look.items()):
        values = errors[name][np.isfinite(errors[name])]
        if not values.size:
            axes.text(place, 0, " none", rotation=90, ha="center", va="bottom", color=own.colour)
            continue
        across = place + (0.6 * ((np.arange(values.size) * 0.6180339887) % 1.0 - 0.5) if values.size > 1 else 0.0)
        axes.plot([place - 0.4, place + 0.4], [np.median(values)] * 2, color=own.colour, linewidth=1.6, gid="median")
        dots = {"marker": own.marker, "linestyle": "none", "markersize": 3.6, "markeredgewidth": 0.3}
        axes.plot(across, values, color=own.colour, markeredgecolor="white", label=own.label, zorder=3, **dots)
    centre, half = (len(look) - 1) / 2, max(len(look) / 2, 2.0) + 0.2
    axes.set_xlim(centre - half, centre + half)
    axes.set_xticks([])
    axes.set_ylim(0, 1.05 * axes.get_ylim()[1])
    axes.grid(True, axis="y")


class Panel(NamedTuple):
    """The content of one panel."""

    title: str  # a parameter, or "trajectory"
    unit: str  # unit of the errors, in brackets
    errors: dict[str, np.ndarray]  # errors by configuration, each [seeds]
    log: bool = False  # whether they are errors of a logarithm


def panels(runs: Runs) -> list[Panel]:
    """One panel per parameter, if the truth is known, and one for the trajectory."""
    first = first_of(runs)
    errors = {name: final_errors(runs, name) for name in runs}
    known, simulated = (any(np.isfinite(error[i]).any() for error in errors.values()) for i in (0, 1))
    logs = [is_log(name) for name in first.names]
    units = ["(factor)" if log else unit_label(first.units, d) for d, log in enumerate(logs)]
    width = 20 if len(set(units)) == 1 else 15  # panels with different units have their own scales
    result = []
    for d, unit in enumerate(units if known else ()):
        own = {name: theta[:, d] for name, (theta, _) in errors.items()}
        result.append(Panel(parameter_name(first.names, d, width), unit, own, logs[d]))
    trajectories = {name: trajectory for name, (_, trajectory) in errors.items()}
    return result + ([Panel("trajectory", "[observed sd]", trajectories)] if simulated else [])


def draw(figure: Figure, runs: Runs) -> None:
    """Draw a panel for each parameter (on one scale if they share a unit) and one for the trajectory."""
    look = looks(list(runs))
    shown = panels(runs)
    parameters = [place for place, panel in enumerate(shown) if panel.title != "trajectory"]
    rows, columns = grid_shape(len(shown), 5)
    every = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, panel in zip(every, shown, strict=False):
        draw_dots(axes, panel.errors, look)
        axes.set_title(panel.title)
    for axes in every[len(shown) :]:
        axes.remove()
    one_unit = len({panel.unit for panel in shown[: len(parameters)]}) == 1
    if one_unit:
        top = max(axes.get_ylim()[1] for axes in every[: len(parameters)])
        for axes in every[: len(parameters)]:
            axes.set_ylim(0, top)
        for place in range(len(parameters)):
            every[place].tick_params(labelleft=place % columns == 0)
    for place, (axes, panel) in enumerate(zip(every, shown, strict=False)):
        if place % columns == 0 or panel.title == "trajectory" or not one_unit:
            axes.set_ylabel(f"discrepancy {panel.unit}".strip())
        if panel.log:
            logarithmic(axes.yaxis, 5, before="×")
    seeds = seed_count(runs)
    dots = {"linestyle": "none", "markersize": 3.6, "markeredgewidth": 0}
    handles = [Line2D([], [], color=own.colour, marker=own.marker, label=own.label, **dots) for own in look.values()]
    title = f"one dot for each of {seeds} seeds, line: median" if seeds > 1 else "one seed"
    above(figure, handles, title, balanced(list(look.values()), figure))
