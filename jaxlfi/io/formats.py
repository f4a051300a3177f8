"""Formats of work folders, and versions: one is read, and of any other it is said which jaxlfi reads it.

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
        what: it is, for errors.
        version: of the format that is written; it rises whenever an older one could be misread.
        read: older versions of which finished work is read.
    """

    what: str
    version: int
    read: tuple[int, ...] = ()


VERSION = 4
"""Of the formats of runs, grids and diagnostics.

What is added to a folder without a new number, readers must do without: a new setting's default is what was done before
there was the setting. `tests/golden/formats/` has a folder of each number, and of each state of one.
"""
READ = (2, 3)
"""In 2, normalisers counted from zero (`jaxlfi.runs.load`); in 3, an unfinished run believed what it proposed by."""
FORMATS = {
    **dict.fromkeys((RUN, RUNS, COMPARE), Format("a run folder", VERSION, READ)),
    GRID: Format("the folder of a grid", VERSION),
    DIAGNOSTICS: Format("the folder of diagnostics", VERSION),
    TRAINING: Format("the folder of a training", 1),
    LOOP: Format("the folder of a loop", 1),
}
"""All work folders there are, by the "format" of their record."""
NOTHING: Mapping[str, Any] = {}


def recorded(folder: Path, record: str = CONFIG) -> dict[str, Any]:
    """What a folder says of itself, be it sound or not; nothing where it says nothing."""
    try:
        found = json.loads((folder / record).read_text())
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def require_version(where: Any, kind: str, wanted: int, got: Any, record: Mapping[str, Any] = NOTHING) -> None:
    """Refuse a file of another version of its format, in one line that names the jaxlfi which reads it.

    Args:
        where: the file, for the error.
        kind: name of the format.
        wanted: the version that is read.
        got: the version that the file says.
        record: what the file says of its origin: `versions` of packages by name, and when it was `started`.

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
    """Which jaxlfi wrote a file, and when, as its record of `versions` and `started` says; "" where it says nothing.

    The date is a part of it, as development versions share a number.
    """
    versions = record.get("versions")
    version = versions.get("jaxlfi") if isinstance(versions, Mapping) else None
    if not isinstance(version, str):
        return ""
    started = record.get("started")
    return f"jaxlfi {version} of {started[:10]}" if isinstance(started, str) else f"jaxlfi {version}"
