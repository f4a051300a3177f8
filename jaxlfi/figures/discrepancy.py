"""Distance of the last posterior from the true parameters, and of its trajectories from the observed one."""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from jaxlfi.figures import statistics
from jaxlfi.figures.collection import Runs, seed_count
from jaxlfi.figures.curves import drawable
from jaxlfi.figures.legends import above, balanced
from jaxlfi.figures.style import Look, grid_shape, looks, parameter_name, unit_label

__all__ = ["Panel", "draw", "draw_bars", "drawable", "final_errors", "panels"]


def final_errors(runs: Runs, configuration: str) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Last round's errors: of parameters [seeds * N, D], of trajectories [seeds * N] (NaN: failed)."""
    theta = [h.theta_error[-1] for h in runs[configuration] if h.theta_error is not None]
    trajectory = [h.trajectory_error[-1] for h in runs[configuration] if h.trajectory_error is not None]
    return np.concatenate(theta) if theta else None, np.concatenate(trajectory) if trajectory else None


def draw_bars(axes: Axes, errors: dict[str, np.ndarray], look: dict[str, Look]) -> None:
    """A bar for each configuration: mean of its errors, and their standard deviation.

    Args:
        axes: to draw on.
        errors: by configuration, each [n]; NaN is left out.
        look: of the configurations.
    """
    for place, (name, own) in enumerate(look.items()):
        values = errors.get(name, np.array([np.nan]))
        height = float(statistics.mean(values))
        if np.isnan(height):
            axes.text(place, 0, " none", rotation=90, ha="center", va="bottom", color=own.colour)
            continue
        axes.bar(
            place,
            height,
            width=0.82,
            color=own.colour,
            yerr=float(statistics.sd(values)),
            error_kw={"elinewidth": 0.8, "capsize": 1.6, "capthick": 0.8, "ecolor": "#222222"},
            label=own.label,
        )
    centre, half = (len(look) - 1) / 2, max(len(look) / 2, 2.0) + 0.2
    axes.set_xlim(centre - half, centre + half)
    axes.set_xticks([])
    axes.set_ylim(bottom=0)
    axes.grid(True, axis="y")


class Panel(NamedTuple):
    """The content of one panel.

    Attributes:
        title: a parameter, or "trajectory".
        unit: of the errors, in brackets.
        errors: by configuration, each [n].
    """

    title: str
    unit: str
    errors: dict[str, np.ndarray]


def panels(runs: Runs) -> list[Panel]:
    """One panel per parameter, if the truth is known, and one for the trajectory."""
    first = next(iter(runs.values()))[0]
    thetas: dict[str, Any] = {}
    trajectories: dict[str, Any] = {}
    for name in runs:
        theta, trajectory = final_errors(runs, name)
        thetas |= {} if theta is None else {name: theta}
        trajectories |= {} if trajectory is None else {name: trajectory}
    result = []
    units = [unit_label(first.units, d) for d in range(first.dim)]
    width = 20 if len(set(units)) == 1 else 15  # panels of several units have a scale each
    for d, unit in enumerate(units if thetas else ()):
        title = parameter_name(first.names, d, width)
        result.append(Panel(title, unit, {name: theta[:, d] for name, theta in thetas.items()}))
    return result + ([Panel("trajectory", "[observed sd]", trajectories)] if trajectories else [])


def draw(figure: Figure, runs: Runs) -> None:
    """A panel for each parameter (on one scale where they have one unit) and one for the trajectory.

    Args:
        figure: empty.
        runs: configurations with their seeds.
    """
    look = looks(list(runs))
    shown = panels(runs)
    parameters = [place for place, panel in enumerate(shown) if panel.title != "trajectory"]
    rows, columns = grid_shape(len(shown), 5)
    every = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, (title, _, values) in zip(every, shown, strict=False):
        draw_bars(axes, values, look)
        axes.set_title(title)
    for axes in every[len(shown) :]:
        axes.remove()
    one_unit = len({unit for _, unit, _ in shown[: len(parameters)]}) == 1
    if one_unit:
        top = max(axes.get_ylim()[1] for axes in every[: len(parameters)])
        for axes in every[: len(parameters)]:
            axes.set_ylim(0, top)
        for place in range(len(parameters)):
            every[place].tick_params(labelleft=place % columns == 0)
    for place, (axes, (title, unit, _)) in enumerate(zip(every, shown, strict=False)):
        if place % columns == 0 or title == "trajectory" or not one_unit:
            axes.set_ylabel(" ".join(["discrepancy", unit]).strip())
    seeds = seed_count(runs)
    handles = [Patch(color=own.colour, label=own.label) for own in look.values()]
    over = f"posterior samples of {seeds} seeds" if seeds > 1 else "posterior samples of one seed"
    above(figure, handles, f"mean ± standard deviation over the {over}", balanced(list(look.values()), figure))
