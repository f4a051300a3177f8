"""Pictures of the keypoints that are found in masks of rollouts, from the arrays of `following`."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxlfi.envs.whip.figures import save_gif
from jaxlfi.envs.whip.render import SLOWNESS
from jaxlfi.envs.whip.rig import CONTROL_INTERVAL
from jaxlfi.figures import style

EVERY = 2
"""Number of control steps between the frames of the sheet."""
BLACK = 2 * 255
"""Value shown as black, twice the largest of a mask, so that the DLO is grey and its keypoints stand out."""
MARGIN = 0.03
"""Margin around the keypoints, in image widths."""
MARKS: Mapping[str, Mapping] = {
    "transporter": {"marker": "o", "markersize": 4.5, "markeredgecolor": "white", "markeredgewidth": 0.5},
    "centreline": {"marker": "x", "markersize": 3.5, "markeredgewidth": 0.8},
}
"""Markers of keypoints, by detector."""


def save(folder: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write keypoints.png, rollouts as rows of frames, and keypoints.gif, the same rollouts animated."""
    shown = {name.removeprefix("shown/"): array for name, array in arrays.items() if name.startswith("shown/")}
    with style.context():
        style.save(_sheet(shown), folder / "keypoints.png", 150)
        _film(folder / "keypoints.gif", shown)


def _sheet(shown: Mapping[str, np.ndarray]) -> Figure:
    rollouts, steps = len(shown["masks"]), range(0, shown["masks"].shape[1], EVERY)
    side = style.TEXT_WIDTH / len(steps)
    figure = style.new_figure(style.TEXT_WIDTH, rollouts * side + 0.4)
    grid = figure.subplots(rollouts, len(steps))
    for i, row in enumerate(grid):
        for axes, step in zip(row, steps, strict=True):
            _Panel(axes, shown, i).show(step)
            if i == 0:
                axes.set_title(f"step {step}")
    marks = [Line2D([], [], linestyle="none", color=style.GREY, label=name, **mark) for name, mark in MARKS.items()]
    figure.legend(handles=marks, loc="outside lower center", ncols=len(MARKS))
    return figure


def _film(path: Path, shown: Mapping[str, np.ndarray]) -> None:
    rollouts, steps = shown["masks"].shape[:2]
    figure = style.new_figure(6.0, 4.2)
    panels = [_Panel(axes, shown, i) for i, axes in enumerate(figure.subplots(2, rollouts // 2).ravel())]

    def show(step: int) -> None:
        figure.suptitle(f"step {step}")
        for panel in panels:
            panel.show(step)

    save_gif(path, figure, steps, show, SLOWNESS * CONTROL_INTERVAL)


def _window(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The square that holds all points of a rollout, so that even a DLO a tenth of the picture's size is visible."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = max(high - low) / 2 + MARGIN
    return (low + high) / 2 - half, (low + high) / 2 + half


class _Panel:
    """A rollout on axes: the mask of the DLO, and the keypoints in it, each in its own colour."""

    def __init__(self, axes: Axes, shown: Mapping[str, np.ndarray], rollout: int):
        self._masks, self._points = shown["masks"][rollout], {name: shown[name][rollout] for name in MARKS}
        self._image = axes.imshow(self._masks[0], extent=(0, 1, 1, 0), cmap="Greys", vmin=0, vmax=BLACK)
        (left, up), (right, down) = _window(np.concatenate([points.reshape(-1, 2) for points in self._points.values()]))
        axes.set(xticks=[], yticks=[], xlim=(left, right), ylim=(down, up))
        self._lines = {
            name: [axes.plot([], [], linestyle="none", color=colour, **mark)[0] for colour in style.SET_COLOURS[:4]]
            for name, mark in MARKS.items()
        }

    def show(self, step: int) -> None:
        """Show a frame."""
        self._image.set_data(self._masks[step])
        for name, lines in self._lines.items():
            for line, place in zip(lines, self._points[name][step], strict=True):
                line.set_data(*place[:, None])
