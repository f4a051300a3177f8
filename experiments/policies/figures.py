"""Figures of a study, from its collected results."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle
from scipy.spatial import ConvexHull

from experiments.policies.barycentres import barycentre
from experiments.policies.results import Results, label
from experiments.policies.study import FEM, NOMINAL, STILLS
from experiments.policies.tables import SETS
from jaxlfi.envs.whip.parameters import MEDIAN
from jaxlfi.envs.whip.render import PALETTE, lines
from jaxlfi.envs.whip.rig import CONTROL_INTERVAL, HAND, RGBA
from jaxlfi.envs.whip.vision.camera import side_camera
from jaxlfi.figures import discrepancy, learning, legends, style

ROWS = (*FEM, "median")
MOMENTS = (0, 3, 5, 7, 16)
"""Control steps of the stills that are shown."""
VIEW = ((0.28, 1.0), (0.97, 0.12))
"""Visible part of the image: from left to right, and from bottom to top, in normalised pixels."""
BAND = 0.7
"""Paleness of bands, from 0 to 1."""
EVERY = 3
"""Number of control steps between the marks on a trajectory, as in the paper."""


def agents(how: str) -> list[str]:
    """The six policies of a set, in the paper's order."""
    return [*(f"{dlo}-{how}" for dlo in FEM), "uniform", "median"]


def draw_curves(figure: Figure, results: Results) -> None:
    """Counterpart of the paper's `fig:learning-curves`: medians and quartiles over seeds, one panel per set."""
    panels = figure.subplots(1, len(SETS), sharey=True)
    for axes, (title, how) in zip(panels, SETS.items(), strict=True):
        if known := [name for name in agents(how) if name in results.trainings]:
            looks = zip(known, style.looks(known).values(), strict=True)
            curves = {label(name): (look, results.trainings[name]["curve"]) for name, look in looks}
            learning.draw_curves(axes, curves, int(results.trainings[known[0]]["steps_per_update"]))
        axes.set_title(title)
        axes.label_outer()


def draw_trajectories(figure: Figure, results: Results, title: str) -> None:
    """Counterpart of the paper's `fig:def-adapt-supp-eef-trajs-plots`, for one set of six policies.

    There is one row per DLO and one column per policy. A cell shows the paths of the gripper's set-point at the nominal
    place, as a band that holds all episodes of all seeds, with their soft-DTW barycentre, marked every three steps. The
    last column shows the mean return of each seed at displaced places.
    """
    names = agents(SETS[title])
    grid = figure.subplots(len(ROWS), len(names) + 1, squeeze=False, width_ratios=[1] * len(names) + [1.6])
    look = dict(zip(names, style.looks(names).values(), strict=True))
    for row, dlo in zip(grid, ROWS, strict=True):
        for axes, name in zip(row, names, strict=False):
            if (found := _episodes(results, name, dlo)) is not None:
                _draw_paths(axes, found["actions"][:, :NOMINAL], look[name].colour)
            axes.set(xlim=(-0.1, 0.25), ylim=(-0.2, 0.15), xticks=(0, 0.2), yticks=(-0.1, 0, 0.1), aspect="equal")
            axes.grid(True)
            axes.label_outer()
        there = {name: found for name in names if (found := _episodes(results, name, dlo)) is not None}
        of_seeds = {name: found["value"][:, NOMINAL:].mean(axis=1) for name, found in there.items()}
        discrepancy.draw_dots(row[-1], of_seeds, {name: dataclasses.replace(look[name], marker="o") for name in there})
        row[-1].set(ylim=(-0.1, 2.1), yticks=(0, 1, 2))
        row[0].set_ylabel(f"{'μ, simulated' if dlo == 'median' else dlo}\nΔz [m]")
    for axes, name in zip(grid[0], names, strict=False):
        axes.set_title(label(name), color=look[name].colour, fontweight="bold")
    grid[0, -1].set_title("mean return of a seed\nat displaced places")
    for axes in grid[-1, :-1]:
        axes.set_xlabel("Δx [m]")
    handles = [
        Patch(facecolor=style.shade(style.GREY, BAND), label=f"all episodes of all seeds ({NOMINAL} a seed)"),
        Line2D([], [], color=style.GREY, marker=".", label=f"their barycentre, every {EVERY} steps marked"),
        Line2D([], [], color=style.GREY, marker="o", linestyle="none", label="a seed"),
        Line2D([], [], color=style.GREY, linewidth=1.6, label="median of seeds"),
    ]
    legends.below(figure, handles, at_most=4)


def _episodes(results: Results, name: str, dlo: str) -> Mapping[str, np.ndarray] | None:
    return (results.simulation if dlo == "median" else results.objects).get((name, dlo))


