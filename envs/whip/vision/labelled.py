"""Data sets of photographs, from what labelling tools export: COCO instance segmentation, and YOLO segmentation.

Classes are called red, green, blue, orange, purple, yellow and dlo, in any case, with or without " cube", "_cube" or
"-cube" at the end. Other names are mapped to these, or to "background", whose shapes are left out.

Photographs are turned upright by their EXIF orientation, and lose their transparency. Where they are not square, the
square in their middle is kept. It is resized to 256 x 256 pixels: each is the mean of what it covers where the
photograph is larger, and interpolated linearly where it is smaller. Labels are drawn in the photograph's own
resolution, larger shapes first, and of equal ones the earlier first; each of the 256 x 256 pixels has the label at its
centre (nearest neighbour). A pixel belongs to a polygon if its centre is inside.
"""

import dataclasses
import functools
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageOps

from jaxlfi.envs.whip.vision import pictures
from jaxlfi.envs.whip.vision.pictures import LABELS, SIZE

SUFFIXES = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
"""How names of pictures end, in any case, where the export does not list them (YOLO)."""
CLASSES = "classes.txt"
"""What tools write beside the labels of YOLO."""
KNOWN = f"one of {', '.join(LABELS)}"

OnPicture = Callable[[int, int], Any]
"""Called after each picture with the number of pictures done, and the number of all."""


def _no_progress(done: int, count: int) -> None:
    """Progress is not reported."""


@dataclasses.dataclass(frozen=True)
class _Shape:
    """A label, and the function that draws its mask in a picture of some height and width."""

    label: int
    mask: Callable[[int, int], Bool[np.ndarray, "height width"]]


@dataclasses.dataclass(frozen=True)
class _Photograph:
    """Where a picture is, its name in the folder of the pictures, and what is to be seen in it."""

    path: Path
    name: str
    shapes: tuple[_Shape, ...]


def from_coco(
    annotations: Path, images: Path, out: Path, names: Mapping[str, str] = {}, on_picture: OnPicture = _no_progress
) -> int:
    """Make a data set of photographs from COCO instance segmentation; returns the number of its pictures.

    Segmentations are polygons, with coordinates in pixels from the picture's upper left corner, or run lengths (RLE),
    compressed or not. Several polygons of an annotation are one shape. How pictures are cropped and resized is said
    above. All files are checked before the folder is begun; one that was interrupted goes on by the same call.

    Args:
        annotations: the JSON file, with `images`, `annotations` and `categories`.
        images: folder that the `file_name`s are relative to.
        out: a new folder.
        names: names of categories to those of labels, or to "background".
        on_picture: called after each picture.

    Raises:
        ValueError: for files that are missing or damaged, names that are not known, and annotations that do not fit
            their picture, naming the file or the annotation.
    """
    document = _document(annotations)
    entries = _by_id(document["images"], f"{annotations}: images")
    if not entries:
        raise ValueError(f"{annotations}: expected pictures, got none")
    labels = _category_labels(document, names, annotations)
    files = {key: _relative(entry.get("file_name"), f"{annotations}: image {key}") for key, entry in entries.items()}
    sizes = {key: _declared_size(images / files[key], entry) for key, entry in entries.items()}
    shapes: dict[Any, list[_Shape]] = {key: [] for key in entries}
    for annotation in document["annotations"]:
        where, key = _where(annotations, annotation), annotation.get("image_id")
        if not _is_id(key) or key not in entries:
            raise ValueError(f"{where}: image_id: expected one of the images, got {_shown(key)}")
        if label := labels[annotation["category_id"]]:
            shapes[key].append(_Shape(label, _coco_mask(annotation.get("segmentation"), sizes[key], where)))
    photographs = [_Photograph(images / files[key], files[key], tuple(shapes[key])) for key in entries]
    made = {"format": "COCO", "annotations": annotations.name, "names": dict(names)}
    return _write(out, made, photographs, on_picture)


