"""The command line of tasks of MuJoCo models: `jaxlfi mujoco film`.

This module imports neither jax nor numpy, so that `--help` answers at once.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from jaxlfi.cli.exit_status import exit_status
from jaxlfi.cli.parser import OneLineParser
from jaxlfi.envs.mujoco import require_mujoco

EXAMPLES = """\
examples:
  jaxlfi infer mujoco,config=examples/mujoco/arm.toml --heuristic edge --out runs/arm
  jaxlfi mujoco film runs/arm --out runs/arm.gif
  jaxlfi mujoco film runs/arm --draws 30 --slower 2 --size 800x800 --out runs/slowly.gif

"""


def parser() -> argparse.ArgumentParser:
    """The whole command line."""
    formatter = argparse.RawDescriptionHelpFormatter
    top = OneLineParser(
        prog="jaxlfi mujoco",
        description="What runs of MuJoCo models are looked at with: films.",
        epilog=EXAMPLES,
        formatter_class=formatter,
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    film = commands.add_parser(
        "film",
        help="a film of posterior draws over the recorded motion",
        description="Simulate draws of a run's posterior under the recorded controls, and film them as translucent "
        "ghosts over the recorded motion, above the measured signals. Writes an animated gif of 25 frames a second, "
        "and beside it a .png of six moments. Needs EGL or OSMesa.",
    )
    film.add_argument("run", type=Path, metavar="RUN", help="folder of a run: jaxlfi infer mujoco,config=FILE")
    film.add_argument("--draws", type=int, default=12, metavar="N", help="of the posterior (default: 12)")
    film.add_argument(
        "--slower", type=float, default=1.0, metavar="X", help="than the recording, that many times (default: 1)"
    )
    film.add_argument(
        "--size", type=_size, default=(640, 640), metavar="WxH", help="of the film, in pixels (default: 640x640)"
    )
    film.add_argument("--camera", metavar="NAME", help="of the model (default: a view that shows the whole motion)")
    film.add_argument("--episode", type=int, default=0, metavar="N", help="of several recordings, from 0 (default: 0)")
    film.add_argument("--out", type=Path, required=True, metavar="FILE", help="a new .gif, beside it a new .png")
    return top


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT in pixels, as 640x480, got {text!r}")
    return int(width), int(height)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: the words after `jaxlfi mujoco`; by default those of the process.

    Returns:
        0; 2 for bad input; 130 where it was interrupted.
    """
    arguments = parser().parse_args(argv)

    def work() -> None:
        require_mujoco()
        from jaxlfi.io import compile_cache

        compile_cache.enable()
        if arguments.command == "film":
            from jaxlfi.envs.mujoco import film

            film.film(arguments)

    return exit_status("jaxlfi mujoco", work)


if __name__ == "__main__":
    sys.exit(main())
