"""Files as they should not be: configurations, array files and tables, changed at random places."""

import io
import json
import os
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzzing.words import picked

VALUES = (
    None, True, False, 0, 1, -1, 2, 0.5, 1e308, -0.0, 10**30, float("nan"), float("inf"), "", "x", "..",
    "../../x", "[/x]",
    "/etc/passwd", "os:system", "名前", "$", "a\nb", [], {}, [[]], [None], [1], [1, 2, 3], ["a"],
    [float("nan")] * 2, {"a": 1},
    {"float": "x"}, {"float": 1}, {"array": [1], "dtype": "object"}, {"array": [1], "dtype": 7}, {"mapping": 1},
    {"mapping": [[[1], {}]]}, {"name": "edge", "hyperparameters": {}}, {"name": [], "hyperparameters": None},
    {"name": "os:system", "hyperparameters": {}}, {"array": [1.0, 2.0], "dtype": "float32"}, "\ud800", "x" * 10_000,
)  # fmt: skip
"""Values for any place of a configuration."""
UNREAD = ("versions", "platform", "command_line", "started")
"""What a configuration says for people."""
DEEP = "[" * 100_000


def places(value: Any, path: tuple = ()) -> Iterator[tuple]:
    """Where there is anything in a nested value."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, item in items:
        if name not in UNREAD:
            yield (*path, name)
            yield from places(item, (*path, name))


def json_file(rng: np.random.Generator, path: Path) -> str:
    """Change a JSON document, or a file of several lines of them; in words, how."""
    way = picked(rng, ("value",) * 8 + ("drop", "drop", "add", "cut", "text"))
    text = path.read_text()
    if way == "cut":
        path.write_text(text[: int(rng.integers(len(text)))])
        return "cut"
    if way == "text" or path.suffix != ".json":
        odd = (
            "",
            "null",
            "[]",
            "{}",
            "1",
            '"x"',
            "NaN",
            DEEP,
            '{"format": ' + DEEP,
            "9" * 10_000,
            "\ufeff" + text,
            "\0",
        )
        path.write_text(picked(rng, odd))
        return "another text"
    config = json.loads(text)
    *way_there, last = picked(rng, list(places(config)))
    holder = config
    for name in way_there:
        holder = holder[name]
    if way == "drop":
        del holder[last]
    elif way == "add":
        (config if isinstance(holder, list) else holder)["unknown"] = picked(rng, VALUES)
    else:
        holder[last] = picked(rng, VALUES)
    path.write_text(json.dumps(config))
    return f"{way} {'.'.join(map(str, (*way_there, last)))}"


class Pickled:
    """An object that would leave a file behind, were it unpickled."""

    def __reduce__(self):
        """What unpickling does."""
        return os.mkdir, ("good/unpickled",)


def header(kind: str, length: int) -> bytes:
    """The head of an .npy file of one axis."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": kind, "fortran_order": False, "shape": (length,)})
    return head.getvalue()


def bomb(path: Path, name: str) -> None:
    """An .npz of 6 MB whose one array has 6 GB of zeros."""
    block, repeats = 2**24, 384
    deflate = zlib.compressobj(9, zlib.DEFLATED, -15)
    head = header("|u1", block * repeats)
    stream = deflate.compress(head) + deflate.flush(zlib.Z_FULL_FLUSH)
    again = deflate.compress(bytes(block)) + deflate.flush(zlib.Z_FULL_FLUSH)
    stream += again * repeats + deflate.flush()
    info = zipfile.ZipInfo(f"{name}.npy")
    with zipfile.ZipFile(path, "w") as archive:  # stored, and then said to be deflated
        archive.writestr(info, stream)
        at = info.header_offset
        info.compress_type, info.file_size = zipfile.ZIP_DEFLATED, len(head) + block * repeats
    content = bytearray(path.read_bytes())
    content[at + 8 : at + 10] = zipfile.ZIP_DEFLATED.to_bytes(2, "little")
    path.write_bytes(content)


