"""Writing files so that a reader, or a process killed at any moment, only ever leaves or sees whole ones."""

import contextlib
import io
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.io.serialise import json_safe


def write_bytes(path: Path, content: bytes, durable: bool = False) -> None:
    """Write a temporary file in the same folder, then move it into place; nothing of it is left where that fails.

    Args:
        path: where to.
        content: all of it.
        durable: wait until it is on the disk, so that it also outlives a loss of power.
    """
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            file.write(content)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        part.replace(path)
    except OSError:  # a full disk is not made fuller
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise
    if durable:
        flush(path.parent)


def flush(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk, where the file system can say so."""
    with contextlib.suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def write_json(path: Path, value: Any) -> None:
    """One indented JSON document; NaN becomes null."""
    write_bytes(path, (json.dumps(json_safe(value), indent=2, allow_nan=False) + "\n").encode(), durable=True)


def json_line(value: Any) -> str:
    """One JSON object as a line; NaN becomes null."""
    return json.dumps(json_safe(value), allow_nan=False) + "\n"


def append_line(path: Path, line: str) -> None:
    """Add a line to a file. A process killed meanwhile leaves part of it, which `keep_lines` removes."""
    with path.open("a", encoding="utf-8") as file:
        file.write(line)


def keep_lines(path: Path, count: int) -> int:
    """Cut a file of lines down to its first `count` whole ones, where it exists; returns how many it has now."""
    content = path.read_bytes() if path.exists() else b""
    lines = [line for line in content.splitlines(keepends=True)[:count] if line.endswith(b"\n")]
    if content:
        os.truncate(path, sum(map(len, lines)))
    return len(lines)


def write_arrays(path: Path, arrays: Mapping[str, Any], compress: bool = True, durable: bool = False) -> None:
    """Named arrays as .npz: no pickles, and a checksum on each array."""
    plain = {name: np.asarray(value) for name, value in arrays.items()}
    if objects := [name for name, value in plain.items() if value.dtype.hasobject]:
        raise TypeError(f"expected arrays of numbers or strings, got Python objects in {objects}")
    buffer = io.BytesIO()
    (np.savez_compressed if compress else np.savez)(buffer, **plain)
    write_bytes(path, buffer.getvalue(), durable)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an .npz, each verified by its checksum.

    Raises:
        ValueError: for a file that is missing, damaged, or something else.
    """
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except Exception as error:  # zipfile, zlib, numpy and the operating system each have their own for a damaged file
        raise ValueError(f"{path}: expected a whole .npz file, got a missing or damaged one") from error
