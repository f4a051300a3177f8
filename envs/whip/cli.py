"""The command line of the whipping task: `jaxlfi whip render | plan | deploy | control | record | convert | ...`.

This module imports neither jax nor numpy, so that `--help` answers at once.
"""

import argparse
import sys
from pathlib import Path

from jaxlfi.cli.command import Command
from jaxlfi.envs.whip import require_mujoco
from jaxlfi.envs.whip.vision import options

EXAMPLES = """\
examples:
  jaxlfi whip render --length 290 --young 2e3 --out runs/explore
  jaxlfi whip render --length 250 --young 2.5e4 --policy plan --detector transporter --out runs/whip
  jaxlfi whip plan --length 250 --young 2.5e4 --out runs/plan.npz
  jaxlfi whip render --length 200 --young 2.5e4 --policy runs/plan.npz --out runs/shorter
  jaxlfi whip deploy runs/policies/uniform/seed_000/policy.npz constant:0.03,-0.03 --object dlo-0 --out runs/deployed
  jaxlfi whip control policy.npz --robot socket://127.0.0.1:5005 --max-speed 0.2 --out rollout.npz
  jaxlfi whip record --object dlo-2 --detector learnt --out seen.npz
  jaxlfi whip pictures --count 200 --renderer mujoco --out runs/pictures
  jaxlfi whip train-vision --out runs/vision
  jaxlfi whip convert rollout.npz rollout.mcap
  jaxlfi whip convert first.npz second.mcap runs/whips              a LeRobot data set of two episodes
  jaxlfi whip convert "runs/whips#episode=1" second.npz

"""