def _another(rng: np.random.Generator, way: str, array: np.ndarray) -> np.ndarray:
    """An array changed in its shape, type or values."""
    if way == "shape":
        others = (array[None], array.ravel(), array[..., None], array[:0] if array.ndim else array[None],
                  array.ravel()[:1], np.zeros(()), np.zeros((3, 0)), array[1:] if array.ndim else array[None],
                  np.concatenate([array, array]) if array.ndim else array[None])  # fmt: skip
        return picked(rng, others)
    if way == "dtype":
        kinds = ("S3", "U5", "c8", "?", "i1", "f8", "f2", "u8", "M8[s]", "i4,f4")
        return np.zeros(array.shape, picked(rng, kinds))
    if array.dtype.kind not in "fiu":
        return np.zeros_like(array)
    odd = (np.nan, np.inf, -np.inf, 1e38, -1e38, -1.0, 0.0) if array.dtype.kind == "f" else (0, 1, 100, 2**31 - 1)
    return np.where(rng.random(array.shape) < picked(rng, (0.1, 1.0)), picked(rng, odd), array).astype(array.dtype)


def array_file(rng: np.random.Generator, path: Path) -> str:
    """Change an .npz; in words, how."""
    way = picked(rng, ("cut", "flip", "shape", "shape", "dtype", "values", "values", "drop", "add", "pickle", "text",
                       "names", "link", "folder", "huge", "bomb" if rng.random() < 0.2 else "flip"))  # fmt: skip
    content = path.read_bytes()
    if way == "cut":
        path.write_bytes(content[: int(rng.integers(len(content)))])
    elif way == "flip":
        flipped = bytearray(content)
        for _ in range(int(rng.integers(1, 9))):
            flipped[int(rng.integers(len(flipped)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
    elif way == "text":
        odd = (b"", b"\0", b"PK\x03\x04", b"PK\x05\x06" + bytes(18), b"\x93NUMPY", b"1,2\n3", b"\x80\x04N.")
        path.write_bytes(picked(rng, odd))
    elif way in ("link", "folder"):
        path.unlink()
        path.symlink_to(picked(rng, ("gone", path.name, "/etc/passwd", "."))) if way == "link" else path.mkdir()
    else:
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        name = picked(rng, tuple(arrays))
        if way == "bomb":
            bomb(path, name)
        elif way == "huge":
            with zipfile.ZipFile(path, "w") as archive:
                archive.writestr(f"{name}.npy", header("<f4", 10**12))
        else:
            if way in ("shape", "dtype", "values"):
                arrays[name] = _another(rng, way, arrays[name])
            elif way == "add":
                arrays["../../unknown"] = np.zeros(3)
            elif way == "pickle":
                arrays[name] = np.array([Pickled()], object)
            else:
                array = arrays.pop(name)
                if way == "names":
                    arrays[picked(rng, ("../x", "/etc/x", "x" * 300, "", "名", "a/b"))] = array
            _save(path, arrays)
        return f"{way} {name}"
    return way


def _save(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """`numpy.savez` for any names, "file" among them."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.save(content, array)
            archive.writestr(f"{name}.npy", content.getvalue())


def table_file(rng: np.random.Generator, path: Path) -> str:
    """Change an observation's .csv; in words, how."""
    text = path.read_text()
    odd = (
        "", "\n", "#\n", "x\n", "x,y\n1\n", "1,2\n3\n", "nan\n", "inf\ninf\n", "1\n" * 5, "1,2\n" * 2, "a,1\n",
        '"1\n', "1;2\n",
        "\ufeff" + text, text * 100, "time,x\n0,1\n1,2\n", "9" * 400 + "\n", "1\0\n2\n", "x" * 200_000,
        "٣\n٤\n", "1e400\n" * 2,
        "1e38\n" * 2, "x\n" + text, text.replace("\n", "\r\n"), '1\n"' + "2" * 200_000 + "\n",
    )  # fmt: skip
    if rng.random() < 0.2:
        path.write_bytes(rng.integers(0, 256, int(rng.integers(1, 200)), np.uint8).tobytes())
        return "noise"
    index = int(rng.integers(len(odd)))
    path.write_text(odd[index])
    return f"table {index}"


def damaged(rng: np.random.Generator, path: Path) -> str:
    """Change a file of any of these kinds; in words, which and how."""
    change = {".npz": array_file, ".csv": table_file}.get(path.suffix, json_file)
    return f"{path.parent.name}/{path.name}: {change(rng, path)}"
