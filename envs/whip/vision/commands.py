"""The commands of vision, whose arguments `jaxlfi.envs.whip.vision.options` describes."""

import argparse
import contextlib
import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from jaxlfi.cli import tables
from jaxlfi.envs.whip import recording as recordings
from jaxlfi.envs.whip.exploration import exploratory_actions
from jaxlfi.envs.whip.physics.engines import pick as pick_engine
from jaxlfi.envs.whip.reference_objects import objects, repetitions
from jaxlfi.envs.whip.reference_objects.observation import Perception, record
from jaxlfi.envs.whip.reference_objects.simulation import ReferenceRig
from jaxlfi.envs.whip.vision import detectors, export, labelled, making, pictures, scenes, scores, training, weights
from jaxlfi.envs.whip.vision.making import Asked
from jaxlfi.envs.whip.vision.options import FORMATS
from jaxlfi.envs.whip.vision.photographer import Photographer
from jaxlfi.envs.whip.vision.renderers import RENDERERS
from jaxlfi.io import files
from jaxlfi.io.provenance import environment

HELD_OUT_PICTURES, HELD_OUT_ROLLOUTS = 200, 100
"""What trained networks are judged by: pictures and rollouts of other seeds."""
NETWORKS = ("segmenter", "transporter")


def make_pictures(arguments: argparse.Namespace) -> None:
    """`jaxlfi whip pictures`.

    Raises:
        ValueError: for bad input.
    """
    if arguments.count < 1:
        raise ValueError(f"count: expected at least 1, got {arguments.count}")
    named = tuple(objects.load(name).name for name in dict.fromkeys(arguments.object or ()))
    asked = Asked(arguments.count, arguments.seed, arguments.renderer, arguments.sharp, named)
    count = _made(asked, arguments.out)
    print(f"wrote {count} pictures, {arguments.out / pictures.INDEX} names them")


def import_pictures(arguments: argparse.Namespace) -> None:
    """`jaxlfi whip import-pictures`.

    Raises:
        ValueError: for bad input.
    """
    names, out = dict(_pair(word) for word in arguments.name), arguments.out
    if arguments.coco is None and arguments.classes is None:
        raise ValueError("classes: expected the file of the classes' names, got none")
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        bar = progress.add_task("pictures", total=None)
        show = lambda done, count: progress.update(bar, completed=done, total=count)
        if arguments.coco is not None:
            count = labelled.from_coco(arguments.coco, arguments.images, out, names, show)
        else:
            classes = labelled.read_classes(arguments.classes)
            count = labelled.from_yolo(arguments.yolo, arguments.images, out, classes, names, show)
    print(f"wrote {count} pictures, {arguments.out / pictures.INDEX} names them")


def record_object(arguments: argparse.Namespace) -> None:
    """`jaxlfi whip record`.

    Raises:
        ValueError: for bad input.
    """
    out = arguments.out
    if out.suffix != ".npz" or out.exists() or out.with_suffix(".json").exists():
        raise ValueError(f"out: expected a new .npz file beside which there is no .json, got {out}")
    actions = exploratory_actions() if arguments.actions is None else repetitions.actions_of(arguments.actions)
    rig = ReferenceRig(objects.load(arguments.object))
    key_noise, key_look = jax.random.split(jax.random.key(arguments.seed))
    with perceptions(arguments.detector, arguments.renderer, arguments.weights) as perception_of:
        recording, _ = record(key_noise, rig, np.asarray(actions), perception_of(key_look))
    out.parent.mkdir(parents=True, exist_ok=True)
    recordings.write(out, recording)
    missing = 1 - recording.seen.mean()
    print(f"wrote {out}: {recording.times.size} frames, {100 * missing:.1f} % of the keypoints not seen")


@contextlib.contextmanager
def perceptions(
    detector: str, renderer: str, folder: Path | None = None
) -> Iterator[Callable[[jax.Array], Perception | None]]:
    """What sees one scene, of a key: a detector in pictures of a renderer; None for the labels with their noise.

    Args:
        detector: its name.
        renderer: its name.
        folder: of the detector's weights; by default those that come with the package.

    Raises:
        ValueError: for unknown names, weights that cannot be used, and where the renderer cannot be had.
    """
    found = detectors.pick(detector, folder)
    if found.reads == "labels":
        yield lambda key: None
        return
    if renderer not in RENDERERS:
        raise ValueError(f"renderer: expected one of {', '.join(RENDERERS)}, got {renderer!r}")
    try:
        taking = RENDERERS[renderer](pictures.SIZE)
    except RuntimeError as error:
        raise ValueError(f"renderer: {error}; the renderer raycast needs nothing") from error
    with taking:
        yield lambda key: Photographer(key, taking, found, f"pictures ({renderer}) by the detector {detector}")


