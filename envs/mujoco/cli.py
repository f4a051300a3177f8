"""The command line of tasks of MuJoCo models: `jaxlfi mujoco inspect | film | fit | serve`.

This module imports neither jax nor numpy, so that `--help` answers at once.
"""

import argparse
import sys
from pathlib import Path

from jaxlfi import flags
from jaxlfi.cli.command import Command
from jaxlfi.envs.mujoco import require_mujoco

EXAMPLES = """\
examples:
  jaxlfi mujoco inspect day1.csv --model arm.xml --out arm.toml     what is in a recording?
  jaxlfi infer mujoco,config=examples/mujoco/arm.toml --heuristic edge --out runs/arm
  jaxlfi mujoco film runs/arm --out runs/arm.gif                   does the posterior move as the machine did?
  jaxlfi mujoco film runs/arm --draws 30 --slower 4 --out runs/arm-slowly.gif
  jaxlfi mujoco fit runs/arm --out runs/arm-fit                    sharper numbers, from the posterior's draws
  jaxlfi mujoco fit examples/mujoco/arm.toml --starts 256          without a run, from draws of Phi
  jaxlfi mujoco serve examples/mujoco/furuta.toml --port 5005      a machine for jaxlfi control --address 127.0.0.1:5005

"""


def _arguments(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    inspect = commands.add_parser(
        "inspect",
        help="say what is in recordings, and write a task to begin with",
        description="Print the signals of recordings: unit, rate, gaps, range, what of the model each is, and what is "
        "odd about it. Reads CSV, .npz, MCAP (ROS 2, too) and LeRobot data sets; an episode is FOLDER#episode=3, "
        "several are FOLDER#episodes=0-9.",
    )
    inspect.add_argument("logs", type=Path, nargs="+", metavar="LOG", help="recordings of one machine")
    inspect.add_argument("--model", type=Path, required=True, metavar="FILE", help="its MJCF file")
    inspect.add_argument(
        "--out",
        type=flags.output,
        metavar="FILE",
        help="a new TOML file of a task: signals, noise, and parameters of the model to choose from",
    )
    inspect.add_argument("--json", action="store_true", help="print JSON in place of the table")

    film = commands.add_parser(
        "film",
        help="film draws of a posterior over the recorded motion",
        description="Simulate draws of a run's posterior under the recorded controls, and film them as translucent "
        "ghosts over the recorded motion, above the measured signals. Writes an animated gif of 25 frames a second, "
        "and beside it a .png of six moments. Needs EGL or OSMesa.",
    )
    film.add_argument("run", type=Path, metavar="RUN", help="folder of a run: jaxlfi infer mujoco,config=FILE")
    film.add_argument("--draws", type=_count, default=12, metavar="N", help="number of ghosts (default: 12)")
    film.add_argument(
        "--slower", type=float, default=1.0, metavar="X", help="times slower than the recording (default: 1)"
    )
    film.add_argument(
        "--size", type=_size, default=(640, 640), metavar="WxH", help="size of the film in pixels (default: 640x640)"
    )
    film.add_argument(
        "--camera", metavar="NAME", help="the model's camera (default: a view that shows the whole motion)"
    )
    film.add_argument(
        "--episode", type=int, default=0, metavar="N", help="which of several recordings, from 0 (default: 0)"
    )
    film.add_argument(
        "--out",
        type=flags.output,
        required=True,
        metavar="FILE",
        help="the film, a new .gif; six frames of it are written to a .png of the same name",
    )

    fit = commands.add_parser(
        "fit",
        help="find least-squares estimates from a posterior's draws",
        description="Refine the best of some draws to least-squares estimates, by Gauss-Newton steps, and subtract the "
        "integrator's own error. Prints each estimate with 90 % intervals, which points explain the recording as "
        "well as the best, which parameters trade off against each other or are on a bound of Phi, and what the model "
        "gets wrong, as unmodelled_force and a table [discrepancy] for the task's file.",
    )
    fit.add_argument(
        "source",
        metavar="RUN|TASK",
        help="folder of a run, to start from its posterior; or the TOML file of a task, or a task as `jaxlfi infer` "
        "takes it, to start from Phi",
    )
    fit.add_argument(
        "--starts", type=_count, default=64, metavar="N", help="number of draws to choose from (default: 64)"
    )
    fit.add_argument(
        "--keep", type=_count, default=4, metavar="N", help="number of them to follow, the best ones (default: 4)"
    )
    fit.add_argument(
        "--out",
        type=flags.output,
        metavar="DIR",
        help="a new folder: fit.json and pairs.png, a pair plot of posterior and points (default: print only)",
    )
    fit.add_argument(
        "--sysid",
        action="store_true",
        help="also find the point estimate of mujoco.sysid (pip install 'mujoco[sysid]')",
    )

    serve = commands.add_parser(
        "serve",
        help="simulate a machine for `jaxlfi control` in a process of its own",
        description="Simulate a task's model with another integrator, the parameters' truths, noise, and effects that "
        "no parameter is for, and serve it as a driver until the process is ended. It stands for the real machine.",
    )
    serve.add_argument("config", type=Path, metavar="FILE", help="the TOML file of a task")
    serve.add_argument("--port", type=int, default=0, metavar="N", help="port (default: any that is free)")
    serve.add_argument(
        "--truth",
        action="append",
        default=[],
        type=_named,
        metavar="NAME=VALUE",
        help="a parameter of the machine (default: its truth in the file)",
    )
    serve.add_argument(
        "--unmodelled",
        type=float,
        default=1.0,
        metavar="X",
        help="size of the effects that no parameter is for: friction, drag, loss (default: 1)",
    )
    serve.add_argument("--seed", type=int, default=0, metavar="N", help="seed of noise and starts (default: 0)")
    serve.add_argument(
        "--first-episode",
        type=int,
        default=0,
        metavar="N",
        help="number of the first connection's episode; noise and start depend on seed and number (default: 0)",
    )
    serve.add_argument(
        "--scattered", action="store_true", help="begin episodes where [policy.initial] does, and not in [initial]"
    )
    serve.add_argument(
        "--real-time", action="store_true", help="live by the system's clock, and not in the time of the loop"
    )
    serve.add_argument(
        "--host", default="127.0.0.1", metavar="ADDRESS", help="address to listen on (default: this host only)"
    )
    serve.add_argument("--token", type=Path, metavar="FILE", help="a file with the token that clients have to know")
    serve.add_argument(
        "--until-closed", action="store_true", help="end when standard input does, as when the starting process ends"
    )
    serve.add_argument("--journal", type=Path, metavar="FILE", help="a file for what was asked of it: lines of JSON")


def _named(text: str) -> tuple[str, float]:
    name, _, value = text.rpartition("=")
    try:
        return name, float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected NAME=VALUE, got {text!r}") from None


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, got {text!r}")
    return int(text)


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT in pixels, as 640x480, got {text!r}")
    return int(width), int(height)


def _run(arguments: argparse.Namespace) -> None:
    require_mujoco()
    if arguments.command == "inspect":
        from jaxlfi.envs.mujoco.inspecting import inspect

        return inspect(arguments)
    from jaxlfi.io import compile_cache

    compile_cache.enable()
    if arguments.command == "film":
        from jaxlfi.envs.mujoco.film import film as command
    elif arguments.command == "serve":
        from jaxlfi.envs.mujoco.served import serve as command
    else:
        from jaxlfi.envs.mujoco.commands import fit as command
    return command(arguments)


main = Command(
    "mujoco",
    "inspect recordings of a MuJoCo model, film and refine its posterior",
    _arguments,
    _run,
    description="Say what is in recordings of a machine, film the posterior of its MuJoCo model, find least-squares "
    "estimates from it, or simulate the machine in another process.",
    epilog=EXAMPLES,
)
parser = main.parser

if __name__ == "__main__":
    sys.exit(main())
