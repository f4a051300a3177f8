"""Quality of segmentation and keypoint detection, on held-out scenes and renderers.

    python -m experiments.vision segmentation --out experiments/results/vision
    python -m experiments.vision keypoints --out experiments/results/vision
    python -m experiments.vision errors --out experiments/results/vision
    python -m experiments.vision speed --out experiments/results/vision

The data sets of pictures are in runs/vision-study, and are made if they are missing (MuJoCo's renderer needs EGL or
OSMesa).
"""

import argparse
import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxlfi.io import files


def segmentation(arguments: argparse.Namespace) -> None:
    """Overlaps, distances and misses of the ray caster's own labels, of colour thresholds, and of the network."""
    from experiments.vision import segmenting

    rows = segmenting.compared(arguments.pictures, arguments.weights)
    write(arguments.out / "segmentation.csv", rows)


def keypoints(arguments: argparse.Namespace) -> None:
    """How well keypoints follow the DLO, of the transporter, the centreline and noise models; with pictures."""
    from experiments.vision import figures, following

    rows, arrays = following.compared(arguments.weights)
    write(arguments.out / "keypoints.csv", rows)
    files.write_arrays(arguments.out / "keypoints.npz", arrays)
    figures.save(arguments.out, arrays)


def errors(arguments: argparse.Namespace) -> None:
    """Errors of learnt detectors in pictures by MuJoCo, for the noise models of simulations."""
    from experiments.vision import errors as measuring

    rows, arrays = measuring.measured(arguments.weights)
    for row in rows:
        write(arguments.out / f"errors-{row['detector']}.csv", [row])
    files.write_arrays(arguments.out / "errors.npz", arrays)


def speed(arguments: argparse.Namespace) -> None:
    """Milliseconds per frame on one core, for the network and for whole detectors."""
    import os

    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # before JAX starts its threads
    from experiments.vision import speeds

    write(arguments.out / "speed.csv", speeds.measured(arguments.weights))


def write(path: Path, rows: Sequence[Mapping]) -> None:
    """Write rows as csv, and print them as a table."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows([{name: _short(value) for name, value in row.items()} for row in rows])
    files.write_bytes(path, text.getvalue().encode())
    lines = [list(rows[0]), ["---"] * len(rows[0]), *([_short(value) for value in row.values()] for row in rows)]
    print("\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines))


def _short(value) -> str:
    return (
        value
        if isinstance(value, str)
        else f"{value:.4f}"
        if abs(value) < 0.1
        else f"{value:.3f}"
        if np.isfinite(value)
        else ""
    )


def main() -> None:
    """Run a stage."""
    top = argparse.ArgumentParser(
        prog="python -m experiments.vision",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    stages = top.add_subparsers(required=True, metavar="STAGE")
    for stage in (segmentation, keypoints, errors, speed):
        one = stages.add_parser(stage.__name__, help=stage.__doc__, description=stage.__doc__)
        one.set_defaults(stage=stage)
        one.add_argument("--out", type=Path, required=True, metavar="DIR", help="of the tables")
        one.add_argument("--weights", type=Path, metavar="DIR", help="(default: those that come with the package)")
        if stage is segmentation:
            one.add_argument(
                "--pictures", type=Path, default=Path("runs/vision-study"), metavar="DIR", help="data sets"
            )
    arguments = top.parse_args()
    arguments.stage(arguments)


if __name__ == "__main__":
    main()