def train_vision(arguments: argparse.Namespace) -> None:
    """`jaxlfi whip train-vision`.

    Raises:
        ValueError: for bad input.
    """
    out, wanted = arguments.out, arguments.only or list(NETWORKS)
    preset = training.PRESETS[arguments.preset]
    if arguments.steps is not None:
        if arguments.steps < 1:
            raise ValueError(f"steps: expected at least 1, got {arguments.steps}")
        shorter = {name: dataclasses.replace(getattr(preset, name), steps=arguments.steps) for name in NETWORKS}
        preset = dataclasses.replace(preset, **shorter)
    asked = {
        "preset": arguments.preset,
        "settings": {name: value for name, value in dataclasses.asdict(preset).items() if name != "networks"},
        "seed": arguments.seed,
        "pictures": [str(folder) for folder in arguments.pictures],
    }
    for folder in arguments.pictures:
        pictures.check(folder)
    _begin(out, asked)
    figures = {}
    for name in wanted:
        if not (out / f"{name}.npz").exists():
            {"segmenter": _segmenter, "transporter": _transporter}[name](out, preset, arguments)
        figures[name] = weights.load(out / f"{name}.npz", name).about["figures"]
    for name, values in figures.items():
        table = Table("", name, title=f"on {HELD_OUT_PICTURES} pictures" if name == "segmenter" else "on new rollouts")
        for what, value in values.items():
            table.add_row(what, ", ".join(f"{number:.3f}" for number in np.atleast_1d(value)))
        tables.show(table)
    print(f"wrote {', '.join(str(out / f'{name}.npz') for name in figures)}")


def export_vision(arguments: argparse.Namespace) -> None:
    """`jaxlfi whip export-vision`.

    Raises:
        ValueError: for bad input.
        ImportError: without the extra of the format.
    """
    out, suffix = arguments.out, FORMATS[arguments.format]
    if out.exists() or out.suffix != suffix:
        raise ValueError(f"out: expected a new {suffix} file, got {out}")
    path = weights.SHIPPED["segmenter"] if arguments.weights is None else arguments.weights / "segmenter.npz"
    segmenter = weights.load(path, "segmenter")
    out.parent.mkdir(parents=True, exist_ok=True)
    (export.save_onnx if arguments.format == "onnx" else export.save_stablehlo)(segmenter, out)
    print(f"wrote {out}, the segmenter {path.name}")


def _segmenter(out: Path, preset: training.Preset, arguments: argparse.Namespace) -> None:
    seed = arguments.seed
    folders = list(arguments.pictures) or [out / "pictures"]
    if not arguments.pictures and not _whole(folders[0]):
        _made(Asked(preset.pictures, seed, "raycast", True), folders[0])
    if not _whole(out / "held-out"):
        _made(Asked(HELD_OUT_PICTURES, seed + 1, "raycast", False), out / "held-out")
    data = pictures.together([pictures.read(folder) for folder in folders])
    with _bar("segmenter", preset.segmenter.steps) as on_chunk:
        made, losses = training.train_segmenter(preset, data, seed, out / "segmenter.part.npz", on_chunk)
    figures = judged(detectors.Learnt(made), pictures.read(out / "held-out"))
    _keep(out, "segmenter", made, losses, figures, arguments)


def judged(detector: detectors.Learnt, held_out: pictures.Pictures) -> Mapping[str, float]:
    """How a segmentation fares on pictures that have their labels and true keypoints (`scores.summary`)."""
    line = detectors.Centreline()
    found, lines = [], ([], [])
    for rgb, labels, entry in zip(held_out.rgb, held_out.labels, held_out.entries, strict=True):
        found.append(np.asarray(detector.labels(rgb)))
        for several, seen in zip(lines, (labels, found[-1]), strict=True):
            several.append(pictures.SIZE * np.asarray(line(seen, entry["grip"])[0])[:4])
    return scores.summary(held_out.labels, np.stack(found), *(np.stack(several) for several in lines))


