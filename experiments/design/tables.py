"""The study's tables, from the arrays."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from jaxlfi.diagnostics.bootstrap import bootstrap_interval

ARMS = ("chosen", "nominal again", "at random", "at random")
"""Arms of arrays that do not name them."""
RANDOM = "at random"
ORDER = ("arm", "load", "times", "starts", "furuta", "belt")
"""Order of the problems."""


def arms_of(kept: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Indices of each arm on the arrays' second axis, whose first entry is the first experiment alone."""
    names = [str(name) for name in kept.get("arms", np.array(ARMS))]
    return {name: 1 + np.flatnonzero(np.array(names) == name) for name in dict.fromkeys(names)}


def log_ratios(kept: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Log-ratios of widths to the first experiment's, [truths], averaged over parameters and repetitions."""
    width = np.log(kept["width"]).mean(axis=2)
    return {name: (width[:, places] - width[:, :1]).mean(axis=1) for name, places in arms_of(kept).items()}


def widths(folder: Path, names: Iterable[str]) -> str:
    """Widths and coverage of intervals after the second experiments."""
    lines = [
        "| problem | truths | next | 90 % intervals, as a fraction of the first's | against random | "
        "product of widths against random | truths held |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in names:
        kept = dict(np.load(folder / f"{name}.npz"))
        ratios, dim = log_ratios(kept), kept["width"].shape[2]
        left_out = int(kept.get("refused", 0))
        truths = f"{len(kept['width'])}" + (f" ({left_out} left out)" if left_out else "")
        for what, own in ratios.items():
            low, high = np.exp(np.quantile(own, [0.1, 0.9]))
            against = own - ratios[RANDOM]
            better, product = "–", "–"
            if what != RANDOM:
                better = f"{np.exp(against.mean()):.2f} times"
                inner = np.exp(bootstrap_interval(dim * against))
                product = f"{np.exp(dim * against.mean()):.2g} [{inner[0]:.2g}, {inner[1]:.2g}]"
            held = kept["held"][:, arms_of(kept)[what]]
            lines.append(
                f"| {name} | {truths} | {what} | {np.exp(own.mean()):.2f} [{low:.2f}, {high:.2f}] | {better} | "
                f"{product} | {held.mean():.0%} of {held.size} |"
            )
    return "\n".join(lines) + "\n"


def ridges(folder: Path, names: Iterable[str]) -> str:
    """Predicted factors by which the ridge becomes narrower."""
    lines = ["| problem | best of all rated, on the ridge | predicted by the chosen one |", "|---|---|---|"]
    for name in names:
        kept = np.load(folder / f"{name}.npz")
        lines.append(
            f"| {name} | {np.median(kept['reach']):.2f} times narrower (at most {kept['reach'].max():.2f}) | "
            f"{np.median(kept['narrower']):.2f} times |"
        )
    return "\n".join(lines) + "\n"


def queue(folder: Path) -> str:
    """Widths of a queue's intervals by the number of jobs before it is emptied, and for the chosen designs."""
    kept = np.load(folder / "queue.npz")
    alone, width = kept["width"][0], kept["width"][1:]
    lines = [
        "| second experiment | service min | service width | arrival rate | product | truths held |",
        "|---|---|---|---|---|---|",
    ]

    def row(what: str, ratio: np.ndarray, held: np.ndarray) -> str:
        cells = " | ".join(f"{one:.2f}" for one in np.exp(np.log(ratio).mean(axis=0)))
        return f"| {what} | {cells} | {np.exp(np.log(ratio).sum(axis=1).mean()):.2f} | {held.mean():.0%} |"

    for jobs, own, held in zip(kept["jobs"], width, kept["held"][1:], strict=True):
        what = f"{jobs:g} job{'s' if jobs > 1 else ''} each" if jobs < kept["jobs"][-1] else f"{jobs:g} jobs in one go"
        lines.append(row(what, (own / alone)[None], held))
    for place, what in enumerate(("chosen", RANDOM)):
        low, middle, high = np.quantile(kept["second"][:, place], [0.1, 0.5, 0.9])
        jobs = f"{what}, {middle:.0f} [{low:.0f}, {high:.0f}] jobs"
        lines.append(row(jobs, kept["second_width"][:, place] / alone, kept["second_held"][:, place]))
    return "\n".join(lines) + "\n"


def table(folder: Path) -> str:
    """All tables of the problems that have been measured."""
    there = [name for name in ORDER if (folder / f"{name}.npz").exists()]
    parts = [widths(folder, there), ridges(folder, there)]
    return "\n".join(parts + ([queue(folder)] if (folder / "queue.npz").exists() else []))
