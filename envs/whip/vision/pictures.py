"""A data set of pictures: a folder of PNG files, and an index of them.

pictures.json                  what the folder holds: schema, version, size, names of the labels, where it comes from
index.jsonl                    one line per picture: its file, that of its labels, and what else is known of it
000000.png 000000_labels.png   a picture, and the label of each of its pixels as a shade of grey, 0 to 7

A folder is whole once `pictures.json` counts the lines of its index.
"""

import dataclasses
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from jaxlfi.envs.whip.frames import COLOURS
from jaxlfi.io import files
from jaxlfi.io.formats import require_version

SCHEMA, VERSION = "jaxlfi-whip-pictures", 1
LABELS = ("background", *COLOURS, "dlo")
"""Names of the labels 0 to 7."""
SIZE = 256
"""Side of pictures, in pixels (section VI-C)."""
HEADER, INDEX = "pictures.json", "index.jsonl"
ENTRY = ("picture", "labels", "source")
"""What every line of an index has. Lines of simulated scenes have `grip`, `keypoints` and `scene`, too."""


class PicturesError(ValueError):
    """A folder of pictures that is not there, not whole or damaged."""


@dataclasses.dataclass(frozen=True)
class Pictures:
    """A data set in memory.

    Attributes:
        rgb: the pictures, shape [N, size, size, 3].
        labels: of their pixels, shape [N, size, size].
        entries: their lines in the index.
        header: what is said of the folder.
    """

    rgb: UInt8[np.ndarray, "n size size 3"]
    labels: UInt8[np.ndarray, "n size size"]
    entries: tuple[Mapping[str, Any], ...]
    header: Mapping[str, Any]


def begun(folder: Path, header: Mapping[str, Any]) -> int:
    """Begin a folder, or go on with one that was interrupted; returns how many pictures it has.

    Args:
        folder: of the data set.
        header: where its pictures come from; it is kept, and has to be the same when it goes on.

    Raises:
        PicturesError: if there is something else, or a whole data set.
    """
    wanted = {"schema": SCHEMA, "version": VERSION, "size": SIZE, "labels": list(LABELS), **header}
    if folder.exists() and not folder.is_dir():
        raise PicturesError(f"out: expected a new folder, got {folder}, which is a file")
    # A process killed at its start leaves part of its first file.
    if not folder.exists() or all(path.suffix == ".part" for path in folder.iterdir()):
        folder.mkdir(parents=True, exist_ok=True)
        files.write_json(folder / HEADER, {**wanted, "count": None})
        (folder / INDEX).touch()
        return 0
    found = _header(folder)
    if found.pop("count") is not None:
        raise PicturesError(f"out: expected a new folder, got {folder}, which contains a complete data set")
    if found != json.loads(json.dumps(wanted)):
        raise PicturesError(f"out: expected a new folder, or one begun by the same command, got {folder}")
    return files.keep_lines(folder / INDEX, 10**9)


def add(
    folder: Path, number: int, rgb: UInt8[np.ndarray, "size size 3"], labels: UInt8[np.ndarray, "size size"], **entry
) -> None:
    """Write a picture with its labels, and then its line in the index.

    Args:
        folder: that was begun.
        number: of the picture.
        rgb: its colours.
        labels: of its pixels.
        **entry: what else the index is to say: `source`, and what is known of the scene.
    """
    names = f"{number:06d}.png", f"{number:06d}_labels.png"
    for name, image in zip(names, (rgb, labels), strict=True):
        Image.fromarray(np.asarray(image, np.uint8)).save(folder / name)
    line = {"picture": names[0], "labels": names[1], **entry}
    files.append_line(folder / INDEX, files.json_line(line))


def finish(folder: Path) -> int:
    """Say that all pictures are there; returns their number."""
    count = len((folder / INDEX).read_text().splitlines())
    files.write_json(folder / HEADER, {**_header(folder), "count": count})
    return count


def read(folder: Path) -> Pictures:
    """A whole data set.

    Raises:
        PicturesError: for a folder without one, of another version, or whose files are missing or damaged, naming the
            first of them.
    """
    header = check(folder)
    try:
        lines = (folder / INDEX).read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise PicturesError(f"{folder / INDEX}: expected a text file, got a missing or damaged one") from error
    if len(lines) != header["count"] or not lines:
        raise PicturesError(f"{folder / INDEX}: expected {header['count']} lines, got {len(lines)}")
    entries = tuple(_entry(folder, number, line) for number, line in enumerate(lines, start=1))
    return Pictures(
        rgb=np.stack([_image(folder / entry["picture"], (SIZE, SIZE, 3)) for entry in entries]),
        labels=np.stack([_labels(folder / entry["labels"]) for entry in entries]),
        entries=entries,
        header=header,
    )


def check(folder: Path) -> Mapping[str, Any]:
    """The description of a folder.

    Raises:
        PicturesError: where it does not hold a whole data set.
    """
    header = _header(folder)
    if header["count"] is None:
        raise PicturesError(f"{folder}: expected a complete data set, got one that was interrupted: repeat its command")
    return header


def together(sets: Iterable[Pictures]) -> Pictures:
    """Several data sets as one; what is said of the folders is that of the first."""
    sets = list(sets)
    return Pictures(
        np.concatenate([one.rgb for one in sets]),
        np.concatenate([one.labels for one in sets]),
        tuple(entry for one in sets for entry in one.entries),
        sets[0].header,
    )


def _header(folder: Path) -> dict[str, Any]:
    try:
        header = json.loads((folder / HEADER).read_text())
    except (OSError, RecursionError, ValueError) as error:
        raise PicturesError(f"expected a folder of pictures, got {folder}, without a readable {HEADER}") from error
    if not isinstance(header, dict) or header.get("schema") != SCHEMA or "count" not in header:
        raise PicturesError(f"{folder / HEADER}: expected the schema {SCHEMA!r}, got another kind of file")
    try:
        require_version(folder / HEADER, SCHEMA, VERSION, header.get("version"))
    except ValueError as error:
        raise PicturesError(str(error)) from error
    for name, expected in (("size", SIZE), ("labels", list(LABELS))):
        if header.get(name) != expected:
            raise PicturesError(f"{folder / HEADER}: {name}: expected {expected}, got {header.get(name)}")
    return header


def _entry(folder: Path, number: int, line: str) -> Mapping[str, Any]:
    try:
        entry = json.loads(line)
    except (RecursionError, ValueError):
        entry = None
    if not isinstance(entry, dict) or not all(isinstance(entry.get(name), str) for name in ENTRY):
        raise PicturesError(f"{folder / INDEX}, line {number}: expected {', '.join(ENTRY)}, got {line[:60]!r}")
    for name in ENTRY[:2]:
        if Path(entry[name]).name != entry[name]:
            raise PicturesError(f"{folder / INDEX}, line {number}: {name}: expected a file's name, got {entry[name]!r}")
    return entry


def _image(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    try:
        with Image.open(path) as image:
            array = np.asarray(image)
    # Pillow raises each of them for damaged files.
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise PicturesError(f"{path}: expected a complete PNG file, got a missing or damaged one") from error
    if array.shape != shape or array.dtype != np.uint8:
        raise PicturesError(f"{path}: expected {' x '.join(map(str, shape))} bytes, got {array.shape} of {array.dtype}")
    return array


def _labels(path: Path) -> np.ndarray:
    labels = _image(path, (SIZE, SIZE))
    if labels.max() >= len(LABELS):
        raise PicturesError(f"{path}: expected labels from 0 to {len(LABELS) - 1}, got {labels.max()}")
    return labels