def _transporter(out: Path, preset: training.Preset, arguments: argparse.Namespace) -> None:
    seed, kept = arguments.seed, out / "masks.npz"
    if not kept.exists():
        key_rollouts, key_masks = jax.random.split(jax.random.fold_in(jax.random.key(seed), 1))
        n = preset.rollouts + HELD_OUT_ROLLOUTS
        with _bar("rollouts", n) as on_chunk:
            count = iter(range(scenes.BATCH, n + scenes.BATCH, scenes.BATCH))
            rolled = scenes.rollouts(key_rollouts, pick_engine("auto"), n, lambda done: on_chunk(next(count), ()))
        rolled = jax.tree.map(lambda leaf: leaf[rolled.valid], rolled)
        with _bar("masks", len(rolled.valid)) as on_chunk:
            masks, lines = training.dlo_masks(key_masks, rolled, lambda count: on_chunk(count, ()))
        files.write_arrays(kept, {"masks": masks, "lines": lines})
    masks, lines = (files.read_arrays(kept)[name] for name in ("masks", "lines"))
    learnt, held_out = masks[:-HELD_OUT_ROLLOUTS], slice(len(masks) - HELD_OUT_ROLLOUTS, None)
    with _bar("transporter", preset.transporter.steps) as on_chunk:
        made, losses = training.train_transporter(preset, learnt, seed, out / "transporter.part.npz", on_chunk)
    # Keypoints are identified on the training rollouts and judged on others.
    some = slice(0, HELD_OUT_ROLLOUTS)
    made = training.from_grip_to_tip(made, learnt[some], lines[some])
    following = training.followed(made, masks[held_out], lines[held_out])
    figures = {
        "mean place (fraction of the length)": following.mean.tolist(),
        "drift within a rollout": following.within.tolist(),
        "drift between rollouts": following.between.tolist(),
        "distance from the DLO (px of 64)": (64 * following.away.mean(axis=(0, 1))).tolist(),
        "frames in another order": following.switched,
        "fraction of the DLO covered": following.covered,
    }
    _keep(out, "transporter", made, losses, figures, arguments)


def _begin(out: Path, asked: Mapping[str, Any]) -> None:
    """Begin a folder, or go on with one that the same command began."""
    config = out / "config.json"
    if config.exists():
        try:
            before = json.loads(config.read_text())["asked"]
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"out: expected a folder of train-vision, got a damaged {config}") from error
        if before != json.loads(json.dumps(asked)):
            raise ValueError(f"out: expected the command that {out} was begun by, got another: {config} has it")
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"out: expected a new or empty folder, or one of train-vision, got {out}")
    out.mkdir(parents=True, exist_ok=True)
    files.write_json(config, {"asked": asked, **environment()})


def _keep(out, name, made, losses, figures, arguments) -> None:
    about = {"figures": dict(figures), "preset": arguments.preset, "seed": arguments.seed, **environment()}
    files.write_arrays(out / f"{name}_losses.npz", {"losses": losses})
    weights.save(out / f"{name}.npz", dataclasses.replace(made, about=about))
    (out / f"{name}.part.npz").unlink(missing_ok=True)


def _whole(folder: Path) -> bool:
    try:
        pictures.check(folder)
    except pictures.PicturesError:
        return False
    return True


def _made(asked: Asked, folder: Path) -> int:
    try:
        with _bar(f"pictures in {folder.name}", asked.count) as on_chunk:
            return making.make(asked, folder, pick_engine("auto"), lambda number: on_chunk(number, ()))
    except RuntimeError as error:
        raise ValueError(f"renderer: {error}") from error


@contextlib.contextmanager
def _bar(words: str, total: int) -> Iterator[Callable[[int, Any], None]]:
    """A progress bar with the last loss, as what is called with the number that is done and all losses so far."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total} {task.fields[loss]}"),
    )
    console = Console(stderr=True)
    with Progress(*columns, TimeRemainingColumn(), console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(words, total=total, loss="")

        def show(done: int, losses: Any) -> None:
            loss = f"loss {np.mean(losses[-50:]):.4g}" if len(losses) else ""
            progress.update(task, completed=done, loss=loss)

        yield show


def _pair(word: str) -> tuple[str, str]:
    theirs, equals, ours = word.partition("=")
    if not (theirs and equals and ours):
        raise ValueError(f"name: expected THEIRS=OURS, got {word!r}")
    return theirs, ours
