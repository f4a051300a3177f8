"""The life of a work folder: it is created complete or not at all, recognised, read, and finished.

Every folder that a command works in holds a record, config.json (plan.json for diagnostics): its format and version,
the request, the environment, and whether the work is finished. Its other contents depend on the work.
"""

import json
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from jaxlfi.io import files
from jaxlfi.io.formats import CONFIG, FORMATS, require_version
from jaxlfi.io.serialise import json_safe
from jaxlfi.io.shell import quoted


class StoreError(ValueError):
    """A folder that cannot be read, resumed or written to."""


def create(folder: Path, config: Mapping[str, Any], fill: Callable[[Path], Any], replace: bool = False) -> None:
    """Create a work folder, complete or not at all.

    Args:
        folder: the folder, which must not exist or must be empty.
        config: content of config.json.
        fill: called with the folder's temporary path to write its other contents.
        replace: whether the folder may hold something, which is removed once the new one is in its place. A kill in
            between leaves it beside that place, under a hidden name.

    Raises:
        StoreError: if the folder is not empty or cannot be written.
    """
    if not replace:
        refuse_occupied(folder)
    folder = folder.resolve()  # a link to an empty folder stands for that folder
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    except OSError as error:
        raise StoreError(f"out: expected a folder that can be written, got {str(folder)!r}: {error}") from error
    try:
        staging.chmod(0o755)
        fill(staging)
        files.write_json(staging / CONFIG, config)
        if replace:
            _exchange(staging, folder)
        else:
            staging.rename(folder)
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        raise


def _exchange(staging: Path, folder: Path) -> None:
    """Put a new folder in the place of another, which is removed, or put back if that fails."""
    aside = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent)) / folder.name
    folder.rename(aside)
    try:
        staging.rename(folder)
    except BaseException:
        aside.rename(folder)  # if this fails, too, it stays aside
        aside.parent.rmdir()
        raise
    shutil.rmtree(aside.parent, ignore_errors=True)


def begun(folder: Path, record: str, expected: str = "a new or empty folder") -> bool:
    """Whether a folder already holds work; if not, it is created. For commands that continue when repeated.

    Args:
        folder: the work folder.
        record: name of its record. A kill while it is written leaves NAME.part.
        expected: what the folder should be, for errors.

    Raises:
        StoreError: if the folder holds something else.
    """
    if (folder / record).exists():
        return True
    if folder.exists() and (not folder.is_dir() or any(path.suffix != ".part" for path in folder.iterdir())):
        raise StoreError(f"out: expected {expected}, got {str(folder)!r}, which is not empty")
    folder.mkdir(parents=True, exist_ok=True)
    return False


def refuse_occupied(folder: Path) -> None:
    """Refuse to write into a folder that is not empty.

    Raises:
        StoreError: if the folder exists and is not empty, or is a file, a link to nothing, or the current folder, which
            cannot be replaced.
    """
    if folder.is_symlink() and not folder.exists():
        raise StoreError(f"out: expected a new or empty folder, got {str(folder)!r}, a broken symbolic link")
    if not folder.exists():
        return
    if folder.samefile(Path.cwd()):
        raise StoreError(f"out: expected a new or empty folder, got {str(folder)!r}, the current one")
    if not folder.is_dir() or any(folder.iterdir()):
        raise StoreError(
            f"out: expected a new or empty folder, got {str(folder)!r} which is not empty: choose another name, or "
            f"continue it with {quoted('jaxlfi', 'resume', folder)}"
        )


def read(folder: Path, *formats: str) -> dict[str, Any]:
    """The config.json of a folder.

    Args:
        folder: the work folder.
        formats: formats that it may have.

    Raises:
        StoreError: for a folder of another format or version.
    """
    what = FORMATS[formats[0]].what
    if not folder.is_dir():
        raise StoreError(f"expected {what}, got {str(folder)!r}, which is not a folder")
    path = folder / CONFIG
    try:
        config = files.read_json(path)
    except ValueError as error:
        raise StoreError(f"expected {what}, got {str(folder)!r} without a readable {CONFIG}") from error
    kind = config.get("format") if isinstance(config, dict) else None
    if kind not in formats:
        known = isinstance(kind, str) and kind.startswith("jaxlfi-")
        found = f"is of format {kind!r}" if known else "is not of jaxlfi"
        raise StoreError(f"expected {what}, got {str(folder)!r} whose {CONFIG} {found}")
    require_format(path, config)
    return config


def require_format(path: Path, config: Mapping[str, Any]) -> None:
    """Refuse the record of another version of its format, except for finished work of some older ones.

    Raises:
        StoreError: in one line.
    """
    _, version, older = FORMATS[config["format"]]
    if config.get("version") in older and is_finished(config):
        return
    try:
        require_version(path, config["format"], version, config.get("version"), config)
    except ValueError as error:
        raise StoreError(f"{error}; or run its command again") from error


def is_finished(config: Mapping[str, Any]) -> bool:
    """Whether the work is finished; one run of several, whose record has no status, counts as finished."""
    return config.get("status", "finished") == "finished"


def finish(folder: Path, **found: Any) -> None:
    """Write into the record that the work is finished, and what was found."""
    config = files.read_json(folder / CONFIG)
    files.write_json(folder / CONFIG, config | {"status": "finished"} | found)


def as_json(value: Any) -> Any:
    """A value as it is read back after being written."""
    return json.loads(json.dumps(json_safe(value)))
