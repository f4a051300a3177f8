"""Tables and the figure, from saved arrays: how often policies leave the scene as desired, and contrasts."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from experiments.arms import contrast_rows, markdown, mean, with_interval
from experiments.settled.domains import BROAD, HEURISTICS, OBJECTS, truths
from jaxlfi.diagnostics.contrasts import Arm
from jaxlfi.envs.whip.parameters import INITIAL, MILLIMETRES
from jaxlfi.figures import style
from jaxlfi.io import files

OWN = ("oracle", *HEURISTICS)
"""Arms with a policy for each object."""
ARMS = (*OWN, *BROAD, "constant", "random")
"""All arms, in the order of the tables."""
FLOORS = ("constant", "random")
"""Baseline arms, which are shown beside the others but are in no contrast."""
PRIMARY = "settled_clean"
"""The outcome that contrasts compare."""
MEASURES: Mapping[str, str] = {
    PRIMARY: "the top cube alone",
    "value": "settled return",
    "settled_hit": "the top cube",
    "displaced": "cubes displaced",
    "clean_hit": "clean when it ended",
    "outside": "left the workspace",
}
"""Columns of the table, by the outcome that they are means of."""
DIGITS = 2

Episodes = Mapping[str, np.ndarray]
"""Arrays as in `training.Played`."""


def arms(episodes: Episodes, what: str = PRIMARY) -> dict[str, Arm]:
    """One outcome of the finished arms, [objects, seeds, places]."""
    there = {name.split("/")[0] for name in episodes}
    values = lambda arm: np.stack([np.asarray(episodes[f"{arm}/{dlo}/{what}"], float) for dlo in OBJECTS])
    return {arm: Arm(values(arm), shared=arm not in OWN) for arm in ARMS if arm in there}


def table(episodes: Episodes) -> list[dict[str, str]]:
    """Outcomes of each arm: means over objects, seeds and places, with their intervals."""
    every = {heading: arms(episodes, what) for what, heading in MEASURES.items()}
    return [
        {"trained on": name} | {heading: with_interval(mean(found[name]), DIGITS) for heading, found in every.items()}
        for name in arms(episodes)
    ]


def contrasts(episodes: Episodes) -> list[dict[str, str]]:
    """How much more often the posterior's policies leave the scene as desired than other arms'; [] without them."""
    found = arms(episodes)
    if "posterior" not in found:
        return []
    others = {name: arm for name, arm in found.items() if name not in ("posterior", *FLOORS)}
    return contrast_rows(found["posterior"], others, difference="more often by", digits=DIGITS)


def inside() -> np.ndarray:
    """Which objects the first guess contains, shape [objects]."""
    low, high = (np.asarray(bound) * MILLIMETRES for bound in (INITIAL.low, INITIAL.high))
    return np.all((low <= truths()) & (truths() <= high), axis=1)


def by_object(episodes: Episodes, learning: Mapping[str, np.ndarray]) -> list[dict[str, str]]:
    """How often policies leave the scene as desired on each object, and the range of the posterior's points."""
    found, trained = arms(episodes), learning.get("posterior/trained")
    rows = []
    for place, ((length, young), known) in enumerate(zip(truths(), inside(), strict=True)):
        row = {"length, mm": f"{length:.0f}", "E, kPa": kilopascals(young), "in the guess": "yes" if known else "no"}
        if trained is not None:
            (short, soft), (long, stiff) = trained[place].min(axis=0), trained[place].max(axis=0)
            row["trained on"] = f"{short:.0f} to {long:.0f} mm, {kilopascals(soft)} to {kilopascals(stiff)} kPa"
        rows.append(row | {name: f"{arm.values[place].mean():.{DIGITS}f}" for name, arm in found.items()})
    return rows


def kilopascals(young: float) -> str:
    """A modulus in kPa, to two digits."""
    return f"{float(f'{young / 1e3:.2g}'):g}"


def draw(axes: Axes, episodes: Episodes) -> None:
    """Draw a mark for each object by arm, filled if the guess contains it, and the mean as a bar with its interval."""
    found = arms(episodes)
    for row, arm in enumerate(found.values()):
        rates, over = arm.values.mean(axis=(1, 2)), mean(arm)
        heights = row + 0.5 * (np.arange(len(OBJECTS)) / (len(OBJECTS) - 1) - 0.5)
        for known, fill in ((True, "C0"), (False, "none")):
            own = inside() == known
            axes.plot(rates[own], heights[own], "o", color="C0", markerfacecolor=fill, markersize=3)
        axes.plot([over.difference] * 2, [row - 0.4, row + 0.4], "-", color="black", linewidth=1.2)
        axes.plot([over.low, over.high], [row, row], "-", color="black", linewidth=0.6)
    axes.set_yticks(range(len(found)), list(found))
    axes.invert_yaxis()
    axes.set_xlim(-0.02, 1.02)
    axes.set_xlabel("rate of the top cube alone out of its place, once settled")
    axes.grid(axis="x")
    marks = [Line2D([], [], marker="o", linestyle="", color="C0", markerfacecolor=fill) for fill in ("C0", "none")]
    axes.legend(marks, ["object in the guess", "object outside"], loc="lower right")


def draw_curves(axes: Axes, learning: Mapping[str, np.ndarray], width: int = 7) -> None:
    """Draw returns while learning over environment steps: means over an arm's policies and `width` updates."""
    steps = int(learning["steps_per_update"])
    for name in (arm for arm in ARMS if f"{arm}/curve" in learning):
        curve = learning[f"{name}/curve"]
        value = curve[: len(curve) // width * width]
        means = np.nanmean(value.reshape(-1, width * value.shape[1]), axis=1)
        axes.plot((np.arange(len(means)) + 0.5) * width * steps / 1e3, means, label=name)
    axes.set_xlabel("environment steps, thousands")
    axes.set_ylabel("settled return while learning")
    axes.grid()
    axes.legend(loc="lower right")


def write(out: Path) -> None:
    """Write the tables and the figure of a folder that has the arrays."""
    episodes, learning = files.read_arrays(out / "episodes.npz"), files.read_arrays(out / "learning.npz")
    tables = {"table": table(episodes), "contrasts": contrasts(episodes), "objects": by_object(episodes, learning)}
    for name, rows in tables.items():
        if rows:
            files.write_bytes(out / f"{name}.md", f"{markdown(rows)}\n".encode())
            print(markdown(rows))
    with style.context():
        figure = style.new_figure(style.TEXT_WIDTH, 2.8)
        left, right = figure.subplots(1, 2)
        draw(left, episodes)
        draw_curves(right, learning)
        style.save(figure, out / "outcomes.png", dpi=200)
