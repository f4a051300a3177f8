"""Rollouts of the whipping task: a sheet of instants and an animation, from segmentation labels and keypoints."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from jaxlfi.figures import style

COLUMNS = 6
"""Of the sheet."""
OVER = 0.35
"""Opacity of what happens after the end of the episode."""
FOUND, REMEMBERED = "#FFFFFF", "#FF9C9C"
"""Colours of keypoints on the DLO."""
LINES = {
    "table": {"color": "#B5A48C", "linewidth": 1.0},
    "workspace of the gripper": {"color": "#999999", "linewidth": 0.6, "linestyle": (0, (3, 2))},
}
"""How lines are drawn, by name."""


@dataclasses.dataclass(frozen=True)
class Instants:
    """What is seen at T instants, all places in normalised pixels.

    Attributes:
        labels: segmentation images, indices into `palette`, 0 the background, shape [T, size, size].
        dlo: keypoints of the DLO, in the detector's order, shape [T, 4, 2].
        cubes: keypoints of the cubes, shape [T, 6, 2].
        seen: keypoints of the DLO that are found rather than remembered, shape [T, 4].
        gripper: where it is, shape [T, 2].
        captions: a line for each instant, shape [T].
        over: whether the episode is over by then, shape [T].
        palette: colours of the labels, RGB from 0 to 1, shape [L, 3].
        lines: polylines that are the same at all instants, by a name in `LINES`, shape [N, 2] each.
    """

    labels: np.ndarray
    dlo: np.ndarray
    cubes: np.ndarray
    seen: np.ndarray
    gripper: np.ndarray
    captions: Sequence[str]
    over: np.ndarray
    palette: np.ndarray
    lines: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)

    def every(self, n: int) -> "Instants":
        """Every n-th instant, beginning with the first."""
        own = ("labels", "dlo", "cubes", "seen", "gripper", "captions", "over")
        return dataclasses.replace(self, **{name: getattr(self, name)[::n] for name in own})


def draw_sheet(figure: Figure, instants: Instants, title: str) -> None:
    """All instants in rows, and what the markers are.

    Args:
        figure: empty, of a page's width and the height that `sheet_height` tells.
        instants: what is seen.
        title: above all.
    """
    panels = figure.subplots(_rows(len(instants.labels)), COLUMNS).ravel()
    for t, axes in enumerate(panels):
        if t < len(instants.labels):
            _Picture(axes, instants).show(t)
        else:
            axes.axis("off")
    legend = panels[-1].legend(handles=_legend(instants), loc="center", fontsize=5.5, handlelength=1.2)
    legend.set_in_layout(False)  # it may be a little wider than its panel
    figure.suptitle(title, fontsize=7.5)


def sheet_height(count: int) -> float:
    """The height of a sheet of so many instants as wide as a page, in inches."""
    return 0.3 + _rows(count) * (style.TEXT_WIDTH / COLUMNS + 0.13)


def _rows(count: int) -> int:
    return -(-(count + 1) // COLUMNS)


def save_sheet(path: Path, instants: Instants, title: str) -> Path:
    """Write a sheet of all instants as png; see `draw_sheet`."""
    with style.context():
        figure = style.new_figure(style.TEXT_WIDTH, sheet_height(len(instants.labels)))
        draw_sheet(figure, instants, title)
        return style.save(figure, path, 200)


def save_animation(path: Path, instants: Instants, title: str, interval: float, freshness: np.ndarray) -> Path:
    """Write an animated gif, in which a pixel of the labels is a pixel.

    Args:
        path: where to, .gif.
        instants: its frames.
        title: above all; two lines fit.
        interval: between frames, in s; the format knows hundredths.
        freshness: opacity of the keypoints in each frame, shape [T]: 1 for those of that instant, less for older ones.
    """
    size, margin, head = instants.labels.shape[-1], 6, 52
    width, height = size + 2 * margin, size + margin + head
    frames = []
    with style.context():
        figure = style.new_figure(width / 100, height / 100)
        figure.set_layout_engine("none")
        axes = figure.add_axes((margin / width, margin / height, size / width, size / height))
        figure.suptitle(title, fontsize=7.5, y=1 - 3 / height, va="top")
        picture = _Picture(axes, instants, scale=2.5)
        for t, fresh in enumerate(freshness):
            picture.show(t, fresh)
            figure.canvas.draw()
            # Frames have few colours, and dithering would flicker.
            frame = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
            frames.append(frame.quantize(64, dither=Image.Dither.NONE))
    path.parent.mkdir(parents=True, exist_ok=True)
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=round(1000 * interval), loop=0)
    return path


class _Picture:
    """One instant on axes, which can be changed to another."""

    def __init__(self, axes: Axes, instants: Instants, scale: float = 1.0):
        self._instants = instants
        for name, line in instants.lines.items():
            axes.plot(*line.T, **LINES[name], zorder=1)
        size = instants.labels.shape[-1]
        self._image = axes.imshow(np.ones((size, size, 4)), extent=(0, 1, 1, 0), zorder=2)
        axes.set(xlim=(0, 1), ylim=(1, 0), xticks=[], yticks=[], aspect="equal")
        (self._gripper,) = axes.plot([], [], **_gripper(scale), zorder=3)
        (self._cubes,) = axes.plot([], [], **_on_cubes(scale), zorder=4)
        self._dlo = axes.scatter([], [], s=13 * scale**2, linewidths=0.4 * scale, edgecolors="black", zorder=5)
        self._numbers = [
            axes.text(0, 0, i + 1, fontsize=3.5 * scale, ha="center", va="center_baseline", zorder=6)
            for i in range(instants.dlo.shape[1])
        ]
        self._caption = axes.set_title("", fontsize=5.5 + scale**0.5)

    def show(self, t: int, fresh: float = 1.0) -> None:
        """Show the instant t, with keypoints of some opacity."""
        instants, strength = self._instants, OVER if self._instants.over[t] else 1.0
        labels = instants.labels[t]
        self._image.set_data(np.concatenate([instants.palette[labels], strength * (labels > 0)[..., None]], axis=-1))
        self._gripper.set_data(*instants.gripper[t][:, None])
        self._cubes.set_data(*instants.cubes[t].T)
        self._dlo.set_offsets(instants.dlo[t])
        self._dlo.set_facecolor([FOUND if seen else REMEMBERED for seen in instants.seen[t]])
        for number, place in zip(self._numbers, instants.dlo[t], strict=True):
            number.set_position(place)
        self._caption.set_text(instants.captions[t])
        for artist in (self._gripper, self._caption):
            artist.set_alpha(strength)
        for artist in (self._cubes, self._dlo, *self._numbers):
            artist.set_alpha(strength * fresh)


def _gripper(scale: float) -> dict:
    return {"marker": "s", "color": "#555555", "markersize": 4.5 * scale, "markeredgewidth": 0, "linestyle": "none"}


def _on_cubes(scale: float) -> dict:
    cross = {"marker": "+", "color": "black", "linestyle": "none"}
    return {**cross, "markersize": 2.5 * scale, "markeredgewidth": 0.4 * scale}


def _legend(instants: Instants) -> list[Line2D]:
    dot = {"marker": "o", "markersize": 4, "markeredgecolor": "black", "markeredgewidth": 0.4, "linestyle": "none"}
    handles = [
        Line2D([], [], color=FOUND, label="keypoint on the DLO", **dot),
        Line2D([], [], label="keypoint of a cube", **_on_cubes(1.5)),
        Line2D([], [], label="gripper", **_gripper(1.0)),
        *(Line2D([], [], label=name, **LINES[name]) for name in instants.lines),
    ]
    if not instants.seen.all():
        handles.insert(1, Line2D([], [], color=REMEMBERED, label="not found: the last", **dot))
    return handles
