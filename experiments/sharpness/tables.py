"""The table, from saved arrays."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.sharpness import measures
from experiments.sharpness.held_out import HELD_OUT
from experiments.sharpness.runner import BOXES, METHODS, RULES
from jaxlfi.io import files as atomic

HEADINGS = (
    *("problem", "held out", "box", "heuristic", "method", "simulations", "runs"),
    *("sd ratio", "worst", "abs z", "50 %", "90 %", "exact 50, 90 %", "each 50, 90 %"),
    *("C2ST", "lost", "kept or recovered", "s", "compiling"),
)


def table(out: Path, problems: Sequence[str], methods: Sequence[str] = METHODS) -> str:
    """Markdown: one line per problem, box, heuristic, method and budget.

    Coverage is computed from truths drawn near the problem's own, everything else from all runs.
    """
    lines = ["| " + " | ".join(HEADINGS) + " |", "|---" * len(HEADINGS) + "|"]
    for name in problems:
        for method in methods:
            paths = sorted((out / name).glob(f"{method}-*.npz"), key=_budget)
            for path in (path for path in paths if path.stem.rpartition("-")[0] == method):
                lines += _lines(name, method, _budget(path), atomic.read_arrays(path))
    return "\n".join(lines) + "\n"


def _budget(path: Path) -> int:
    return int(path.stem.rpartition("-")[2])


def _lines(name: str, method: str, simulations: int, rows: measures.Rows) -> list[str]:
    found = []
    for box in BOXES:
        for heuristic in RULES:
            chosen = (rows["box"] == box) & (rows["heuristic"] == heuristic)
            if chosen.any():
                part = {key: values[chosen] for key, values in rows.items()}
                held = "yes" if name in HELD_OUT else ""
                cells = [name, held, box, heuristic, method, f"{simulations:,}", *cells_of(part, box, heuristic)]
                found.append("| " + " | ".join(cells) + " |")
    return found


def cells_of(rows: measures.Rows, box: str, heuristic: str) -> list[str]:
    """The formatted figures of a line; empty where there are none."""
    near = {key: values[rows["kind"] == "near"] for key, values in rows.items()}
    number = lambda value, digits=2: f"{value:.{digits}f}" if np.isfinite(value) else ""
    pair = lambda values: ", ".join(map(number, values)) if np.isfinite(values).all() else ""
    coverage = [measures.covered(near["density_rank"], level) for level in measures.LEVELS]
    exact = [measures.covered(near["exact_density_rank"], level) for level in measures.LEVELS]
    each = [measures.covered_each(near["rank"], level) for level in measures.LEVELS]
    count = len(rows["label"])
    share = lambda which: f"{int(np.sum(which))} of {count}"
    bounds = (
        "" if heuristic == "fixed" else share(measures.kept(rows) if box == "right" else measures.holds_truth(rows))
    )
    known = rows["c2st"][np.isfinite(rows["c2st"])]
    z = measures.distances(rows)
    unknown = int(np.sum(~np.isfinite(rows["exact_sd"]).all(axis=1)))
    return [
        str(count) + (f" ({unknown} without exact)" if unknown else ""),
        number(float(measures.geometric_mean(measures.ratios(rows)))),
        number(measures.worst(rows)),
        number(float(np.mean(z[np.isfinite(z)])) if np.isfinite(z).any() else np.nan),
        *(number(value) for value in coverage),
        pair(exact),
        pair(each),
        number(float(known.mean()) if len(known) else np.nan),
        share(measures.lost(rows)),
        bounds,
        number(float(np.mean(rows["seconds"])), 1),
        number(float(np.mean(rows["compile_seconds"])), 0),
    ]
