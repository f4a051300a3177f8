"""Finished cases as rows of results.csv, and the tables that are made from them."""

import csv
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

IDENTITY = ("setting", "method", "simulations", "seed")
COLUMNS = (
    *IDENTITY,
    *("c2st", "error", "inside", "ranks", "log_prob"),
    *("seconds", "compile_seconds", "simulated", "failed", "note"),
)
Row = dict[str, str]


def read(path: Path) -> list[Row]:
    """The rows so far, none if there is no file. A line truncated by a crash is left out."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [row for row in csv.DictReader(file) if None not in row.values()]


def append(path: Path, row: Row) -> None:
    """Append one row, after the headings if it is the first; it is on disk when this returns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cut_short = path.exists() and not path.read_bytes().endswith(b"\n")
    with path.open("a", newline="") as file:
        file.write("\n" * cut_short)
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        if file.tell() == 0:
            writer.writeheader()
        writer.writerow(row)
        file.flush()
        os.fsync(file.fileno())


def missing(wanted: Iterable[Row], rows: Sequence[Row]) -> list[Row]:
    """Those of the wanted cases (`IDENTITY`) that have no row yet, in their order."""
    there = {tuple(row[name] for name in IDENTITY) for row in rows}
    return [one for one in wanted if tuple(one[name] for name in IDENTITY) not in there]


def tables(rows: Sequence[Row], settings: Sequence[str], methods: Sequence[str]) -> str:
    """Markdown: for each budget and measure, a table of methods by settings, in the given order.

    A cell has the mean and standard deviation over seeds and their number, with the total if some gave no result. The
    best mean of a column is bold. Columns without a value and methods that were not run are left out.
    """
    parts = []
    for simulations in sorted({row["simulations"] for row in rows}, key=int):
        of_budget = [row for row in rows if row["simulations"] == simulations]
        for title, measure, best, digits in MEASURES:
            lines = _table(of_budget, measure, best, digits, settings, methods)
            if lines:
                parts.append("\n".join([f"{int(simulations):,} simulations, {title}:", "", *lines]))
    return "\n\n".join(parts) + "\n"


def _number(name: str):
    return lambda row: float(row[name]) if row[name] else None


def _accuracy_or_error(row: Row) -> float | None:
    return _number("c2st")(row) if row["c2st"] else _number("error")(row)


def _held(row: Row) -> float | None:
    return int(row["inside"]) / len(row["ranks"].split()) if row["ranks"] else None


MEASURES = (
    ("C2ST where there is an exact posterior, else the summed error", _accuracy_or_error, min, 2),
    ("mean log-density of the exact posterior's draws, or of the truth", _number("log_prob"), max, 2),
    ("fraction of parameters whose central 90 % interval covers the truth", _held, None, 2),
    ("seconds, without compiling ahead", _number("seconds"), None, 0),
)
"""Title, function for the measure of a row, function for the best mean, and number of decimals."""


def _table(
    of_budget: Sequence[Row], measure, best, digits: int, settings: Sequence[str], methods: Sequence[str]
) -> list[str]:
    values = {
        (method, setting): [
            measure(row)
            for row in of_budget
            # A likelihood's posterior has no density of its own, so a missing measure is no failure.
            if (row["method"], row["setting"]) == (method, setting) and (row["note"] or measure(row) is not None)
        ]
        for method in methods
        for setting in settings
    }
    kept = {place: [value for value in all_ if value is not None] for place, all_ in values.items()}
    columns = [setting for setting in settings if any(kept[method, setting] for method in methods)]
    chosen = [method for method in methods if any(values[method, setting] for setting in columns)]
    if not columns:
        return []
    lines = ["| method | " + " | ".join(f"`{name}`" for name in columns) + " |", "|---" * (len(columns) + 1) + "|"]
    top = {
        setting: best(np.mean(kept[method, setting]) for method in chosen if kept[method, setting]) if best else None
        for setting in columns
    }
    for method in chosen:
        cells = [_cell(values[method, setting], kept[method, setting], top[setting], digits) for setting in columns]
        lines.append(f"| `{method}` | " + " | ".join(cells) + " |")
    return lines


def _cell(every: Sequence[float | None], kept: Sequence[float], best: float | None, digits: int) -> str:
    if not every:
        return ""
    count = f"({len(kept)})" if len(kept) == len(every) else f"({len(kept)} of {len(every)})"
    if not kept:
        return f"nothing {count}"
    mean = np.mean(kept)
    text = f"{mean:.{digits}f}" + (f" ± {np.std(kept, ddof=1):.{digits}f}" if len(kept) > 1 else "")
    return f"**{text}** {count}" if best is not None and mean == best else f"{text} {count}"