def from_yolo(
    labels: Path,
    images: Path,
    out: Path,
    classes: Sequence[str],
    names: Mapping[str, str] = {},
    on_picture: OnPicture = _no_progress,
) -> int:
    """Make a data set of photographs from YOLO segmentation; returns the number of its pictures.

    Lines are "class x1 y1 x2 y2 ...": the number of a class from 0, and a polygon's points, from 0 to 1 of the
    picture's width and height, from its upper left corner. A picture whose file is empty or missing has nothing in it.
    How pictures are cropped and resized is said above. All files are checked before the folder is begun; one that was
    interrupted goes on by the same call.

    Args:
        labels: folder of a NAME.txt for each picture NAME.jpg, NAME.png, ...; its sub-folders are those of `images`.
        images: folder of the pictures.
        out: a new folder.
        classes: names of the classes, in order.
        names: names of classes to those of labels, or to "background".
        on_picture: called after each picture.

    Raises:
        ValueError: for files that are missing or damaged, names that are not known, and lines that are not shapes,
            naming the file and the line.
    """
    objects = {path: _objects(text, classes) for path, text in _paired(labels, images).items()}
    label_of = _labels_of((name for several in objects.values() for _, name, _ in several), names)
    photographs = []
    for path, several in objects.items():
        size, shapes = _upright(path).size, []
        for where, name, numbers in several:
            if label := label_of[name]:
                outline = _outline(numbers, (1, 1), where) * size
                shapes.append(_Shape(label, functools.partial(_filled, (outline,))))
        photographs.append(_Photograph(path, path.relative_to(images).as_posix(), tuple(shapes)))
    return _write(out, {"format": "YOLO", "classes": list(classes), "names": dict(names)}, photographs, on_picture)


def read_classes(path: Path) -> list[str]:
    """Names of classes in order: a text file of one a line, or the `names` of a data.yaml.

    Of YAML, it knows `names` as [a list, in brackets], as a list of lines "- name", and as lines "number: name" (or
    {number: name}) with the numbers from 0; anchors, escapes and whatever else is refused.

    Raises:
        ValueError: for a file that is missing, or another.
    """
    text = _text(path, "a file of names of classes")
    if path.suffix.lower() in (".yaml", ".yml"):
        classes = _yaml_names(text, path)
    elif path.suffix.lower() in (".txt", ".names", ""):
        classes = [line.strip() for line in text.rstrip().splitlines()]
    else:
        raise ValueError(f"{path}: expected a text file (.txt) or a data.yaml, got another")
    if not classes or not all(classes):
        raise ValueError(
            f"{path}: expected the name of a class in each line, got {'an empty' if classes else 'no'} line"
        )
    return classes


def _write(out: Path, made: Mapping[str, Any], photographs: Sequence[_Photograph], on_picture: OnPicture) -> int:
    begun = pictures.begun(out, {"made": {**made, "pictures": len(photographs)}})
    for number, photograph in enumerate(photographs[begun:], start=begun):
        image = _upright(photograph.path)
        labels = _drawn(photograph.shapes, *image.size)
        pictures.add(out, number, _resized(image), labels, source="photograph", file=photograph.name)
        on_picture(number + 1, len(photographs))
    return pictures.finish(out)


def _upright(path: Path) -> Image.Image:
    """A picture as people see it, in red, green and blue."""
    try:
        with Image.open(path) as file:
            image = ImageOps.exif_transpose(file)
    except FileNotFoundError as error:
        raise ValueError(f"{path}: expected a picture, got no file") from error
    except Exception as error:  # Pillow, zlib and the operating system each raise their own
        raise ValueError(f"{path}: expected a picture, got a file that is damaged or of an unknown format") from error
    if image.mode.startswith(("I", "F")):
        raise ValueError(f"{path}: expected a picture of 8 bits a channel, got Pillow's mode {image.mode}")
    return image.convert("RGBA").convert("RGB") if image.mode == "P" else image.convert("RGB")


def _square(width: int, height: int) -> tuple[int, int, int]:
    """Left and upper edge of the square in the middle, and its side."""
    side = min(width, height)
    return (width - side) // 2, (height - side) // 2, side


