"""Writing files so that a reader, or a process killed at any moment, only ever leaves or sees whole ones."""

import io
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.io.serialise import json_safe


def write_bytes(path: Path, content: bytes, durable: bool = False) -> None:
    """Write beside the file, then move into its place.

    Args:
        path: where to.
        content: all of it.
        durable: wait until it is on the disk, so that it also outlives a loss of power.
    """
    beside = path.with_name(path.name + ".part")
    with beside.open("wb") as file:
        file.write(content)
        if durable:
            file.flush()
            os.fsync(file.fileno())
    beside.replace(path)


def write_json(path: Path, value: Any) -> None:
    """One indented JSON document; NaN becomes null."""
    write_bytes(path, (json.dumps(json_safe(value), indent=2, allow_nan=False) + "\n").encode(), durable=True)


def write_json_lines(path: Path, values: list[Any]) -> None:
    """One JSON object a line; NaN becomes null."""
    lines = [json.dumps(json_safe(value), allow_nan=False) + "\n" for value in values]
    write_bytes(path, "".join(lines).encode())


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
