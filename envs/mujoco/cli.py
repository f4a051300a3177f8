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
        help="inspect recordings, and write a first version of a task",
        description="Print the signals of recordings: unit, rate, gaps, range, their counterparts in the model, and "
        "anomalies. Reads CSV, .npz, MCAP (including ROS 2) and LeRobot data sets (one episode: FOLDER#episode=3; "
        "several: FOLDER#episodes=0-9).",
    )
    inspect.add_argument("logs", type=Path, nargs="+", metavar="LOG", help="recordings of one machine")
    inspect.add_argument("--model", type=Path, required=True, metavar="FILE", help="the machine's MJCF file")
    inspect.add_argument(
        "--out",
        type=flags.output,
        metavar="FILE",
        help="a new TOML task file: signals, noise, and candidate parameters of the model",
    )
    inspect.add_argument("--json", action="store_true", help="print JSON instead of the table")

    film = commands.add_parser(
        "film",
        help="film posterior draws over the recorded motion",
        description="Simulate posterior draws of a run under the recorded controls, and film them as translucent "
        "ghosts over the recorded motion, above the measured signals. Writes an animated GIF with 25 frames per "
        "second, and a .png with six of them. Needs EGL or OSMesa.",
    )
    film.add_argument("run", type=Path, metavar="RUN", help="folder of a run: jaxlfi infer mujoco,config=FILE")
    film.add_argument("--draws", type=_count, default=12, metavar="N", help="number of ghosts (default: 12)")
    film.add_argument("--slower", type=float, default=1.0, metavar="X", help="slow-motion factor (default: 1)")
    film.add_argument(
        "--size", type=_size, default=(640, 640), metavar="WxH", help="size of the film in pixels (default: 640x640)"
    )
    film.add_argument("--camera", metavar="NAME", help="a camera of the model (default: a view of the whole motion)")
    film.add_argument("--episode", type=int, default=0, metavar="N", help="index of the recording, from 0 (default: 0)")
    film.add_argument(
        "--out",
        type=flags.output,
        required=True,
        metavar="FILE",
        help="the film, a new .gif; six frames are also written to a .png of the same name",
    )

    fit = commands.add_parser(
        "fit",
        help="find least-squares estimates from a posterior's draws",
        description="Refine the best of several draws to least-squares estimates by Gauss-Newton steps, and subtract "
        "the integrator's error. Prints each estimate with 90 % intervals; which estimates explain the recording as "
        "well as the best; which parameters trade off against each other or are on a bound of Phi; and the model "
        "error, as unmodelled_force and a table [discrepancy] for the task file.",
    )
    fit.add_argument(
        "source",
        metavar="RUN|TASK",
        help="the folder of a run, to start from its posterior; or a TOML task file or task name (as for `jaxlfi "
        "infer`), to start from Phi",
    )
    fit.add_argument("--starts", type=_count, default=64, metavar="N", help="number of draws (default: 64)")
    fit.add_argument("--keep", type=_count, default=4, metavar="N", help="number of best draws to refine (default: 4)")
    fit.add_argument(
        "--out",
        type=flags.output,
        metavar="DIR",
        help="a new folder for fit.json and pairs.png, a pair plot of posterior and estimates (default: print only)",
    )
    fit.add_argument(
        "--sysid",
        action="store_true",
        help="also find the point estimate of mujoco.sysid (pip install 'mujoco[sysid]')",
    )

    serve = commands.add_parser(
        "serve",
        help="simulate a machine for `jaxlfi control`, in a separate process",
        description="Simulate a task's model with another integrator, the true parameters, noise and unmodelled "
        "effects, and serve it as a driver until the process ends. It stands in for the real machine.",
    )
    serve.add_argument("config", type=Path, metavar="FILE", help="the TOML file of a task")
    serve.add_argument("--port", type=int, default=0, metavar="N", help="port (default: any free one)")
    serve.add_argument(
        "--truth",
        action="append",
        default=[],
        type=_named,
        metavar="NAME=VALUE",
        help="the machine's value of a parameter (default: the true value in the file)",
    )
    serve.add_argument(
        "--unmodelled",
        type=float,
        default=1.0,
        metavar="X",
        help="size of unmodelled effects: friction, drag, loss (default: 1)",
    )
    serve.add_argument("--seed", type=int, default=0, metavar="N", help="seed of noise and initial states (default: 0)")
    serve.add_argument(
        "--first-episode",
        type=int,
        default=0,
        metavar="N",
        help="episode number of the first connection; noise and initial state depend on seed and number (default: 0)",
    )
    serve.add_argument(
        "--scattered", action="store_true", help="draw initial states from [policy.initial] instead of using [initial]"
    )
    serve.add_argument("--real-time", action="store_true", help="run in real time, not in the loop's time")
    serve.add_argument(
        "--host", default="127.0.0.1", metavar="ADDRESS", help="address to listen on (default: this host only)"
    )
    serve.add_argument("--token", type=Path, metavar="FILE", help="a file with the token that clients must know")
    serve.add_argument(
        "--until-closed",
        action="store_true",
        help="end when standard input is closed, for example because the parent process ended",
    )
    serve.add_argument("--journal", type=Path, metavar="FILE", help="a file that logs all requests, as lines of JSON")


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
    description="Inspect recordings of a machine, film the posterior of its MuJoCo model, find least-squares "
    "estimates from it, or simulate the machine in another process.",
    epilog=EXAMPLES,
)
parser = main.parser

if __name__ == "__main__":
    sys.exit(main())
