"""Traces of measured signals below a film's frames, the animated film, and a sheet of some of its frames."""

import dataclasses
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from PIL import Image, ImageDraw, ImageFont

from jaxlfi.figures import style
from jaxlfi.io import files

MOST = 4
"""Largest number of signals that are drawn."""
COLUMNS = 3
"""Pictures side by side on a sheet."""
PIXELS = 100
"""Resolution of a film, in pixels per inch."""
RECORDED = {"color": "black", "linewidth": 0.8}
LATER = 0.25
"""Opacity of traces after the current time."""
CURSOR = (197, 43, 33)
"""Colour of the line that marks the current time among the traces."""
LEVELS = 255
"""Number of colours of a film."""


@dataclasses.dataclass(frozen=True)
class Traces:
    """Measured signals over an episode.

    Attributes:
        names: of the signals, with units where they are known.
        times: in s, shape [T].
        recorded: NaN where there is no sample, shape [T, C].
        simulated: without noise, shape [N, T, C].
        colour: of the simulated traces, RGB from 0 to 1.
        title: of the film.
        label: of the simulated traces.
        posed: whether pictures show the recorded pose.
    """

    names: Sequence[str]
    times: Float[np.ndarray, " time"]
    recorded: Float[np.ndarray, "time signals"]
    simulated: Float[np.ndarray, "n time signals"]
    colour: tuple[float, float, float]
    title: str
    label: str
    posed: bool

    @property
    def drawn(self) -> int:
        """The number of signals that are drawn."""
        return min(len(self.names), MOST)


class Strip:
    """A picture of traces that is drawn once, in which a cursor moves.

    Attributes:
        height: of the picture, in pixels.
    """

    def __init__(self, traces: Traces, width: int, height: int):
        """Draw the picture; width and height are in pixels."""
        with style.context():
            figure = style.new_figure(width / PIXELS, height / PIXELS)
            figure.set_dpi(PIXELS)
            panels = figure.subplots(traces.drawn, 1, sharex=True, squeeze=False)[:, 0]
            _draw(panels, traces)
            figure.canvas.draw()
            self._picture = np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()
        self.height, self._boxes = len(self._picture), []
        for axes in panels:
            (_, low), (right, high) = axes.transAxes.transform([(0, 0), (1, 1)])
            self._boxes.append((round(self.height - high), round(self.height - low), round(right)))
        self._place = lambda time: panels[0].transData.transform((time, 0))[0]

    def at(self, time: float) -> UInt8[np.ndarray, "height width 3"]:
        """The picture at a time, with the later part paler."""
        picture, x = self._picture.copy(), round(float(self._place(time)))
        for top, bottom, right in self._boxes:
            later = picture[top + 1 : bottom, x + 1 : right]
            later[:] = (255 - LATER * (255 - later.astype(float))).round()
            picture[top + 1 : bottom, x] = CURSOR
        return picture


