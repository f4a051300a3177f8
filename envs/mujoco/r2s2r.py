"""The loop of a MuJoCo task: from a machine to a policy for it, and back, until the posterior stops moving.

excitation.csv             the first recording: the machine excited by sines
iteration_1/posterior/     the posterior of its parameters (jaxlfi infer), from all recordings so far
iteration_1/policy/        a policy trained on that posterior (jaxlfi train)
iteration_1/rollout.csv    that policy on the machine (jaxlfi control); or, with --explore design, the controls that
                           are most informative under that posterior (iteration_1/design, jaxlfi design)
iteration_2/ ...           likewise, with that recording in addition
uniform/ point/ sysid/     policies on other domains, to compare with (`jaxlfi.envs.mujoco.r2s2r_beside`)
deployed/                  all policies on the machine, from scattered starts
results.json, page.html

Every stage is a command of its own in a folder of its own. Repeating the command continues an interrupted run. The
machine is a driver at an address, or by default one that is simulated in another process, with another integrator and
unmodelled effects (`jaxlfi.envs.mujoco.served`). It begins each recording where the task says that recordings begin.
This module imports neither jax nor numpy before it has to, so that `--help` answers at once.
"""

import argparse
import csv
import io
import math
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from jaxlfi import flags, references
from jaxlfi.cli import loops, train
from jaxlfi.cli import parser as command_line
from jaxlfi.cli.command import Command
from jaxlfi.envs.mujoco import r2s2r_beside as beside
from jaxlfi.envs.mujoco import r2s2r_machine as machine
from jaxlfi.envs.mujoco import require_mujoco
from jaxlfi.io.formats import CONFIG
from jaxlfi.registry import HEURISTICS

EXAMPLES = """\
examples:
  jaxlfi r2s2r mujoco,config=examples/mujoco/furuta.toml --out runs/loop
  jaxlfi r2s2r mujoco,config=my-arm.toml --address 127.0.0.1:5005 --iterations 3 --out runs/my-arm

"""
SETTLED = 0.5
"""Largest move of a median, in half-widths of its 90 % interval, at which a posterior has stopped moving."""
EPISODES = 8
"""Number of episodes on the machine by which policies are compared."""


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("task", metavar="mujoco,config=FILE", help="the task; its file needs a table [policy]")
    parser.add_argument(
        "--out",
        type=flags.output,
        required=True,
        metavar="DIR",
        help="a new folder, or that of the same command to continue it",
    )
    parser.add_argument(
        "--address", metavar="HOST:PORT", help="address of the machine's driver (default: a simulated machine)"
    )
    parser.add_argument("--remote", action="store_true", help="allow a driver on another host; needs --token")
    parser.add_argument("--token", type=Path, metavar="FILE", help="a file with the token that the driver asks for")
    parser.add_argument(
        "--confirm",
        action="store_true",
        help="with --address: wait for Enter before each recording, as the machine moves then",
    )
    parser.add_argument(
        "--heuristic", default="edge", metavar="NAME", help="heuristic that adapts the support (default: edge)"
    )
    parser.add_argument(
        "--preset", choices=("quick", "paper"), default="quick", help="settings of all stages (default: quick)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of all stages (default: 0)")
    parser.add_argument(
        "--iterations", type=int, default=4, metavar="N", help="largest number of iterations of the loop (default: 4)"
    )
    parser.add_argument(
        "--settled",
        type=float,
        default=SETTLED,
        metavar="X",
        help="the loop ends once no median moves by more than X half-widths of its 90 %% interval (default: 0.5)",
    )
    parser.add_argument(
        "--excitation", type=float, metavar="S", help="duration of the first recording (default: that of an episode)"
    )
    parser.add_argument(
        "--episodes",
        type=int,
        default=EPISODES,
        metavar="N",
        help="number of episodes in the final comparison of policies (default: 8)",
    )
    parser.add_argument(
        "--beside",
        nargs="*",
        choices=beside.ARMS,
        default=["uniform"],
        metavar="ARM",
        help="further domains to train and deploy policies on, for comparison: uniform (the first guess), point (the "
        "least-squares estimate of jaxlfi mujoco fit), sysid (that of mujoco.sysid) (default: uniform)",
    )
    parser.add_argument(
        "--total-steps", type=int, metavar="N", help="environment steps of each training (default: the preset's)"
    )
    parser.add_argument(
        "--infer",
        default="",
        metavar="WORDS",
        help="further arguments for jaxlfi infer, as in '--rounds 3 --epochs 50'; a single one as --infer=--polish",
    )
    parser.add_argument(
        "--train",
        default="",
        metavar="WORDS",
        help="further arguments for jaxlfi train, as in '--environments 64'",
    )
    loops.add_explore(parser)
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")


