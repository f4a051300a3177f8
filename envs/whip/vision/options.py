"""The options of the commands of vision; `commands` carries them out.

This module imports neither jax nor numpy, so that `--help` answers at once.
"""

import argparse
from pathlib import Path

from jaxlfi import flags

COMMANDS = {
    "pictures": "make_pictures",
    "import-pictures": "import_pictures",
    "train-vision": "train_vision",
    "export-vision": "export_vision",
    "record": "record_object",
}
"""Commands, and the functions of `commands` that carry them out."""
RENDERERS = ("raycast", "mujoco")
FORMATS = {"onnx": ".onnx", "stablehlo": ".npz"}
"""Formats of exported networks, and how the names of their files end."""
_RENDERER = (
    "raycast: this project's, which is always there; mujoco: MuJoCo's, with shadows and smoothed edges, which needs "
    "EGL or OSMesa"
)


def add(commands: argparse._SubParsersAction) -> None:
    """Add the commands to those of `jaxlfi whip`."""
    pictures = commands.add_parser(
        "pictures",
        help="make a data set of labelled pictures",
        description="Take pictures of random scenes, each 256 x 256, with random colours, patterns, lights and "
        "clutter, and by a camera that blurs and is noisy; beside each, the label of every pixel. A data set that was "
        "interrupted goes on when the command is given again.",
    )
    pictures.add_argument("--count", type=int, default=1000, metavar="N", help="number of pictures (default: 1000)")
    pictures.add_argument("--renderer", choices=RENDERERS, default="raycast", help=f"{_RENDERER} (default: raycast)")
    pictures.add_argument(
        "--object",
        nargs="+",
        metavar="NAME",
        help="FEM reference objects to show, dlo-0 to dlo-3, in turn (default: random DLOs of the simulator)",
    )
    pictures.add_argument(
        "--sharp", action="store_true", help="without blur and noise: for train-vision, which adds them anew each time"
    )
    add_seed(pictures, "seed of everything that is random (default: 0)")
    add_out(pictures, "DIR", "a new folder")

    imported = commands.add_parser(
        "import-pictures",
        help="make a data set of what a labelling tool exports",
        description="Turn a lab's own labelled pictures into a data set that train-vision reads. Classes are red, "
        "green, blue, orange, purple, yellow (the cubes) and dlo. Pictures are cropped to the square in their middle.",
    )
    source = imported.add_mutually_exclusive_group(required=True)
    source.add_argument("--coco", type=Path, metavar="FILE", help="annotations.json with masks or polygons")
    source.add_argument("--yolo", type=Path, metavar="DIR", help="a folder of .txt files with polygons")
    imported.add_argument("--images", type=Path, required=True, metavar="DIR", help="the folder of the pictures")
    imported.add_argument(
        "--classes", type=Path, metavar="FILE", help="for YOLO: file of the classes' names, classes.txt or data.yaml"
    )
    imported.add_argument(
        "--name",
        nargs="+",
        default=[],
        metavar="THEIRS=OURS",
        help="what their classes are called here: rope=dlo; background for those that are to be ignored",
    )
    add_out(imported, "DIR", "a new folder")

    train = commands.add_parser(
        "train-vision",
        help="train the networks that see",
        description="Train the network that segments pictures, and the transporter, which finds keypoints in masks of "
        "the DLO without labels. What is missing is made: pictures and rollouts. A training that was interrupted goes "
        "on when the command is given again.",
    )
    train.add_argument(
        "--preset",
        choices=("quick", "paper"),
        default="quick",
        help="quick: less than an hour on two cores; paper: the paper's 64 and 50 epochs (default: quick)",
    )
    train.add_argument(
        "--only", nargs="+", choices=("segmenter", "transporter"), help="train one of the networks (default: both)"
    )
    train.add_argument(
        "--pictures",
        type=Path,
        nargs="+",
        default=[],
        metavar="DIR",
        help="data sets that the segmenter learns from, one's own among them (default: sharp raycast ones are made)",
    )
    train.add_argument("--steps", type=int, metavar="N", help="training steps of each network (default: the preset's)")
    add_seed(train, "seed of everything that is random (default: 0)")
    add_out(train, "DIR", "a new folder, or one to go on with")

    export = commands.add_parser(
        "export-vision",
        help="write the segmenting network as one file that runs elsewhere",
        description="Write the network that segments pictures as one file, from bytes [256, 256, 3] to labels "
        "[256, 256]: ONNX, for onnxruntime and others (extra onnx), or StableHLO, for JAX on cpu, cuda or tpu (extra "
        "stablehlo).",
    )
    export.add_argument("--format", choices=FORMATS, default="onnx", help="format of the file (default: onnx)")
    export.add_argument(
        "--weights",
        type=Path,
        metavar="DIR",
        help="folder of the networks, made by train-vision (default: those that come with the package)",
    )
    add_out(export, "FILE", "a new .onnx, or .npz of StableHLO")

    record = commands.add_parser(
        "record",
        help="record an FEM reference object as a camera sees it",
        description="Let an FEM reference object whip, and find keypoints in every frame. The recording is one that "
        "`jaxlfi infer whip --object` accepts.",
    )
    record.add_argument("--object", required=True, metavar="NAME", help="dlo-0, dlo-1, dlo-2 or dlo-3")
    add_detector(record)
    record.add_argument(
        "--actions",
        metavar="FILE",
        help="actions in m: an .npz with an array of them, [16, 2], or a .csv or .mcap (jaxlfi design; "
        "default: exploratory actions)",
    )
    add_seed(record, "seed of the camera and the scene's look")
    add_out(record, "FILE", "the new .npz file for the recording; metadata go into a .json file of the same name")


def add_out(command: argparse.ArgumentParser, metavar: str, help: str) -> None:
    """The option that says where results are written to."""
    command.add_argument("--out", type=flags.output, required=True, metavar=metavar, help=help)


def add_seed(command: argparse.ArgumentParser, help: str) -> None:
    """The option of a seed."""
    command.add_argument("--seed", type=flags.seed, default=0, metavar="N", help=help)


def add_detector(command: argparse.ArgumentParser) -> None:
    """Options of commands in which FEM reference objects are seen; of other robots they say nothing."""
    command.add_argument(
        "--detector",
        default="centreline",
        choices=("centreline", "learnt", "learnt-transporter"),
        help="centreline: along the DLO's label in a noisy segmentation image; learnt: the same, of a picture that a "
        "network segments; learnt-transporter: a second network finds the DLO's keypoints (default: centreline)",
    )
    command.add_argument(
        "--renderer", choices=RENDERERS, default="mujoco", help=f"renderer of pictures: {_RENDERER} (default: mujoco)"
    )
    command.add_argument(
        "--weights",
        type=Path,
        metavar="DIR",
        help="folder of the networks, made by train-vision (default: those that come with the package)",
    )
