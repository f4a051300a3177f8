"""Figures of a study, from what is kept of it."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from experiments.policies.barycentres import barycentre
from experiments.policies.results import Results, label
from experiments.policies.study import FEM, NOMINAL, STILLS
from experiments.policies.tables import SETS, difficulty
from jaxlfi.envs.whip.render import PALETTE
from jaxlfi.figures import style
from jaxlfi.figures.learning import WINDOW, running_mean

ROWS = (*FEM, "median")
BINS = np.linspace(-2.0, 2.0, 17)
"""Of returns; what is below is counted in the first."""
EVERY = 3
"""Control steps between the marks on a trajectory, as in the paper."""


def agents(how: str) -> list[str]:
    """The six policies of a set, in the paper's order."""
    return [*(f"{dlo}-{how}" for dlo in FEM), "uniform", "median"]


def draw_curves(figure: Figure, results: Results) -> None:
    """Counterpart of the paper's `fig:learning-curves`: a panel a set; a thin line a seed, a thick one their mean."""
    panels = figure.subplots(len(SETS), 1, sharex=True, sharey=True)
    for axes, (title, how) in zip(panels, SETS.items(), strict=True):
        known = [name for name in agents(how) if name in results.trainings]
        for look, name in zip(style.looks(known).values(), known, strict=True):
            own = results.trainings[name]
            returns = running_mean(own["curve"], min(WINDOW, len(own["curve"])))
            steps = int(own["steps_per_update"]) * (1 + np.arange(len(returns)))
            axes.plot(steps, returns, color=look.colour, alpha=0.3, linewidth=0.5)
            axes.plot(steps, returns.mean(axis=1), color=look.colour, linewidth=1.2, label=label(name))
        axes.set(title=title, ylabel="return")
        if known:
            axes.legend(frameon=False, ncols=2, fontsize=6)
    panels[-1].set_xlabel("environment steps")


def draw_trajectories(figure: Figure, results: Results, title: str) -> None:
    """Counterpart of the paper's `fig:def-adapt-supp-eef-trajs-plots`, for one set of six policies.

    A row a DLO, one column per policy: accumulated (dx, dz) of the repetitions at the nominal place, and a soft-DTW
    barycentre for each training seed, marked every three steps. Then the returns at displaced places, and measures.
    """
    names = agents(SETS[title])
    grid = figure.subplots(len(ROWS), len(names) + 2, squeeze=False)
    look = dict(zip(names, style.looks(names).values(), strict=True))
    measures = {row["DLO"]: row for row in difficulty(results) if row["policies"] == title}
    for row, dlo in zip(grid, ROWS, strict=True):
        for axes, name in zip(row, names, strict=False):
            if (found := _episodes(results, name, dlo)) is not None:
                _draw_paths(axes, found["actions"][:, :NOMINAL], look[name].colour)
                axes.set_title(f"{np.mean(found['value']):.2f}", fontsize=6)
            axes.set(xlim=(-0.15, 0.25), ylim=(-0.3, 0.2))
            axes.tick_params(labelsize=5)
            axes.label_outer()
        _draw_histogram(row[-2], {name: _episodes(results, name, dlo) for name in names}, look)
        row[-1].axis("off")
        own = measures.get("μ, simulated" if dlo == "median" else dlo, {})
        lines = [f"{name} {own[f'{name}, displaced']}" for name in ("average", "consistency", "difficulty") if own]
        row[-1].text(0.0, 0.5, "\n".join(lines), fontsize=6, va="center")
        row[0].set_ylabel("μ, simulated" if dlo == "median" else dlo, fontsize=7)
    for axes, name in zip(grid[-1], names, strict=False):
        axes.set_xlabel(label(name), fontsize=7)
    grid[-1, -2].set_xlabel("return", fontsize=7)
    figure.supxlabel("accumulated dx [m]", fontsize=7)
    figure.supylabel("accumulated dz [m]", fontsize=7)


def _episodes(results: Results, name: str, dlo: str) -> Mapping[str, np.ndarray] | None:
    return (results.simulation if dlo == "median" else results.objects).get((name, dlo))


def _draw_paths(axes, actions: np.ndarray, colour: str) -> None:
    for own in actions:
        paths = [accumulated(one) for one in own]
        for path in paths:
            axes.plot(*path.T, color=colour, alpha=0.3, linewidth=0.4)
        middle = barycentre(paths)
        axes.plot(*middle.T, color=colour, linewidth=1.0)
        axes.plot(*middle[::EVERY].T, ".", color=colour, markersize=2)


def accumulated(actions: np.ndarray) -> np.ndarray:
    """Sums of an episode's actions from its beginning, in m, shape [T + 1, 2]; NaN is what comes after its end."""
    done = actions[np.isfinite(actions).all(axis=-1)]
    return np.concatenate([np.zeros((1, 2)), np.cumsum(done, axis=0)])


def _draw_histogram(axes, found: Mapping[str, Mapping[str, np.ndarray] | None], look: Mapping) -> None:
    known = {name: own for name, own in found.items() if own is not None}
    if known:
        values = [np.clip(np.ravel(own["value"]), BINS[0], BINS[-1]) for own in known.values()]
        axes.hist(values, BINS, stacked=True, color=[look[name].colour for name in known])
    axes.tick_params(labelsize=5)


def draw_stills(figure: Figure, strips: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Counterpart of the paper's timelapses: one row per policy and object, a column a control step."""
    grid = figure.subplots(len(strips), len(STILLS), squeeze=False)
    for row, (name, strip) in zip(grid, strips.items(), strict=True):
        policy, dlo = name.split("@")
        for axes, labels, step in zip(row, strip["labels"], STILLS, strict=True):
            axes.imshow(labels, cmap=ListedColormap(PALETTE), vmin=-0.5, vmax=len(PALETTE) - 0.5, interpolation="none")
            axes.set(xticks=[], yticks=[])
            if step > strip["steps"]:
                axes.images[0].set_alpha(0.35)
        row[0].set_ylabel(f"{label(policy)} on {dlo}\n{float(strip['value']):.2f}", fontsize=6)
    for axes, step in zip(grid[0], STILLS, strict=True):
        axes.set_title(f"step {step}", fontsize=6)


def save(out: Path, results: Results, strips: Mapping[str, Mapping[str, np.ndarray]]) -> list[Path]:
    """Draw all figures."""
    width = style.TEXT_WIDTH
    paints = [("curves", (width / 2, 4.2), lambda figure: draw_curves(figure, results))]
    for title, how in SETS.items():
        paint = lambda figure, title=title: draw_trajectories(figure, results, title)
        paints.append((f"trajectories-{how}", (1.25 * width, 6.5), paint))
    if strips:
        paints.append(("stills", (width, 0.95 * len(strips) + 0.2), lambda figure: draw_stills(figure, strips)))
    return [_save(out / f"{name}.png", size, paint) for name, size, paint in paints]


def _save(path: Path, size: Sequence[float], paint) -> Path:
    with style.context():
        figure = style.new_figure(*size)
        paint(figure)
        return style.save(figure, path, 150)