def _arguments(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    render = commands.add_parser(
        "render",
        help="draw a rollout",
        description="Roll out one episode and draw it: sheet.png, film.gif (at half speed), and rollout.npz with "
        "rollout.json, a recording that `jaxlfi infer whip --object` accepts.",
    )
    _add_scene(render)
    render.add_argument(
        "--policy",
        default="explore",
        metavar="NAME|FILE",
        help="explore: actions that excite the DLO; random: random actions in the workspace; plan: actions that hit "
        "the top cube, found by a search; or a file of actions, as of deploy (default: explore)",
    )
    render.add_argument(
        "--detector",
        default="clean",
        metavar="NAME",
        help="detector whose errors are simulated: clean, mask, noisy, transporter, learnt or learnt-transporter "
        "(default: clean)",
    )
    options.add_out(render, "DIR", "a new folder")

    plan = commands.add_parser(
        "plan",
        help="search for actions that hit the top cube",
        description="Search by the cross-entropy method for the actions with the highest return: those that move the "
        "top cube before any other. Prints which cubes are out of place once the scene has settled.",
    )
    _add_scene(plan)
    options.add_out(plan, "FILE", "a new .npz: actions, value, history")

    deploy = commands.add_parser(
        "deploy",
        help="run policies on the FEM reference objects",
        description="Run policies on the FEM reference objects, in closed loop through noisy images. All get the "
        "same placements of stack and camera, displaced as in training. Writes table.csv and episodes.csv.",
    )
    deploy.add_argument(
        "policies",
        nargs="+",
        metavar="POLICY",
        help="a policy.npz (jaxlfi train); a plan or another .npz with actions [16, 2] in m; a .csv or .mcap of "
        "actions (jaxlfi design); or constant:DX,DZ in m",
    )
    deploy.add_argument(
        "--object", nargs="+", required=True, metavar="NAME", help="objects to act on: dlo-0, dlo-1, dlo-2, dlo-3"
    )
    options.add_detector(deploy)
    deploy.add_argument(
        "--repetitions",
        type=int,
        default=16,
        metavar="N",
        help="number of placements of stack and camera (default: 16)",
    )
    options.add_seed(deploy, "seed of placements and noise (default: 0)")
    options.add_out(deploy, "DIR", "a new folder")

    control = commands.add_parser(
        "control",
        help="run a policy on a robot",
        description="Run a policy on a robot for an episode of 16 steps, within limits, and stop the robot whatever "
        "happens. Writes observations and actions as a recording that `jaxlfi infer whip --object` accepts.",
    )
    control.add_argument("policy", metavar="POLICY", help="as of deploy")
    control.add_argument(
        "--robot",
        required=True,
        metavar="ROBOT",
        help="socket://HOST:PORT of a driver; dlo-0 to dlo-3, the FEM reference objects; or module:Factory of your "
        "own, whose options follow after commas: module:Factory,key=value",
    )
    control.add_argument("--rate", type=float, metavar="HZ", help="rate of commands (default: that of the training)")
    control.add_argument(
        "--holds",
        type=int,
        default=3,
        metavar="N",
        help="number of consecutive control periods without a usable observation, in which the set-point is held, "
        "before the robot is stopped (default: 3)",
    )
    control.add_argument(
        "--max-age", type=float, metavar="S", help="largest age of an observation (default: a control period)"
    )
    control.add_argument(
        "--max-step", type=float, metavar="M", help="largest displacement per command, along x and along z"
    )
    control.add_argument("--max-speed", type=float, metavar="M/S", help="largest speed of the set-point")
    control.add_argument(
        "--workspace",
        type=float,
        nargs=4,
        metavar=("X1", "X2", "Z1", "Z2"),
        help="limits of the set-point's x and z, in m; limits can be tightened, not loosened (default: the policy's)",
    )
    options.add_detector(control)
    control.add_argument(
        "--watchdog",
        type=float,
        metavar="S",
        help="time limit of a robot call, after which the robot is stopped (default: none)",
    )
    control.add_argument("--remote", action="store_true", help="allow a driver on another host; needs --token")
    control.add_argument("--token", type=Path, metavar="FILE", help="a file with the token that the driver asks for")
    options.add_seed(control, "seed of a reference object's camera (default: 0)")
    options.add_out(
        control, "FILE", "the new .npz file for the recording; metadata go into a .json file of the same name"
    )

    options.add(commands)

    convert = commands.add_parser(
        "convert",
        help="convert recordings between formats",
        description="Convert recorded rollouts: NAME.npz with NAME.json, NAME.mcap, or the folder of a LeRobot data "
        "set (extra robotics). Arrays that are not part of a recording are dropped.",
    )
    convert.add_argument(
        "recordings",
        nargs="+",
        metavar="IN",
        help="a recording, or FOLDER#episode=N of a data set; give several to make a data set",
    )
    convert.add_argument("out", type=Path, metavar="OUT", help="a new NAME.npz, NAME.mcap, or folder without a suffix")


def _add_scene(command: argparse.ArgumentParser) -> None:
    """Options of commands that simulate: the DLO and its simulation."""
    command.add_argument("--length", type=float, default=250.0, metavar="MM", help="length of the DLO in mm, 50 to 350")
    command.add_argument(
        "--young", type=float, default=2.5e4, metavar="PA", help="Young's modulus of the DLO in Pa, 500 to 5e5"
    )
    options.add_seed(command, "seed of all random numbers (default: 0)")
    command.add_argument(
        "--engine",
        default="auto",
        metavar="NAME",
        help="native, mjx, warp, or auto: the one that suits the platform (default)",
    )


def _run(arguments: argparse.Namespace) -> None:
    require_mujoco()
    from jaxlfi.io import compile_cache

    compile_cache.enable()
    if arguments.command in options.COMMANDS:
        from jaxlfi.envs.whip.vision import commands as of_vision

        getattr(of_vision, options.COMMANDS[arguments.command])(arguments)
    else:
        from jaxlfi.envs.whip import commands

        getattr(commands, arguments.command)(arguments)


main = Command(
    "whip",
    "the whipping task: render, plan, deploy, control, record, train vision",
    _arguments,
    _run,
    description="Render rollouts of the DLO whipping task, plan actions, run policies on reference objects and "
    "robots, train vision networks, and record and convert rollouts.",
    epilog=EXAMPLES,
)
parser = main.parser

if __name__ == "__main__":
    sys.exit(main())
