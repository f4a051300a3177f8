"""The command `jaxlfi control`: a policy controls a robot, and the episode is recorded for the next inference.

This module imports neither jax nor numpy before it has to, and jax not at all.
"""

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxlfi import flags
from jaxlfi.cli import interrupts
from jaxlfi.cli.command import Command
from jaxlfi.cli.export import policy_of

if TYPE_CHECKING:
    from jaxlfi.rl.policy import Policy
    from jaxlfi.robots.settings import Settings

EXAMPLES = """\
examples:
  jaxlfi control policy.npz --robot my_robot:Driver --dry-run --out runs/dry.csv        nothing moves
  jaxlfi control policy.npz --robot my_robot:Driver,port=/dev/ttyUSB0 --out runs/real.csv
  jaxlfi control policy.npz --address 127.0.0.1:5005 --config furuta.toml --out runs/real.mcap
  jaxlfi control policy.npz --address 10.0.0.7:5005 --remote --token lab.token --out runs/real
  jaxlfi infer mujoco,config=furuta.toml,log=runs/real.csv --heuristic edge --out runs/next

"""


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("policy", type=Path, metavar="POLICY", help="a policy.npz, or the folder of its training")
    robot = parser.add_mutually_exclusive_group(required=True)
    robot.add_argument(
        "--robot",
        metavar="DRIVER",
        help="lerobot, ros2, or module:Driver of your own; its options follow after commas: module:Driver,key=value",
    )
    robot.add_argument("--address", metavar="HOST:PORT", help="address of a driver in another process")
    parser.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="a TOML file with a table [robot]: limits, rates, names, estimated velocities (default: the policy's)",
    )
    parser.add_argument("--rate", type=_positive, metavar="HZ", help="control rate (default: that of the training)")
    parser.add_argument(
        "--duration", type=_positive, metavar="S", help="length of the episode (default: that of the training)"
    )
    parser.add_argument(
        "--command",
        action="append",
        default=[],
        type=_named,
        metavar="NAME=VALUE",
        help="value of a command that the policy follows (default: the middle of its range)",
    )
    parser.add_argument(
        "--holds",
        type=int,
        metavar="N",
        help="number of consecutive control periods without a usable observation, in which the control is held, "
        "before the robot is stopped (default: 3)",
    )
    parser.add_argument(
        "--max-age", type=_positive, metavar="S", help="largest age of an observation (default: a control period)"
    )
    parser.add_argument(
        "--watchdog",
        type=_positive,
        metavar="S",
        help="time limit of a driver call, after which the robot is stopped (default: 0.1)",
    )
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--dry-run", action="store_true", help="observe and evaluate the policy, but send no commands")
    mode.add_argument(
        "--shadow",
        action="store_true",
        help="let another controller command the robot, and also record what the policy would have commanded",
    )
    parser.add_argument("--remote", action="store_true", help="allow a driver on another host; needs --token")
    parser.add_argument("--token", type=Path, metavar="FILE", help="a file with the token that the driver asks for")
    parser.add_argument(
        "--out",
        type=flags.output,
        required=True,
        metavar="FILE",
        help="the new recording: NAME.csv, NAME.npz, NAME.mcap, or a folder for a LeRobot data set; with NAME.json and "
        "NAME.loop.npz beside it",
    )
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text!r}")
    return value


def _named(text: str) -> tuple[str, float]:
    name, _, value = text.rpartition("=")
    try:
        return name, float(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected NAME=VALUE, got {text!r}") from None


def _control(arguments: argparse.Namespace) -> None:
    from jaxlfi.rl import policy
    from jaxlfi.robots import recording, sessions

    recording.require_new(arguments.out)
    path = policy_of(arguments.policy)
    trained = policy.load(path)
    settings = _settings(arguments.config, trained)
    mode: sessions.Mode = "dry run" if arguments.dry_run else "shadow" if arguments.shadow else "control"
    changes: dict[str, Any] = {name: getattr(arguments, name) for name in ("rate", "holds", "max_age", "watchdog")}
    changes = {name: value for name, value in changes.items() if value is not None}
    session = sessions.of(trained, settings, dict(arguments.command), mode, arguments.duration, changes)
    with interrupts.orderly():  # a robot that was found is stopped
        session.run(_robot(arguments), arguments.out, {"policy": str(path)}, say=print)


def _settings(config: Path | None, trained: "Policy") -> "Settings":
    """The robot settings in a file, or else those that the policy carries."""
    import tomllib

    from jaxlfi.robots import driving, settings

    if config is None:
        return driving.settings_of(trained)
    try:
        with config.open("rb") as file:
            table = tomllib.load(file).get(settings.KEY)
    except (OSError, ValueError) as error:
        raise ValueError(f"{config}: expected a TOML file, got a missing or damaged one: {error}") from error
    if table is None:
        raise ValueError(f"{config}: expected a table [robot], got none")
    try:
        return settings.of_table(table)
    except ValueError as error:
        raise ValueError(f"{config}: {error}") from error


def _robot(arguments: argparse.Namespace) -> Any:
    from jaxlfi.registry import DRIVERS, ROBOTS
    from jaxlfi.robots import wire
    from jaxlfi.robots.client import SocketDriver

    if arguments.address is None:
        if arguments.remote or arguments.token:
            raise ValueError("--remote, --token: expected with --address only, got --robot")
        own = ":" in arguments.robot.partition(",")[0]
        family = ROBOTS if own else DRIVERS  # a user's class may be of either kind
        return family.load(arguments.robot)
    token = None if arguments.token is None else wire.token_of(arguments.token)
    return SocketDriver(arguments.address, arguments.remote, token)


main = Command(
    "control",
    "run a policy on a robot",
    _arguments,
    _control,
    description="Run a trained policy on a robot at a fixed rate, within limits, and stop the robot whatever "
    "happens. Writes measurements and commands as a recording that `jaxlfi infer` reads.",
    epilog=EXAMPLES,
)
parser = main.parser


if __name__ == "__main__":
    sys.exit(main())