def _draw_paths(axes: Axes, actions: np.ndarray, colour: str) -> None:
    """Draw the paths of all episodes [seeds, episodes, T, 2] as a band, with their barycentre."""
    paths = [accumulated(one) for own in actions for one in own]
    for t in range(max(map(len, paths)) - 1):
        points = np.unique(np.concatenate([path[t : t + 2] for path in paths if len(path) > t + 1]), axis=0)
        if len(points) > 2:
            points = points[ConvexHull(points, qhull_options="QJ").vertices]
        pale = style.shade(colour, BAND)
        axes.add_patch(Polygon(points, facecolor=pale, edgecolor=pale, linewidth=0.8, joinstyle="round", gid="band"))
    middle = barycentre(paths)
    axes.plot(*middle.T, color=colour, linewidth=1.1, zorder=3, gid="barycentre")
    axes.plot(*middle[::EVERY].T, ".", color=colour, markersize=4, zorder=3)


def accumulated(actions: np.ndarray) -> np.ndarray:
    """Cumulative sums of an episode's actions, in m, shape [T + 1, 2]; actions after its end are NaN."""
    done = actions[np.isfinite(actions).all(axis=-1)]
    return np.concatenate([np.zeros((1, 2)), np.cumsum(done, axis=0)])


def draw_stills(figure: Figure, strips: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Counterpart of the paper's timelapses: one row per policy and object, one column per moment.

    Args:
        figure: an empty figure.
        strips: labels [8, size, size] at the control steps `STILLS`, steps and return by "POLICY@OBJECT".
    """
    columns = [STILLS.index(step) for step in MOMENTS]
    grid = figure.subplots(len(strips), len(columns), squeeze=False)
    camera = side_camera(MEDIAN)
    still = lines(camera)
    width, height = (
        float(camera.focal_length) * 2 * half / (-camera.position[1] - HAND[1]) for half in (HAND[0], HAND[2])
    )
    for row, (name, strip) in zip(grid, strips.items(), strict=True):
        policy, dlo = name.split("@")
        for axes, place in zip(row, columns, strict=True):
            labels = strip["labels"][place]
            u, v = grip(labels)
            axes.plot(*still["table"].T, color=RGBA["table"], linewidth=3, zorder=1)
            hand = {"facecolor": RGBA["gripper"], "edgecolor": "none", "zorder": 2}
            axes.add_patch(Rectangle((u - width / 2, v - height), width, height, **hand, gid="gripper"))
            image = np.concatenate([PALETTE[labels], (labels > 0)[..., None]], axis=-1)
            axes.imshow(image, extent=(0, 1, 1, 0), interpolation="antialiased", zorder=3)
            if place == columns[-1]:
                before = (strip["labels"][0] > 0) & (strip["labels"][0] < len(PALETTE) - 1)
                around = {"colors": "black", "linewidths": 0.7, "linestyles": ":"}
                axes.contour(before, levels=[0.5], extent=(0, 1, 0, 1), **around, zorder=4)
            axes.set(xlim=VIEW[0], ylim=VIEW[1], xticks=[], yticks=[], aspect="equal")
        row[0].set_ylabel(f"{label(policy)} on {dlo}\nreturn {float(strip['value']):.2f}")
    words = {columns[0]: "start, ", columns[-1]: "settled, "}
    for axes, place in zip(grid[0], columns, strict=True):
        axes.set_title(f"{words.get(place, '')}{CONTROL_INTERVAL * STILLS[place]:.2f} s")
    handles = [
        Patch(color=RGBA["gripper"], label="gripper"),
        Patch(color=RGBA["dlo"], label="DLO"),
        Line2D([], [], color=RGBA["table"], linewidth=3, label="table"),
        Line2D([], [], color="black", linewidth=0.7, linestyle=":", label="stack at the start"),
    ]
    legends.below(figure, handles)


def grip(labels: np.ndarray) -> np.ndarray:
    """Where the gripper holds the DLO: the middle of its uppermost pixels, in normalised pixels, shape [2]."""
    rows, across = np.nonzero(labels == len(PALETTE) - 1)
    size = labels.shape[0]
    return np.array([across[rows == rows.min()].mean() + 0.5, rows.min()]) / size


def save(out: Path, results: Results, strips: Mapping[str, Mapping[str, np.ndarray]]) -> list[Path]:
    """Draw all figures."""
    width = style.TEXT_WIDTH
    paints = [("curves", (width, 2.9), lambda figure: draw_curves(figure, results))]
    for title, how in SETS.items():
        paint = lambda figure, title=title: draw_trajectories(figure, results, title)
        paints.append((f"trajectories-{how}", (1.15 * width, 6.4), paint))
    if strips:
        paints.append(("stills", (width, 1.5 * len(strips) + 0.3), lambda figure: draw_stills(figure, strips)))
    return [_save(out / f"{name}.png", size, paint) for name, size, paint in paints]


def _save(path: Path, size: Sequence[float], paint) -> Path:
    with style.context():
        figure = style.new_figure(*size)
        paint(figure)
        return style.save(figure, path, 150)