def _resized(image: Image.Image) -> UInt8[np.ndarray, "size size 3"]:
    left, top, side = _square(*image.size)
    square = image.crop((left, top, left + side, top + side))
    return np.asarray(square.resize((SIZE, SIZE), Image.Resampling.BOX if side > SIZE else Image.Resampling.BILINEAR))


def _drawn(shapes: Iterable[_Shape], width: int, height: int) -> UInt8[np.ndarray, "size size"]:
    left, top, side = _square(width, height)
    centres = (2 * np.arange(SIZE) + 1) * side // (2 * SIZE)
    drawn = []
    for shape in shapes:
        mask = shape.mask(height, width)
        drawn.append((np.count_nonzero(mask), mask[np.ix_(top + centres, left + centres)], shape.label))
    labels = np.zeros((SIZE, SIZE), np.uint8)
    for _, mask, label in sorted(drawn, key=lambda one: -one[0]):
        labels[mask] = label
    return labels


def _filled(
    outlines: Iterable[Float[np.ndarray, "points 2"]], height: int, width: int
) -> Bool[np.ndarray, "height width"]:
    """Pixels whose centre is inside a polygon: those with an odd number of its edges to their left."""
    mask = np.zeros((height, width), bool)
    for outline in outlines:
        crossings = np.zeros((height, width + 1), bool)
        for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
            rows = np.arange(*np.clip(np.ceil(np.sort([y0, y1]) - 0.5), 0, height), dtype=int)
            x = x0 + (rows + 0.5 - y0) * (x1 - x0) / (y1 - y0) if y0 != y1 else rows
            crossings[rows, np.clip(np.ceil(x - 0.5), 0, width).astype(int)] ^= True
        mask |= np.logical_xor.accumulate(crossings, axis=1)[:, :width]
    return mask


def _unrolled(counts: Sequence[int], height: int, width: int) -> Bool[np.ndarray, "height width"]:
    """The mask of run lengths down the columns, from the left one; the first is outside."""
    return np.repeat(np.arange(len(counts)) % 2 == 1, counts).reshape(width, height).T


