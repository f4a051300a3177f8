"""The bounds of each parameter over iterations."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxlfi.figures import statistics
from jaxlfi.figures.collection import Runs, first_of, seed_count
from jaxlfi.figures.history import History
from jaxlfi.figures.legends import above, balanced
from jaxlfi.figures.natural import scales
from jaxlfi.figures.style import TRUTH_LINE, Look, grid_shape, iterations_axis, looks, parameter_name

_LIMIT = {"color": "#777777", "linestyle": (0, (1, 1.5)), "linewidth": 0.9}


def adapting(runs: Runs) -> dict[str, Sequence[History]]:
    """The configurations whose bounds move; all of them if none do."""
    moving = {name: histories for name, histories in runs.items() if any(h.adapts for h in histories)}
    return moving or dict(runs)


def draw_bounds(axes: Axes, histories: Sequence[History], d: int, look: Look) -> None:
    """Draw mean bounds of a parameter over seeds from Theta_0 (iteration 0) on, and each seed's as thin lines."""
    bounds = np.stack([np.stack(h.supports)[..., d] for h in histories])
    low, high = statistics.mean(bounds, 0)
    iteration = np.arange(bounds.shape[-1])
    axes.fill_between(iteration, low, high, color=look.colour, alpha=0.07, linewidth=0)
    if len(histories) > 1:
        axes.plot(iteration, bounds.reshape(-1, bounds.shape[-1]).T, color=look.colour, linewidth=0.35, alpha=0.5)
    for bound in (low, high):
        axes.plot(iteration, bound, **look.line)


def draw(figure: Figure, runs: Runs) -> None:
    """Draw one panel per parameter, with the configurations that adapt, the truth and the feasible limits Phi."""
    shown = adapting(runs)
    look = {name: own for name, own in looks(list(runs)).items() if name in shown}
    first = first_of(shown)
    rows, columns = grid_shape(first.dim, 4)
    scale = scales(first.names, first.units)
    every = figure.subplots(rows, columns, squeeze=False).ravel()
    for d, axes in enumerate(every):
        if d >= first.dim:
            axes.remove()
            continue
        for name, histories in shown.items():
            draw_bounds(axes, histories, d, look[name])
        if np.isfinite(first.truth[d]):
            axes.axhline(first.truth[d], **TRUTH_LINE, gid="truth")
        for limit in (first.feasible_low, first.feasible_high):
            if limit is not None:
                axes.axhline(limit[d], **_LIMIT, gid="limit")
        axes.set_title(parameter_name(first.names, d))
        dataclasses.replace(scale[d], label="bounds").show(axes.yaxis, 5)
        axes.grid(True)
        iterations_axis(axes, first.rounds, first=0, label=d + columns >= first.dim)
    handles = [Line2D([], [], **own.line) for own in look.values()]
    if np.isfinite(first.truth).any():
        handles.append(Line2D([], [], label="truth", **TRUTH_LINE))
    if first.feasible_low is not None or first.feasible_high is not None:
        handles.append(Line2D([], [], label=r"feasible limits $\Phi$", **_LIMIT))
    seeds = seed_count(shown)
    title = f"mean bounds over {seeds} seeds, thin: each seed" if seeds > 1 else "bounds of one seed"
    above(figure, handles, title, balanced(list(look.values()), figure) if len(handles) > 5 else None)
