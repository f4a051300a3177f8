"""Files of which a process killed at any moment leaves, and a reader sees, only whole ones."""

import contextlib
import io
import json
import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.io.serialise import json_safe

LARGE, DENSE = 2**30, 100
"""Number of bytes that any file may unpack to, and how many times its own size a larger file may unpack to."""
KINDS = "biufSU"
"""Kinds of arrays that files may hold: booleans, integers, reals and texts."""
SEAL = "seal"
"""Name of the array that shows whether the others are unchanged."""


def write_bytes(path: Path, content: bytes, durable: bool = False) -> None:
    """Write a temporary file in the same folder, then move it into place; nothing of it is left if that fails.

    Args:
        path: the file to write.
        content: its whole content.
        durable: wait until it is on the disk, so that it also survives a loss of power.
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
    """Wait until a file, or the names in a folder, are on the disk, if the file system supports that."""
    with contextlib.suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def write_json(path: Path, value: Any) -> None:
    """Write one indented JSON document; NaN becomes null."""
    write_bytes(path, (json.dumps(json_safe(value), indent=2, allow_nan=False) + "\n").encode(), durable=True)


def read_json(path: Path) -> Any:
    """Read one JSON document.

    Raises:
        ValueError: for a file that is missing or damaged, or nested too deeply to be read.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: expected JSON, got a missing or damaged file: {first_line(error)}") from error


def first_line(error: Exception) -> str:
    """The first line of an error's message; the name of its class if there is none."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def json_line(value: Any) -> str:
    """One JSON object as a line; NaN becomes null."""
    return json.dumps(json_safe(value), allow_nan=False) + "\n"


def append_line(path: Path, line: str) -> None:
    """Add a line to a file. A process killed meanwhile leaves part of it, which `keep_lines` removes."""
    with path.open("a", encoding="utf-8") as file:
        file.write(line)


def keep_lines(path: Path, count: int) -> int:
    """Cut a file, if it exists, down to its first `count` whole lines; returns how many it has now."""
    content = path.read_bytes() if path.exists() else b""
    lines = [line for line in content.splitlines(keepends=True)[:count] if line.endswith(b"\n")]
    if content:
        os.truncate(path, sum(map(len, lines)))
    return len(lines)


def write_arrays(path: Path, arrays: Mapping[str, Any], compress: bool = True, durable: bool = False) -> None:
    """Write named arrays as .npz, without pickles and with a checksum on each array."""
    plain = {name: np.asarray(value) for name, value in arrays.items()}
    if objects := [name for name, value in plain.items() if value.dtype.hasobject]:
        raise TypeError(f"expected arrays of numbers or strings, got Python objects in {objects}")
    buffer = io.BytesIO()
    write: Any = np.savez_compressed if compress else np.savez
    write(buffer, **plain)
    write_bytes(path, buffer.getvalue(), durable)


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays of an .npz file, each verified by its checksum.

    Raises:
        ValueError: for a file that is missing, damaged, or something else.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked, packed = sum(member.file_size for member in archive.infolist()), path.stat().st_size
        if unpacked <= max(LARGE, DENSE * packed):
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
    except Exception as error:  # zipfile, zlib, numpy and the operating system each raise their own for a damaged file
        raise ValueError(f"{path}: expected a complete .npz file, got a missing or damaged one") from error
    if unpacked > max(LARGE, DENSE * packed):
        raise ValueError(f"{path}: expected arrays, got {packed} bytes that unpack to {unpacked / 2**30:.3g} GiB")
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray) or array.dtype.kind not in KINDS:
            raise ValueError(f"{path}: expected numbers or texts, got {getattr(array, 'dtype', 'none')} as {name}")
    return arrays


def write_sealed(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write named arrays as .npz for `read_sealed` only: uncompressed, durable, and sealed against changes."""
    plain = {name: np.asarray(value) for name, value in arrays.items()}
    write_arrays(path, plain | {SEAL: _seal(plain)}, compress=False, durable=True)


def read_sealed(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays that `write_sealed` wrote.

    Raises:
        ValueError: for a file that is missing, damaged or changed.
    """
    arrays = read_arrays(path)
    seal = arrays.pop(SEAL, None)
    expected = _seal(arrays)
    if seal is None or seal.dtype != expected.dtype or not np.array_equal(seal, expected):
        raise ValueError(f"{path}: expected the arrays as they were written, got others")
    return arrays


def _seal(arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """A checksum of names, types, shapes and numbers, independent of the order of the names."""
    parts = [
        [name, array.dtype.str, array.shape, zlib.crc32(np.ascontiguousarray(array).tobytes())]
        for name, array in sorted(arrays.items())
    ]
    return np.asarray(zlib.crc32(json.dumps(parts).encode()), np.uint32)
