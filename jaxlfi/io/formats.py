"""Formats of work folders and their versions; errors name the jaxlfi version that reads a version unknown here.

This module imports neither jax nor numpy.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

CONFIG, PLAN = "config.json", "plan.json"
RUN, RUNS, COMPARE, GRID = "jaxlfi-run", "jaxlfi-runs", "jaxlfi-compare", "jaxlfi-grid"
DIAGNOSTICS, TRAINING, LOOP = "jaxlfi-diagnostics", "jaxlfi-training", "jaxlfi-r2s2r"


class Format(NamedTuple):
    """A kind of work folder.

    Attributes:
        what: name of such a folder, for errors.
        version: version of the format that is written; it rises whenever an older one could be misread.
        read: older versions that can be read if the work is finished.
    """

    what: str
    version: int
    read: tuple[int, ...] = ()


VERSION = 4
"""Version of the formats of runs, grids and diagnostics.

Readers must manage without what is added to a folder under the same number: a new setting's default is the behaviour
before the setting existed. `tests/golden/formats/` has a folder of each version, and of each state of one.
"""
READ = (2, 3)
"""In 2, normalisers had no origin (`jaxlfi.runs.load`); in 3, unfinished runs had one belief to propose and report."""
FORMATS = {
    **dict.fromkeys((RUN, RUNS, COMPARE), Format("a run folder", VERSION, READ)),
    GRID: Format("the folder of a grid", VERSION),
    DIAGNOSTICS: Format("the folder of diagnostics", VERSION),
    TRAINING: Format("the folder of a training", 1),
    LOOP: Format("the folder of a loop", 1),
}
"""All kinds of work folders, by the "format" of their record."""
NOTHING: Mapping[str, Any] = {}


def recorded(folder: Path, record: str = CONFIG) -> dict[str, Any]:
    """The record of a folder, whether or not the folder is sound; empty if there is none."""
    try:
        found = json.loads((folder / record).read_text())
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def require_version(where: Any, kind: str, wanted: int, got: Any, record: Mapping[str, Any] = NOTHING) -> None:
    """Refuse a file of another version of its format, in one line that names the jaxlfi version that reads it.

    Args:
        where: the file, for the error.
        kind: name of the format.
        wanted: the version that is read.
        got: the file's version.
        record: the file's record of its origin: `versions` of packages by name, and when it was `started`.

    Raises:
        ValueError: for another version.

    Example:
        >>> record = {"versions": {"jaxlfi": "0.1.0"}, "started": "2026-11-22T14:00:00+00:00"}
        >>> require_version("run/config.json", "jaxlfi-run", 2, 1, record)
        Traceback (most recent call last):
        ValueError: run/config.json: expected jaxlfi-run of version 2, got version 1, which jaxlfi 0.1.0 of 2026-11-22 \
wrote and reads
    """
    if type(got) is int and got == wanted:
        return
    text = f"{where}: expected {kind} of version {wanted}, got version {got!r}"
    if type(got) is not int or got < 1:
        raise ValueError(text)
    if author := written_by(record):
        raise ValueError(f"{text}, which {author} wrote and reads")
    raise ValueError(f"{text}, which {'a newer' if got > wanted else 'an older'} jaxlfi wrote and reads")


def written_by(record: Mapping[str, Any]) -> str:
    """The jaxlfi version that wrote a file, and the date, from its record of `versions` and `started`; "" if unknown.

    The date is included because development versions share a number.
    """
    versions = record.get("versions")
    version = versions.get("jaxlfi") if isinstance(versions, Mapping) else None
    if not isinstance(version, str):
        return ""
    started = record.get("started")
    return f"jaxlfi {version} of {started[:10]}" if isinstance(started, str) else f"jaxlfi {version}"