def _loop(arguments: argparse.Namespace) -> int:
    require_mujoco()
    config = _config(arguments.task)
    _begin(arguments, config)
    from jaxlfi.envs.mujoco.r2s2r_page import write
    from jaxlfi.io import compile_cache

    compile_cache.enable()
    try:
        recordings, iterations = _round_and_round(arguments, config)
        policies = {f"iteration {i}": path for i, path in enumerate(iterations, 1)}
        for arm in arguments.beside:
            domain = beside.domain_of(arm, arguments.task, recordings, arguments.out)
            policies[arm] = _train(arguments, domain, arguments.out / arm / "policy")
        _deploy(arguments, config, policies)
    except loops.StageError as stage:
        return stage.status
    print(f"wrote {write(arguments, config, policies)}")
    return 0


# ------------------------------------------------------------------------------------------------------------ stages


def _config(task: str) -> Path:
    """The file of a task as `jaxlfi infer` takes it."""
    name, options = references.parse(task, "task")
    if name != "mujoco" or set(options) != {"config"}:
        raise ValueError(f"task: expected mujoco,config=FILE, got {task!r}")
    return Path(options["config"])


def _begin(arguments: argparse.Namespace, config: Path) -> None:
    """Check all arguments at once, and make the folder or recognise it."""
    from jaxlfi.envs.mujoco.environment import environment
    from jaxlfi.envs.mujoco.served import Machine
    from jaxlfi.rl.settings import PRESETS
    from jaxlfi.robots import wire

    environment(config)
    if arguments.iterations < 1 or arguments.episodes < 1:
        raise ValueError(
            f"iterations, episodes: expected at least 1, got {arguments.iterations} and {arguments.episodes}"
        )
    for name in ("settled", "excitation"):
        if (value := getattr(arguments, name)) is not None and not 0 < value < math.inf:
            raise ValueError(f"{name}: expected a number above 0, got {value:g}")
    beside.check(arguments.beside)
    if arguments.explore == "design":
        _require_design(config)
    train.check_seeds(arguments.seed, 1, "seed")
    loops.check_design(arguments)
    HEURISTICS.load(arguments.heuristic)
    if arguments.total_steps is not None:
        PRESETS[arguments.preset].replace(total_steps=arguments.total_steps)
    command_line.parse(_infer_words(arguments, [Path("recording.csv")], arguments.out))
    train.main.parser().parse_args(_train_words(arguments, "uniform", arguments.out))
    if arguments.address is None:
        if arguments.remote or arguments.token or arguments.confirm:
            raise ValueError("remote, token, confirm: expected with --address only, got a simulated machine")
        Machine.of(config)
    else:
        token = None if arguments.token is None else wire.token_of(arguments.token)
        host, _ = wire.address(arguments.address, arguments.remote)
        if token is None and not wire.is_local(host):
            raise ValueError(f"token: expected the one that the robot at {host}, another host, shares; got none")
    # A driver may be started anew at another address.
    asked = loops.asked_of(arguments, ("out", "debug", "address", "remote", "token", "confirm"))
    loops.begin(arguments.out, asked | {"machine": "simulated" if arguments.address is None else "at an address"})


def _require_design(config: Path) -> None:
    """Refuse a task whose design a loop cannot play.

    Raises:
        ValueError: saying what its file lacks, or what in it would need an operator.
    """
    from jaxlfi.envs.mujoco import config as tables

    table = tables.load(config).get("design")
    if table is None:
        raise ValueError(f"explore: design: expected a table [design] in {config}, got none")
    if table.get("initial"):
        raise ValueError(f"explore: design: expected controls only in the table [design] of {config}, got initial")


def _round_and_round(arguments: argparse.Namespace, config: Path) -> tuple[list[Path], list[Path]]:
    """All recordings, and the policies of the iterations; the loop ends once the posterior has stopped moving."""
    from jaxlfi.runs.load import load

    out, policies, posteriors = arguments.out, [], []
    recordings = [machine.excited(arguments, config, out / "excitation.csv")]
    for iteration in range(1, arguments.iterations + 1):
        folder = out / f"iteration_{iteration}"
        folder.mkdir(exist_ok=True)
        posteriors.append(_infer(arguments, recordings, folder / "posterior"))
        policies.append(_train(arguments, str(posteriors[-1]), folder / "policy"))
        if len(posteriors) > 1:
            far = loops.moved(*(load(each) for each in posteriors[-2:]))
            loops.say(f"the posterior has moved by {far:.2g} half-widths of its 90 % intervals")
            if far <= arguments.settled:
                break
        if iteration < arguments.iterations:
            explore = EXPLORE[arguments.explore]
            recordings.append(explore(arguments, config, posteriors[-1], policies[-1], folder, iteration))
    return recordings, policies