class Captions:
    """The legend on pictures, and the time."""

    def __init__(self, traces: Traces, size: int):
        """Load a font of a size in pixels."""
        path = Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"
        self._font, self._size, self._traces = ImageFont.truetype(str(path), size), size, traces

    def on(self, picture: UInt8[np.ndarray, "height width 3"], text: str) -> np.ndarray:
        """A picture with the legend, and a text at its right."""
        image = Image.fromarray(picture)
        draw, size, traces = ImageDraw.Draw(image), self._size, self._traces
        colour = tuple(round(255 * part) for part in traces.colour)
        lines = [("white", "recorded" if traces.posed else "recorded: below"), (colour, traces.label)]
        for row, (ink, words) in enumerate(lines):
            top = size * (0.6 + 1.5 * row)
            box, edge = (0.7 * size, top, 1.7 * size, top + size), "black" if ink == "white" else ink
            draw.rounded_rectangle(box, radius=size / 4, fill=ink, outline=edge, width=max(size // 8, 1))
            self._write(draw, (2.1 * size, top + size / 2), words, "lm")
        self._write(draw, (image.width - 0.7 * size, 1.1 * size), text, "rm")
        return np.asarray(image)

    def _write(self, draw: ImageDraw.ImageDraw, place: tuple[float, float], words: str, anchor: str) -> None:
        draw.text(
            place, words, fill=(40, 40, 40), font=self._font, anchor=anchor, stroke_width=2, stroke_fill=(255, 255, 255)
        )


def save_film(
    path: Path,
    pictures: Iterable[UInt8[np.ndarray, "height width 3"]],
    like: Sequence[UInt8[np.ndarray, "height width 3"]],
    interval: float,
) -> Path:
    """Write an animated gif that repeats.

    Args:
        path: of the .gif file.
        pictures: of one size; each is kept in memory with `LEVELS` colours.
        like: some of them, which determine the film's colours.
        interval: between pictures, in s; the format resolves hundredths.
    """
    # One palette and no dithering, so that unchanged pixels do not flicker.
    palette = Image.fromarray(np.concatenate(like)).quantize(LEVELS, method=Image.Quantize.MEDIANCUT)
    frames = (Image.fromarray(one).quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures)
    content, duration = io.BytesIO(), round(1000 * interval)
    next(frames).save(content, "GIF", save_all=True, append_images=frames, duration=duration, loop=0, optimize=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    files.write_bytes(path, content.getvalue())
    return path


def save_sheet(
    path: Path, pictures: Sequence[UInt8[np.ndarray, "height width 3"]], moments: Sequence[float], traces: Traces
) -> Path:
    """Write some frames of a film above the traces, as a PNG file.

    Args:
        path: of the .png file.
        pictures: at the moments.
        moments: times in s.
        traces: of the film.
    """
    rows = -(-len(pictures) // COLUMNS)
    high, wide, _ = pictures[0].shape
    above, below = rows * style.TEXT_WIDTH / COLUMNS * high / wide, 0.45 + 0.75 * traces.drawn
    with style.context():
        figure = style.new_figure(style.TEXT_WIDTH, above + below + 0.3)
        upper, lower = figure.subfigures(2, 1, height_ratios=[above + 0.3, below])
        for axes, picture, moment in zip(upper.subplots(rows, COLUMNS).ravel(), pictures, moments, strict=False):
            axes.imshow(picture, interpolation="antialiased")
            axes.set(xticks=[], yticks=[])
            axes.set_title(f"{moment:.2f} s", y=0.9)
            for side in axes.spines.values():
                side.set_edgecolor("#DDDDDD")
        panels = lower.subplots(traces.drawn, 1, sharex=True, squeeze=False)[:, 0]
        _draw(panels, traces)
        for axes in panels:
            for moment in moments:
                axes.axvline(moment, color=np.array(CURSOR) / 255, linewidth=0.7, linestyle=(0, (3, 2)))
        handles = [
            Line2D([], [], **RECORDED, label="recorded"),
            Line2D([], [], color=traces.colour, label=traces.label),
        ]
        figure.suptitle(style.plain(traces.title), fontsize=8)
        panels[0].legend(handles=handles, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
        return style.save(figure, path, 200)


def _draw(panels: Sequence[Axes], traces: Traces) -> None:
    opacity = max(0.9 / np.sqrt(len(traces.simulated)), 0.12)
    for c, axes in enumerate(panels):
        there = np.isfinite(traces.recorded[:, c])
        for own in traces.simulated:
            axes.plot(traces.times[there], own[there, c], color=traces.colour, linewidth=1.6, alpha=opacity)
        axes.plot(traces.times[there], traces.recorded[there, c], **RECORDED)
        axes.set_ylabel(style.plain(traces.names[c]), rotation=0, ha="right", va="center")
        style.round_ticks(axes.yaxis, 3)
        axes.grid(True)
        axes.set_xlim(traces.times[0], traces.times[-1])
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    panels[-1].set_xlabel("time [s]")