def _outline(numbers: Sequence[Any], extent: tuple[int, int], where: str) -> Float[np.ndarray, "points 2"]:
    """A polygon's points of x1, y1, x2, y2, ...; the extent is what the picture's width and height are in its unit."""
    if len(numbers) % 2 or len(numbers) < 6:
        raise ValueError(
            f"{where}: expected x and y of at least 3 points (boxes are not masks), got {len(numbers)} numbers"
        )
    for number, limit in zip(numbers, extent * (len(numbers) // 2), strict=True):
        if type(number) not in (int, float) or not -limit <= number <= 2 * limit:  # also refuses NaN
            raise ValueError(f"{where}: expected a number from 0 to about {limit}, got {_shown(number)}")
    return np.asarray(numbers, float).reshape(-1, 2)


def _document(path: Path) -> dict[str, list[dict[str, Any]]]:
    text = _text(path, "a COCO file")
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: expected a COCO file, got no valid JSON") from error
    for name in ("images", "annotations", "categories"):
        entries = document.get(name) if isinstance(document, dict) else None
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise ValueError(f"{path}: expected a COCO file, got no list {name!r} of objects")
    return document


def _is_id(value: Any) -> bool:
    return isinstance(value, (int, str))


def _by_id(entries: Iterable[dict[str, Any]], where: str) -> dict[int | str, dict[str, Any]]:
    found = {}
    for entry in entries:
        key = entry.get("id")
        if not _is_id(key) or key in found:
            raise ValueError(f"{where}: expected an id of its own for each, got {_shown(key)}")
        found[key] = entry
    return found


def _category_labels(document: Mapping[str, Any], names: Mapping[str, str], path: Path) -> dict[int | str, int]:
    """Labels of the categories that annotations have."""
    categories, used = _by_id(document["categories"], f"{path}: categories"), {}
    for annotation in document["annotations"]:
        key = annotation.get("category_id")
        if not _is_id(key) or key not in categories:
            raise ValueError(
                f"{_where(path, annotation)}: category_id: expected one of the categories, got {_shown(key)}"
            )
        used[key] = categories[key].get("name")
        if not isinstance(used[key], str):
            raise ValueError(f"{path}: category {key}: name: expected a string, got {_shown(used[key])}")
    labels = _labels_of(used.values(), names)
    return {key: labels[name] for key, name in used.items()}


def _relative(name: Any, where: str) -> str:
    """The name of a file in a folder, and not outside."""
    if not isinstance(name, str) or not name or Path(name).anchor or ".." in Path(name).parts:
        raise ValueError(f"{where}: file_name: expected a file in the folder of the images, got {_shown(name)}")
    return name


def _declared_size(path: Path, entry: Mapping[str, Any]) -> tuple[int, int]:
    """Width and height of a picture, which are those of its entry where it has any."""
    size = _upright(path).size
    for name, expected in zip(("width", "height"), size, strict=True):
        if entry.get(name) not in (None, expected):
            got = _shown(entry[name])
            raise ValueError(f"{path}: {name}: expected {expected}, as the picture has upright, got {got} in its entry")
    return size


def _coco_mask(segmentation: Any, size: tuple[int, int], where: str) -> Callable[[int, int], np.ndarray]:
    if isinstance(segmentation, dict):
        return functools.partial(_unrolled, _counts(segmentation, size, where))
    if not isinstance(segmentation, list) or not segmentation or not all(isinstance(one, list) for one in segmentation):
        raise ValueError(f"{where}: segmentation: expected polygons or run lengths, got {_shown(segmentation)}")
    return functools.partial(_filled, [_outline(one, size, f"{where}: segmentation") for one in segmentation])


def _counts(run_lengths: Mapping[str, Any], size: tuple[int, int], where: str) -> list[int]:
    """Lengths of the runs of an RLE, checked."""
    width, height = size
    if run_lengths.get("size") != [height, width]:
        got = _shown(run_lengths.get("size"))
        raise ValueError(f"{where}: size: expected the picture's, [{height}, {width}], got {got}")
    counts = run_lengths.get("counts")
    if isinstance(counts, str):
        counts = _decoded(counts, where)
    if not isinstance(counts, list) or not all(type(count) is int and count >= 0 for count in counts):
        raise ValueError(f"{where}: counts: expected lengths of runs, got {_shown(counts)}")
    if sum(counts) != height * width:
        raise ValueError(f"{where}: counts: expected {height * width} pixels in all, got {_shown(sum(counts))}")
    return counts


def _decoded(text: str, where: str) -> list[int]:
    """Lengths of runs of their compressed form.

    Numbers are groups of five bits, the lowest first, each as the character of code 48 more; 32 is added to all but the
    last group, whose highest bit is the sign. From the fourth on, they are differences to the last but one.
    """
    counts: list[int] = []
    value = bits = 0
    for character in text:
        group = ord(character) - 48
        if not 0 <= group < 64 or bits > 60:
            raise ValueError(f"{where}: counts: expected compressed run lengths, got {_shown(text)}")
        value |= (group & 31) << bits
        bits += 5
        if not group & 32:
            value -= (group >> 4) << bits
            counts.append(value + counts[-2] if len(counts) > 2 else value)
            value = bits = 0
    if bits:
        raise ValueError(f"{where}: counts: expected compressed run lengths, got {_shown(text)}, which is cut off")
    return counts


def _paired(labels: Path, images: Path) -> dict[Path, Path]:
    """The pictures of a folder, and where their labels are if they have any."""
    for name, folder in (("labels", labels), ("images", images)):
        if not folder.is_dir():
            raise ValueError(f"{name}: expected a folder, got {folder}")
    found: dict[Path, Path] = {}
    for path in sorted(images.rglob("*")):
        if path.suffix.lower() in SUFFIXES and not path.name.startswith("."):
            found[path] = (labels / path.relative_to(images)).with_suffix(".txt")
    if not found:
        raise ValueError(f"images: expected pictures ({', '.join(SUFFIXES)}), got none in {images}")
    if len(set(found.values())) < len(found):
        texts = list(found.values())
        twice = next(text for text in texts if texts.count(text) > 1)
        raise ValueError(f"{twice}: expected one picture of this name in {images}, got several")
    written = {path for path in labels.rglob("*.txt") if path.name != CLASSES}
    if written and written.isdisjoint(found.values()):
        raise ValueError(
            f"labels: expected NAME.txt for pictures in {images}, got {min(written)} and others of no picture"
        )
    return found


def _objects(path: Path, classes: Sequence[str]) -> list[tuple[str, str, list[float]]]:
    """The lines of a file of YOLO, which may be missing: where they are, the class's name, and the coordinates."""
    numbered = {str(number): name for number, name in enumerate(classes)}
    objects = []
    for number, line in enumerate(_text(path, "labels").splitlines() if path.exists() else [], start=1):
        where, words = f"{path}, line {number}", line.split()
        if not words:
            continue
        if words[0] not in numbered:
            raise ValueError(f"{where}: expected a class from 0 to {len(classes) - 1}, got {_shown(words[0])}")
        try:
            objects.append((where, numbered[words[0]], [float(word) for word in words[1:]]))
        except ValueError as error:
            raise ValueError(f"{where}: expected numbers, got {_shown(line)}") from error
    return objects


def _labels_of(used: Iterable[str], names: Mapping[str, str]) -> dict[str, int]:
    """Labels of names of classes."""
    mapped = {}
    for name, label in names.items():
        if _own(label) is None:
            raise ValueError(f"names: expected {KNOWN} for {name!r}, got {label!r}")
        mapped[name.strip().casefold()] = _own(label)
    labels = {name: mapped.get(name.strip().casefold(), _own(name)) for name in used}
    if unknown := [repr(name) for name, label in labels.items() if label is None]:
        raise ValueError(
            f"classes: expected {KNOWN}, or names that are mapped to these (--name {unknown[0]}=dlo, or =background to "
            f"leave them out), got {', '.join(unknown)}"
        )
    return labels


def _own(name: str) -> int | None:
    """The label that a name stands for by itself, if any."""
    plain = re.sub(r"[ _-]cube$", "", name.strip().casefold())
    return LABELS.index(plain) if plain in LABELS else None


def _yaml_names(text: str, path: Path) -> list[str]:
    text = "\n".join(re.sub(r"(^|\s)#.*", "", line) for line in text.splitlines())
    found = re.findall(r"^names[ \t]*:(?!\S)(.*?)(?=^[^\s\-\]}]|\Z)", text, re.MULTILINE | re.DOTALL)
    if len(found) != 1:
        raise ValueError(f"{path}: expected `names:` once, got it {len(found)} times")
    body = found[0].strip()
    if body[:1] + body[-1:] in ("[]", "{}"):
        items = body[1:-1].strip().removesuffix(",").split(",")
    else:
        items = [line for line in body.splitlines() if line.strip()]
    scalar = r"""(?P<name>'[^'\\]*'|"[^"\\]*"|\w[^'"\[\]{},:\\\n]*)"""
    form = {"[": scalar, "-": rf"-\s+{scalar}"}.get(body[:1], rf"(?P<number>\d+)\s*:\s+{scalar}")
    matches = [re.fullmatch(form, item.strip()) for item in items]
    for item, match in zip(items, matches, strict=True):
        if match is None:
            raise ValueError(
                f"{path}: names: expected [names], lines '- name' or lines 'number: name', got {_shown(item)}"
            )
    if body[:1] not in ("[", "-"):
        matches.sort(key=lambda match: int(match["number"]))
        if [int(match["number"]) for match in matches] != list(range(len(matches))):
            raise ValueError(f"{path}: names: expected the numbers 0 to {len(matches) - 1}, got others")
    return [match["name"].strip("'\"").strip() for match in matches]


def _text(path: Path, what: str) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: expected {what}, got a file that is missing or no text") from error


def _where(path: Path, annotation: Mapping[str, Any]) -> str:
    return f"{path}: annotation {_shown(annotation.get('id'))}"


def _shown(value: Any) -> str:
    """What was got, if it is not too long."""
    shown = repr(value)
    return shown if len(shown) <= 60 else f"{shown[:57]}..."
