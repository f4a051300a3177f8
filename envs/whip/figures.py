"""Pictures of rollouts: a sheet of frames and an animation, from segmentation labels and keypoints."""

import dataclasses
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from PIL import Image

from jaxlfi.figures import legends, style
from jaxlfi.io import files

COLUMNS = 6
"""Number of columns of a sheet."""
OVER = 0.35
"""Opacity of frames after the end of the episode."""
FOUND, REMEMBERED = "#FFFFFF", "#FF9C9C"
"""Colours of keypoints on the DLO: found in this frame, or kept from an earlier one."""
PICTURES = 8
"""Number of moments of a rollout at which a posterior predictive shows the camera's image."""
LEAST = 0.06
"""Minimum height of a panel of positions, in image widths, so that an object at rest appears at rest."""
FAINT = 0.4
"""Opacity of an image under keypoints."""
BANDS = {
    "tip, to the right": (3, 0),
    "tip, downwards": (3, 1),
    "top cube, to the right": (9, 0),
    "top cube, downwards": (9, 1),
}
"""Keypoint and axis of each panel of a posterior predictive over time, by title."""
SIMULATED = "#C2185B"
_DOT = {"marker": "o", "linestyle": "none"}
_SIMULATED = {**_DOT, "color": SIMULATED, "markersize": 1.8, "markeredgewidth": 0, "alpha": 0.5}
_OBSERVED = {**_DOT, "color": "black", "markersize": 4.0, "markerfacecolor": "none", "markeredgewidth": 0.7}
LINES = {
    "table": {"color": "#B5A48C", "linewidth": 1.0},
    "workspace of the gripper": {"color": "#999999", "linewidth": 0.6, "linestyle": (0, (3, 2))},
}
"""Styles of lines, by name."""


