"""Tables and the figure, from saved arrays: distances from the mark in cm, and contrasts against the posterior."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from experiments.arms import contrast_rows, markdown, mean, with_interval
from experiments.knowing.domains import OBJECTS, OWN
from jaxlfi.diagnostics.contrasts import Arm
from jaxlfi.figures import style
from jaxlfi.io import files

ARMS = (*OWN, "history", "ADR", "wide box", "guess", "constant", "random")
"""All arms, in the order of the tables."""
CENTIMETRES = 100.0


def arms(episodes: Mapping[str, np.ndarray]) -> dict[str, Arm]:
    """Distances from the mark in cm, negative, by arm: [objects, seeds, episodes]."""
    return {
        name: Arm(CENTIMETRES * np.stack([episodes[f"{name}/{dlo}"] for dlo in OBJECTS]), shared=name not in OWN)
        for name in ARMS
    }


def table(found: Mapping[str, Arm]) -> list[dict[str, str]]:
    """Distance from the mark at which the puck stops: over all objects with its interval, and on each."""
    rows = []
    for name, arm in found.items():
        off = Arm(-arm.values, arm.shared)
        each = lambda seeds: f"{seeds.mean():.1f} ({seeds.min():.1f} to {seeds.max():.1f})"
        row = {"trained on": name, "all": with_interval(mean(off), 1)}
        rows.append(row | {dlo: each(own) for dlo, own in zip(OBJECTS, off.values.mean(axis=2), strict=True)})
    return rows


def contrasts(found: Mapping[str, Arm]) -> list[dict[str, str]]:
    """How much nearer to the mark the posterior's policies stop than each other arm's."""
    others = {name: arm for name, arm in found.items() if name != "posterior"}
    return contrast_rows(found["posterior"], others, difference="nearer to the mark by, cm", digits=1)


def draw(axes: Axes, found: Mapping[str, Arm]) -> None:
    """Draw a mark for each policy on each object, by arm, and the mean of all as a bar."""
    for row, arm in enumerate(found.values()):
        off = -arm.values.mean(axis=2)
        for place, (own, marker) in enumerate(zip(off, "osD^", strict=True)):
            heights = row + 0.16 * (place - 1.5) + np.zeros(len(own))
            axes.plot(own, heights, marker, color=f"C{place}", markersize=3, alpha=0.8)
        axes.plot([off.mean()] * 2, [row - 0.4, row + 0.4], "-", color="black", linewidth=1.2)
    for place, (name, marker) in enumerate(zip(OBJECTS, "osD^", strict=True)):
        axes.plot([], [], marker, color=f"C{place}", label=name)
    axes.set_yticks(range(len(found)), list(found))
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel("distance from the mark in cm, mean of a policy's episodes")
    axes.grid(axis="x")
    axes.legend(loc="lower left", title="object")


def write(out: Path) -> None:
    """Write the tables and the figure of a folder that has the arrays."""
    found = arms(files.read_arrays(out / "episodes.npz"))
    for name, make in (("table", table), ("contrasts", contrasts)):
        files.write_bytes(out / f"{name}.md", f"{markdown(make(found))}\n".encode())
        print(markdown(make(found)))
    with style.context():
        figure = style.new_figure(style.TEXT_WIDTH, 3.6)
        draw(figure.subplots(), found)
        style.save(figure, out / "returns.png", dpi=200)