def _by_policy(arguments, config: Path, posterior: Path, policy: Path, folder: Path, iteration: int) -> Path:
    return machine.rolled_out(arguments, config, policy, folder / "rollout.csv", iteration)


def _by_design(arguments, config: Path, posterior: Path, policy: Path, folder: Path, iteration: int) -> Path:
    controls = loops.designed(arguments, posterior, folder / "design")
    return machine.played(arguments, config, controls, folder / "rollout.csv", iteration)


EXPLORE = {"policy": _by_policy, "design": _by_design}
"""How the next recording is made: by the newest policy, or by the experiment that is most informative."""


def _train(arguments: argparse.Namespace, domain: str, out: Path) -> Path:
    if not (out / "curves.png").exists():  # the last of its files
        words = _train_words(arguments, domain, out)
        _begin_or_resume(train.main, words, out, f"a policy on {domain}")
    return next(out.glob("*/seed_*/policy.npz"))


def _train_words(arguments: argparse.Namespace, domain: str, out: Path) -> list[str]:
    words = [arguments.task, "--domain", domain, "--out", str(out), "--preset", arguments.preset]
    words += shlex.split(f"--first-seed {arguments.seed} {arguments.train}")
    return words + ([] if arguments.total_steps is None else ["--total-steps", str(arguments.total_steps)])


def _infer(arguments: argparse.Namespace, recordings: Sequence[Path], out: Path) -> Path:
    if not (out / "report.html").exists():  # the last of its files
        _begin_or_resume(command_line.main, _infer_words(arguments, recordings, out), out, "what the machine may be")
        if not (out / "report.html").exists():  # it was stopped while it drew its pictures
            loops.done(command_line.main, [], ["report", str(out)], "its pictures")
    return out


def _infer_words(arguments: argparse.Namespace, recordings: Sequence[Path], out: Path) -> list[str]:
    logs = ";".join(map(str, recordings))
    words = ["infer", f"{arguments.task},log={logs}", "--heuristic", arguments.heuristic, "--preset", arguments.preset]
    return [*words, "--first-seed", str(arguments.seed), *shlex.split(arguments.infer), "--out", str(out)]


def _begin_or_resume(run: Callable[[list[str]], int], words: list[str], out: Path, what: str) -> None:
    prefix = lambda run: ["train"] if run is train.main else []
    do = lambda run, words: loops.done(run, prefix(run), words, what)
    loops.begin_or_resume(run, command_line.main, words, out, do)


def _deploy(arguments: argparse.Namespace, config: Path, policies: dict[str, Path]) -> None:
    """Run policies on the machine, with the same starts and noise for all of them if it is simulated."""
    from jaxlfi.envs.mujoco import excitation
    from jaxlfi.io import files

    out = arguments.out / "deployed"
    out.mkdir(exist_ok=True)
    if (out / "table.csv").exists():
        return
    rows = []
    for name, policy in policies.items():
        paths = [out / f"{name.replace(' ', '_')}_{episode}.csv" for episode in range(arguments.episodes)]
        for first, some in _missing(paths):
            loops.say(f"the policy of {beside.TITLES.get(name, name)} on the machine, {len(some)} times")
            with machine.connected(arguments, config, arguments.seed, scattered=True, first=first) as driver:
                for path in some:
                    machine.controlled(driver(), policy, config, path)
        for episode, path in enumerate(paths):
            rows.append({"policy": name, "episode": episode, **excitation.achieved(config, path)})
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    files.write_bytes(out / "table.csv", text.getvalue().encode())


def _missing(paths: Sequence[Path]) -> list[tuple[int, list[Path]]]:
    """Recordings that are still to be made, in groups of consecutive ones, each with the number of its first."""
    found: list[tuple[int, list[Path]]] = []
    for number, path in enumerate(paths):
        if machine.whole(path):
            continue
        if found and found[-1][0] + len(found[-1][1]) == number:
            found[-1][1].append(path)
        else:
            found.append((number, [path]))
    return found


main = Command(
    "r2s2r",
    "run the full Real2Sim2Real loop on a machine",
    _arguments,
    _loop,
    description="Excite a machine, infer its parameters, train a policy on the posterior, record the policy on the "
    "machine, and infer again, until the posterior settles. Repeating the command continues an interrupted run.",
    epilog=EXAMPLES,
    begun=lambda arguments: "; the same command goes on from here" if (arguments.out / CONFIG).exists() else "",
)
parser = main.parser


if __name__ == "__main__":
    sys.exit(main())
