"""Collection: the runs of a folder, by configuration and seed, and the table of their results."""

import csv
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.figures.history import History, load, read_config
from jaxlfi.figures.sensitivity import FORMAT as GRID
from jaxlfi.figures.style import HEURISTIC_COLOURS, SUPPORT_COLOURS

Runs = Mapping[str, Sequence[History]]
"""Configurations by name, each with its seeds."""

FORMATS = ("jaxlfi-run", "jaxlfi-runs", "jaxlfi-compare")
MEASURES = ("theta_error", "trajectory_error", "success_rate", "seconds")


@dataclasses.dataclass(frozen=True)
class Row:
    """One run in the table of results."""

    configuration: str  # name of the configuration
    seed: int  # random seed of the run
    theta_error: float  # |theta - theta_gt| summed over parameters, mean over posterior samples
    trajectory_error: float  # distance from the observed trajectory, mean over posterior samples
    success_rate: float  # fraction of the simulations that did not fail
    seconds: float  # duration of the run


@dataclasses.dataclass(frozen=True)
class Collection:
    """The content of a run folder, from which figures are drawn."""

    folder: Path  # folder it was read from
    config: Mapping[str, Any]  # its config.json
    runs: Runs  # histories by configuration
    table: tuple[Row, ...]  # one row per run
    unfinished: tuple[str, ...]  # folders of runs with fewer rounds than the others; they are left out

    def values(self, measure: str) -> dict[str, np.ndarray]:
        """One measure of the table's rows, by configuration in the runs' order."""
        order = [*self.runs, *(row.configuration for row in self.table if row.configuration not in self.runs)]
        found = {name: [getattr(r, measure) for r in self.table if r.configuration == name] for name in order}
        return {name: np.array(values, float) for name, values in found.items() if values}


def all_of(runs: Runs) -> list[History]:
    """The runs of all configurations."""
    return [history for histories in runs.values() for history in histories]


def first_of(runs: Runs) -> History:
    """One of the runs, for properties that all share."""
    return next(iter(runs.values()))[0]


def seed_count(runs: Runs) -> int:
    """The largest number of seeds of any configuration."""
    return max(len(histories) for histories in runs.values())


def representative(histories: Sequence[History]) -> History:
    """The seed of median parameter error (the lower of two); the first if the truth is unknown."""
    ranked = sorted((h for h in histories if np.isfinite(h.final_theta_error)), key=lambda h: h.final_theta_error)
    return ranked[(len(ranked) - 1) // 2] if ranked else histories[0]


def open_collection(folder: Path | str) -> Collection:
    """Read a folder of one run, of several seeds, or of a comparison.

    Raises:
        ValueError: for a folder that is missing, damaged, of another kind, or without a finished round.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected a run folder, found {'a file' if folder.exists() else 'none'}")
    config = read_config(folder)
    if config["format"] not in FORMATS:
        hint = ", a sensitivity grid: `report` draws it" if config["format"] == GRID else ""
        raise ValueError(
            f"{folder}: expected config.json of format {' or '.join(FORMATS)}, got {config['format']!r}{hint}"
        )
    unfinished: list[str] = []
    if config["format"] == "jaxlfi-run":
        history = load(folder)
        runs: dict[str, list[History]] = {history.configuration: [history]}
    elif config["format"] == "jaxlfi-runs":
        histories = _seeds(folder, None, unfinished)
        runs = {histories[0].configuration: histories} if histories else {}
    else:
        folders = {
            path.name: path for path in folder.iterdir() if path.name != "checkpoint" and any(path.glob("seed_*"))
        }
        runs = {name: _seeds(folders[name], name, unfinished) for name in _ordered(folders, config)}
    runs = _alike(folder, runs, unfinished)
    if not runs:
        where = "<configuration>/seed_000" if config["format"] == "jaxlfi-compare" else "seed_000"
        raise ValueError(f"{folder}: expected finished rounds in folders such as {where}, found none")
    path = folder / "table.csv"
    table = read_table(path) if path.is_file() else tuple(_row(h) for seeds in runs.values() for h in seeds)
    return Collection(folder, config, runs, table, tuple(unfinished))


def read_table(path: Path) -> tuple[Row, ...]:
    """The rows of table.csv; an empty field is NaN.

    Raises:
        ValueError: if a column is missing or a field is not a number.
    """
    columns = ("configuration", "seed", *MEASURES)
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if missing := [name for name in columns if name not in (reader.fieldnames or ())]:
                raise ValueError(f"expected the columns {', '.join(columns)}; missing {', '.join(missing)}")
            return tuple(
                Row(line["configuration"], int(line["seed"]), *(float(line[name] or "nan") for name in MEASURES))
                for line in reader
            )
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"{path}: expected a table of results, but it cannot be read ({error})") from error


def _seeds(folder: Path, configuration: str | None, unfinished: list[str]) -> list[History]:
    """The runs in seed_* folders; those without a history are added to `unfinished`."""
    histories = []
    for path in sorted(folder.glob("seed_*")):
        if (path / "history.npz").is_file():
            histories.append(load(path, configuration))
        else:
            unfinished.append(str(path))
    return histories


def _ordered(names: Mapping[str, Path], config: Mapping[str, Any]) -> list[str]:
    """Configurations in the order of config.json, then in the paper's order, then by name."""
    listed = config.get("configurations")
    given = [name for name in listed if isinstance(name, str)] if isinstance(listed, list | dict) else []
    supports, heuristics = list(SUPPORT_COLOURS), list(HEURISTIC_COLOURS)

    def rank(name: str) -> tuple:
        support, _, heuristic = name.partition("+")
        place = given.index(name) if name in given else len(given)
        rule = heuristics.index(heuristic) if heuristic in heuristics else len(heuristics)
        box = supports.index(support) if support in supports else len(supports)
        return place, bool(heuristic), rule, box, name

    return sorted(names, key=rank)


def _alike(folder: Path, runs: Mapping[str, list[History]], unfinished: list[str]) -> dict[str, list[History]]:
    """The runs that can be compared: those with the same parameters and as many rounds as the longest."""
    every = all_of(runs)
    for history in every[1:]:
        if history.names != every[0].names:
            raise ValueError(
                f"{folder}: expected runs of the same parameters, got {every[0].names} in {every[0].folder} "
                f"and {history.names} in {history.folder}"
            )
    rounds = max((history.rounds for history in every), default=0)
    unfinished.extend(str(history.folder) for history in every if history.rounds < rounds)
    complete = {name: [h for h in histories if h.rounds == rounds] for name, histories in runs.items()}
    return {name: histories for name, histories in complete.items() if histories}


def _row(history: History) -> Row:
    return Row(
        history.configuration,
        history.seed,
        history.final_theta_error,
        history.final_trajectory_error,
        history.success_rate,
        float(history.seconds.sum()),
    )
