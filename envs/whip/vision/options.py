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
_RENDERER = "raycast (our own, always available) or mujoco (with shadows and anti-aliasing; needs EGL or OSMesa)"


def add(commands: argparse._SubParsersAction) -> None:
    """Add the commands to those of `jaxlfi whip`."""
    pictures = commands.add_parser(
        "pictures",
        help="make a data set of labelled pictures",
        description="Render pictures of random scenes, 256 x 256, with random colours, patterns, lights and clutter, "
        "camera blur and noise, each with a label for every pixel. Repeating the command continues an interrupted data "
        "set.",
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
        "--sharp", action="store_true", help="without blur and noise: for train-vision, which adds them itself"
    )
    add_seed(pictures, "seed of all random numbers (default: 0)")
    add_out(pictures, "DIR", "a new folder")

    imported = commands.add_parser(
        "import-pictures",
        help="make a data set from the output of a labelling tool",
        description="Convert your own labelled pictures to a data set for train-vision. Classes are red, green, blue, "
        "orange, purple, yellow (the cubes) and dlo. Pictures are cropped to the central square.",
    )
    source = imported.add_mutually_exclusive_group(required=True)
    source.add_argument("--coco", type=Path, metavar="FILE", help="annotations.json with masks or polygons")
    source.add_argument("--yolo", type=Path, metavar="DIR", help="a folder of .txt files with polygons")
    imported.add_argument("--images", type=Path, required=True, metavar="DIR", help="the folder of the pictures")
    imported.add_argument(
        "--classes", type=Path, metavar="FILE", help="for YOLO: file of class names, classes.txt or data.yaml"
    )
    imported.add_argument(
        "--name",
        nargs="+",
        default=[],
        metavar="THEIRS=OURS",
        help="map class names, as in rope=dlo; map classes to background to ignore them",
    )
    add_out(imported, "DIR", "a new folder")

    train = commands.add_parser(
        "train-vision",
        help="train the vision networks",
        description="Train the network that segments pictures, and the transporter, which learns keypoints in masks "
        "of the DLO without supervision. Pictures and rollouts are made if missing. Repeating the command continues an "
        "interrupted training.",
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
        help="data sets for training the segmenter, such as your own (default: makes sharp raycast pictures)",
    )
    train.add_argument("--steps", type=int, metavar="N", help="training steps of each network (default: the preset's)")
    add_seed(train, "seed of all random numbers (default: 0)")
    add_out(train, "DIR", "a new folder, or one to continue")

    export = commands.add_parser(
        "export-vision",
        help="convert the segmenting network to a single file for another runtime",
        description="Convert the network that segments pictures to a single file, from bytes [256, 256, 3] to labels "
        "[256, 256]: ONNX, for onnxruntime and others (extra onnx), or StableHLO, for JAX on cpu, cuda or tpu (extra "
        "stablehlo).",
    )
    export.add_argument("--format", choices=FORMATS, default="onnx", help="format of the file (default: onnx)")
    export.add_argument(
        "--weights",
        type=Path,
        metavar="DIR",
        help="folder of networks trained by train-vision (default: the package's own networks)",
    )
    add_out(export, "FILE", "a new .onnx, or .npz of StableHLO")

    record = commands.add_parser(
        "record",
        help="record an FEM reference object through a simulated camera",
        description="Whip an FEM reference object, and find keypoints in every frame. `jaxlfi infer whip --object` "
        "accepts the recording.",
    )
    record.add_argument("--object", required=True, metavar="NAME", help="dlo-0, dlo-1, dlo-2 or dlo-3")
    add_detector(record)
    record.add_argument(
        "--actions",
        metavar="FILE",
        help="actions in m: an .npz with an array of them, [16, 2], or a .csv or .mcap (jaxlfi design; "
        "default: exploratory actions)",
    )
    add_seed(record, "seed of the camera and the scene's appearance")
    add_out(record, "FILE", "the new .npz file for the recording; metadata go into a .json file of the same name")


def add_out(command: argparse.ArgumentParser, metavar: str, help: str) -> None:
    """The option that says where results are written to."""
    command.add_argument("--out", type=flags.output, required=True, metavar=metavar, help=help)


def add_seed(command: argparse.ArgumentParser, help: str) -> None:
    """The option of a seed."""
    command.add_argument("--seed", type=flags.seed, default=0, metavar="N", help=help)


def add_detector(command: argparse.ArgumentParser) -> None:
    """Options for how FEM reference objects are observed; they do not affect other robots."""
    command.add_argument(
        "--detector",
        default="centreline",
        choices=("centreline", "learnt", "learnt-transporter"),
        help="centreline: points along the DLO in a noisy segmentation image; learnt: the same, in a picture that a "
        "network segments; learnt-transporter: a second network finds the DLO's keypoints (default: centreline)",
    )
    command.add_argument(
        "--renderer", choices=RENDERERS, default="mujoco", help=f"renderer of pictures: {_RENDERER} (default: mujoco)"
    )
    command.add_argument(
        "--weights",
        type=Path,
        metavar="DIR",
        help="folder of networks trained by train-vision (default: the package's own networks)",
    )
