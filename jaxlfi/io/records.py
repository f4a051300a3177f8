"""Records in a file or a pipe, one after another, each a line of JSON and the bytes of one array.

Nothing is unpickled, and a file left by a killed process is read up to its last whole record.
"""

import json
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

KINDS = "biuf"
"""Kinds of numbers that an array may hold: booleans, integers and reals."""


def encoded(fields: Mapping[str, Any], array: np.ndarray) -> bytes:
    """Encode one record.

    Args:
        fields: JSON values by name.
        array: array of numbers.

    Example:
        >>> import io
        >>> read(io.BytesIO(encoded({"index": 3}, np.zeros(2))))
        ({'index': 3}, array([0., 0.]))
    """
    content = np.ascontiguousarray(array).tobytes()
    head = {"dtype": array.dtype.str, "shape": list(array.shape), "crc32": zlib.crc32(content)}
    return json.dumps({"array": head, **fields}).encode() + b"\n" + content


def read(stream: BinaryIO) -> tuple[dict[str, Any], np.ndarray] | None:
    """The next record's fields and array; None at the end, or if the rest is no whole record."""
    try:
        fields = json.loads(stream.readline())
        head = fields.pop("array")
        kind, shape = np.dtype(head["dtype"]), tuple(head["shape"])
        content = stream.read(kind.itemsize * int(np.prod(shape, dtype=int)))
        if kind.kind not in KINDS or zlib.crc32(content) != head["crc32"]:
            return None
        return fields, np.frombuffer(content, kind).reshape(shape).copy()
    except (ValueError, KeyError, TypeError, AttributeError, OSError):
        return None


def whole(path: Path) -> list[tuple[dict[str, Any], np.ndarray]]:
    """All records of a file; what follows the last whole one is cut off, so that more can be added."""
    found, end = [], 0
    with path.open("rb") as file:
        while (record := read(file)) is not None:
            found.append(record)
            end = file.tell()
    os.truncate(path, end)
    return found
