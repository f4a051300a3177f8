"""Folders compared bit by bit, but for what says when and how fast they were made."""

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

LEFT_OUT = {".json": ("started", "seconds"), ".jsonl": ("seconds",), ".npz": ("seconds",), ".csv": ("seconds",)}
"""Fields of these files, at any depth, arrays and columns that are not compared."""


def content(path: Path) -> Any:
    """All of a file that has to be the same."""
    hidden = LEFT_OUT.get(path.suffix, ())
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            kept = {name: arrays[name] for name in arrays.files if name.split("/")[-1] not in hidden}
        return {name: (value.dtype.str, value.shape, value.tobytes()) for name, value in kept.items()}
    if path.suffix == ".json":
        return json.dumps(_without(json.loads(path.read_text()), hidden))
    if path.suffix == ".jsonl":
        return [json.dumps(_without(json.loads(line), hidden)) for line in path.read_text().splitlines()]
    if path.suffix == ".csv":
        rows = list(csv.DictReader(io.StringIO(path.read_text())))
        return [{name: value for name, value in row.items() if name not in hidden} for row in rows]
    if path.suffix == ".html":  # which says throughout how long everything took
        return path.read_text().rstrip().endswith("</html>")
    return path.read_bytes()


def differences(folder: Path, reference: Path) -> list[str]:
    """What differs between two folders, in words; nothing where they are the same."""
    here, there = ({str(path.relative_to(root)): path for path in files(root)} for root in (folder, reference))
    found = [f"missing: {name}" for name in sorted(there.keys() - here.keys())]
    found += [f"left over: {name}" for name in sorted(here.keys() - there.keys())]
    for name in sorted(here.keys() & there.keys()):
        try:
            same = here[name].is_dir() == there[name].is_dir()
            same = same and (here[name].is_dir() or content(here[name]) == content(there[name]))
        except Exception as error:  # a damaged file of any kind differs
            same = False
            name = f"{name} ({type(error).__name__})"
        if not same:
            found.append(f"different: {name}")
    return found


def files(folder: Path) -> list[Path]:
    """All files and folders in a folder."""
    return sorted(folder.rglob("*"))


def _without(value: Any, hidden: tuple[str, ...]) -> Any:
    if isinstance(value, dict):
        return {name: _without(item, hidden) for name, item in value.items() if name not in hidden}
    return [_without(item, hidden) for item in value] if isinstance(value, list) else value