@dataclasses.dataclass(frozen=True)
class Film:
    """The contents of T frames, all positions in normalised pixels.

    Attributes:
        labels: segmentation images, indices into `palette`, 0 the background, shape [T, size, size].
        dlo: keypoints of the DLO, in the detector's order, shape [T, 4, 2].
        cubes: keypoints of the cubes, shape [T, 6, 2].
        seen: whether keypoints of the DLO are found rather than remembered, shape [T, 4].
        gripper: position of the gripper, shape [T, 2].
        captions: a line for each frame, shape [T].
        over: whether the episode is over by then, shape [T].
        palette: colours of the labels, RGB from 0 to 1, shape [L, 3].
        lines: polylines that are the same in all frames, by a name in `LINES`, shape [N, 2] each.
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

    def every(self, n: int) -> "Film":
        """Every n-th frame, beginning with the first."""
        own = ("labels", "dlo", "cubes", "seen", "gripper", "captions", "over")
        return dataclasses.replace(self, **{name: getattr(self, name)[::n] for name in own})


def draw_sheet(figure: Figure, film: Film, title: str) -> None:
    """Draw all frames in rows, with a legend of the markers.

    Args:
        figure: an empty figure of a page's width and the height `sheet_height`.
        film: the frames.
        title: title above all frames.
    """
    panels = figure.subplots(_rows(len(film.labels)), COLUMNS).ravel()
    for t, axes in enumerate(panels):
        if t < len(film.labels):
            _Picture(axes, film).show(t)
        else:
            axes.axis("off")
    legend = panels[-1].legend(handles=_legend(film), loc="center", fontsize=5.5, handlelength=1.2)
    legend.set_in_layout(False)  # it may be a little wider than its panel
    figure.suptitle(title, fontsize=7.5)


def sheet_height(count: int) -> float:
    """The height of a sheet of `count` frames that is as wide as a page, in inches."""
    return 0.3 + _rows(count) * (style.TEXT_WIDTH / COLUMNS + 0.13)


def _rows(count: int) -> int:
    return -(-(count + 1) // COLUMNS)


def save_sheet(path: Path, film: Film, title: str) -> Path:
    """Write a sheet of all frames as png; see `draw_sheet`."""
    with style.context():
        figure = style.new_figure(style.TEXT_WIDTH, sheet_height(len(film.labels)))
        draw_sheet(figure, film, title)
        return style.save(figure, path, 200)


def save_animation(path: Path, film: Film, title: str, interval: float, freshness: np.ndarray) -> Path:
    """Write an animated gif with one pixel per pixel of the labels.

    Args:
        path: the .gif file.
        film: the frames.
        title: title above the frames; two lines fit.
        interval: time between frames, in s; the format resolves hundredths.
        freshness: opacity of the keypoints in each frame, shape [T]: 1 for those detected in it, less for older ones.
    """
    size, margin, head = film.labels.shape[-1], 6, 52
    width, height = size + 2 * margin, size + margin + head
    with style.context():
        figure = style.new_figure(width / 100, height / 100)
        figure.set_layout_engine("none")
        axes = figure.add_axes((margin / width, margin / height, size / width, size / height))
        figure.suptitle(title, fontsize=7.5, y=1 - 3 / height, va="top")
        picture = _Picture(axes, film, scale=2.5)
        return save_gif(path, figure, len(film.labels), lambda t: picture.show(t, freshness[t]), interval)


def save_gif(path: Path, figure: Figure, frames: int, show: Callable[[int], None], interval: float) -> Path:
    """Write an animated gif of a figure.

    Args:
        path: the .gif file.
        figure: the figure to animate, with 100 pixels per inch.
        frames: number of frames.
        show: function that draws the frame of a given index into the figure.
        interval: time between frames, in s; the format resolves hundredths.
    """
    pictures = []
    for t in range(frames):
        show(t)
        figure.canvas.draw()
        # Frames have few colours, and dithering would flicker.
        picture = Image.fromarray(np.asarray(figure.canvas.buffer_rgba())).convert("RGB")
        pictures.append(picture.quantize(64, dither=Image.Dither.NONE))
    path.parent.mkdir(parents=True, exist_ok=True)
    content, duration = io.BytesIO(), round(1000 * interval)
    pictures[0].save(content, "GIF", save_all=True, append_images=pictures[1:], duration=duration, loop=0)
    files.write_bytes(path, content.getvalue())  # all of it, or nothing
    return path


class _Picture:
    """One frame on axes, which can be replaced by another."""

    def __init__(self, axes: Axes, film: Film, scale: float = 1.0):
        self._film = film
        for name, line in film.lines.items():
            axes.plot(*line.T, **LINES[name], zorder=1)
        size = film.labels.shape[-1]
        self._image = axes.imshow(np.ones((size, size, 4)), extent=(0, 1, 1, 0), zorder=2)
        axes.set(xlim=(0, 1), ylim=(1, 0), xticks=[], yticks=[], aspect="equal")
        (self._gripper,) = axes.plot([], [], **_gripper(scale), zorder=3)
        (self._cubes,) = axes.plot([], [], **_on_cubes(scale), zorder=4)
        self._dlo = axes.scatter([], [], s=13 * scale**2, linewidths=0.4 * scale, edgecolors="black", zorder=5)
        self._numbers = [
            axes.text(0, 0, i + 1, fontsize=3.5 * scale, ha="center", va="center_baseline", zorder=6)
            for i in range(film.dlo.shape[1])
        ]
        self._caption = axes.set_title("", fontsize=5.5 + scale**0.5)

    def show(self, t: int, fresh: float = 1.0) -> None:
        """Show frame t, its keypoints with an opacity."""
        film, strength = self._film, OVER if self._film.over[t] else 1.0
        labels = film.labels[t]
        self._image.set_data(np.concatenate([film.palette[labels], strength * (labels > 0)[..., None]], axis=-1))
        self._gripper.set_data(*film.gripper[t][:, None])
        self._cubes.set_data(*film.cubes[t].T)
        self._dlo.set_offsets(film.dlo[t])
        self._dlo.set_facecolor([FOUND if seen else REMEMBERED for seen in film.seen[t]])
        for number, place in zip(self._numbers, film.dlo[t], strict=True):
            number.set_position(place)
        self._caption.set_text(film.captions[t])
        for artist in (self._gripper, self._caption):
            artist.set_alpha(strength)
        for artist in (self._cubes, self._dlo, *self._numbers):
            artist.set_alpha(strength * fresh)


@dataclasses.dataclass(frozen=True)
class Predictive:
    """An observed rollout, and simulations of a posterior; all positions in normalised pixels.

    Attributes:
        observed: keypoints, four of the DLO and then the cubes', shape [T, 10, 2].
        simulated: those of each simulation, shape [N, T, 10, 2].
        labels: segmentation images of one simulation, indices into `palette`, shape [T, size, size].
        gripper: position of the gripper in these, shape [T, 2].
        palette: colours of the labels, RGB from 0 to 1, shape [L, 3].
        times: times of the frames, in s, shape [T].
        lines: as in a `Film`.
    """

    observed: np.ndarray
    simulated: np.ndarray
    labels: np.ndarray
    gripper: np.ndarray
    palette: np.ndarray
    times: np.ndarray
    lines: Mapping[str, np.ndarray]


def draw_predictive(figure: Figure, shown: Predictive) -> None:
    """Keypoints over the camera's image at eight moments, and the DLO's tip and the top cube as bands over time.

    Args:
        figure: an empty figure.
        shown: what to draw.
    """
    above, below = figure.subfigures(2, 1, height_ratios=(2.1, 1))
    moments = np.linspace(0, len(shown.times) - 1, PICTURES).round().astype(int)
    # All positions of the DLO, the cubes and the gripper, so that they fill the pictures.
    every = np.concatenate([shown.observed.reshape(-1, 2), shown.simulated.reshape(-1, 2), shown.gripper]).clip(0, 1)
    (left, top), (right, bottom) = every.min(0) - 0.07, every.max(0) + 0.07
    for axes, t in zip(above.subplots(2, PICTURES // 2).ravel(), moments, strict=True):
        for name, line in shown.lines.items():
            axes.plot(*line.T, **LINES[name], zorder=1)
        labels = shown.labels[t]
        image = np.concatenate([shown.palette[labels], FAINT * (labels > 0)[..., None]], axis=-1)
        axes.imshow(image, extent=(0, 1, 1, 0), zorder=2)
        axes.plot(*shown.gripper[t], **_gripper(1.3), zorder=2)
        axes.plot(*shown.simulated[:, t].reshape(-1, 2).T, **_SIMULATED, zorder=3)
        axes.plot(*shown.observed[t].T, **_OBSERVED, zorder=4)
        axes.set(xlim=(left, right), ylim=(bottom, top), xticks=[], yticks=[], aspect="equal")
        axes.set_title(f"{shown.times[t]:.2f} s")
    panels = below.subplots(1, len(BANDS))
    for axes, (title, (keypoint, axis)) in zip(panels, BANDS.items(), strict=True):
        quantiles = np.quantile(shown.simulated[:, :, keypoint, axis], (0.05, 0.25, 0.5, 0.75, 0.95), axis=0)
        for outer, opacity in ((0, 0.2), (1, 0.35)):
            axes.fill_between(
                shown.times, quantiles[outer], quantiles[4 - outer], color=SIMULATED, alpha=opacity, linewidth=0
            )
        axes.plot(shown.times, quantiles[2], color=SIMULATED, gid="median")
        axes.plot(shown.times, shown.observed[:, keypoint, axis], **_OBSERVED, gid="observed")
        axes.set(title=title, xlabel="time [s]")
        axes.grid(True)
        low, high = axes.get_ylim()
        half = max(high - low, LEAST) / 2
        axes.set_ylim(np.add((low + high) / 2, (half, -half) if axis else (-half, half)))
    panels[0].set_ylabel("place [image widths]")
    handles = [
        Line2D([], [], label="observed keypoint", **_OBSERVED),
        Line2D([], [], label="simulations of the posterior", **_SIMULATED | {"alpha": 1.0}),
        Line2D([], [], color=SIMULATED, label="their median (bands: 50 %, 90 %)"),
        Patch(facecolor=style.GREY, alpha=FAINT, label="simulation at the posterior median"),
        Line2D([], [], label="gripper", **_gripper(1.0)),
        *(Line2D([], [], label=name, **LINES[name]) for name in shown.lines),
    ]
    legends.below(figure, handles, at_most=4)


def save_predictive(path: Path, shown: Predictive) -> Path:
    """Write the posterior predictive of a rollout as png; see `draw_predictive`."""
    with style.context():
        figure = style.new_figure(style.TEXT_WIDTH, 5.6)
        draw_predictive(figure, shown)
        return style.save(figure, path, 200)


def _gripper(scale: float) -> dict:
    return {"marker": "s", "color": "#555555", "markersize": 4.5 * scale, "markeredgewidth": 0, "linestyle": "none"}


def _on_cubes(scale: float) -> dict:
    cross = {"marker": "+", "color": "black", "linestyle": "none"}
    return {**cross, "markersize": 2.5 * scale, "markeredgewidth": 0.4 * scale}


def _legend(film: Film) -> list[Line2D]:
    dot = {"marker": "o", "markersize": 4, "markeredgecolor": "black", "markeredgewidth": 0.4, "linestyle": "none"}
    handles = [
        Line2D([], [], color=FOUND, label="keypoint on the DLO", **dot),
        Line2D([], [], label="keypoint of a cube", **_on_cubes(1.5)),
        Line2D([], [], label="gripper", **_gripper(1.0)),
        *(Line2D([], [], label=name, **LINES[name]) for name in film.lines),
    ]
    if not film.seen.all():
        handles.insert(1, Line2D([], [], color=REMEMBERED, label="not found: the last", **dot))
    return handles
