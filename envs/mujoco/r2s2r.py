"""The loop of a MuJoCo task: from a machine to a policy for it, and back, until the posterior stops moving.

excitation.csv             what the machine does under sines: the first recording
iteration_1/posterior/     what it may be (jaxlfi infer), from all recordings so far
iteration_1/policy/        a policy on that posterior (jaxlfi train)
iteration_1/rollout.csv    that policy on the machine (jaxlfi control)
iteration_2/ ...           likewise, with that recording besides
uniform/                   a policy on the uniform box, to compare with
deployed/                  all policies on the machine, from scattered starts
page.html

Every stage is a command of its own in a folder of its own. Repeating the command continues an interrupted run. The
machine is a driver at an address, or by default one that is simulated in another process, with another integrator and
effects that no parameter is for (`jaxlfi.envs.mujoco.served`). It begins each recording where the task says that
recordings begin. This module imports neither jax nor numpy before it has to, so that `--help` answers at once.
"""

import argparse
import contextlib
import math
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from jaxlfi import flags, references
from jaxlfi.cli import loops, train
from jaxlfi.cli import parser as command_line
from jaxlfi.cli.command import Command
from jaxlfi.envs.mujoco import require_mujoco
from jaxlfi.io.formats import CONFIG
from jaxlfi.registry import HEURISTICS

EXAMPLES = """\
examples:
  jaxlfi r2s2r mujoco,config=examples/mujoco/furuta.toml --out runs/loop
  jaxlfi r2s2r mujoco,config=my-arm.toml --address 127.0.0.1:5005 --iterations 3 --out runs/my-arm

"""
SETTLED = 0.5
"""Half-widths of 90 % intervals by which medians move at most once a posterior has stopped moving."""
EPISODES = 8
"""On the machine, by which policies are compared."""


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("task", metavar="mujoco,config=FILE", help="the task, whose file has a table [policy]")
    parser.add_argument(
        "--out", type=flags.output, required=True, metavar="DIR", help="a folder, new or of the same command"
    )
    parser.add_argument(
        "--address", metavar="HOST:PORT", help="address of the machine's driver (default: a simulated machine)"
    )
    parser.add_argument("--remote", action="store_true", help="allow a driver on another host; needs --token")
    parser.add_argument("--token", type=Path, metavar="FILE", help="a file with the token that the driver asks for")
    parser.add_argument(
        "--heuristic", default="edge", metavar="NAME", help="how the support is adapted (default: edge)"
    )
    parser.add_argument(
        "--preset", choices=("quick", "paper"), default="quick", help="settings of all stages (default: quick)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of all stages (default: 0)")
    parser.add_argument(
        "--iterations", type=int, default=4, metavar="N", help="number of times around the loop, at most (default: 4)"
    )
    parser.add_argument(
        "--settled",
        type=float,
        default=SETTLED,
        metavar="X",
        help="the loop ends once no median has moved by more than X half-widths of its 90 %% interval (default: 0.5)",
    )
    parser.add_argument(
        "--excitation", type=float, metavar="S", help="length of the first recording (default: an episode's)"
    )
    parser.add_argument(
        "--episodes",
        type=int,
        default=EPISODES,
        metavar="N",
        help="episodes that policies are compared by (default: 8)",
    )
    parser.add_argument(
        "--total-steps", type=int, metavar="N", help="environment steps of each training (default: the preset's)"
    )
    parser.add_argument(
        "--infer", default="", metavar="WORDS", help="further words of jaxlfi infer, as '--rounds 3 --epochs 50'"
    )
    parser.add_argument(
        "--train", default="", metavar="WORDS", help="further words of jaxlfi train, as '--environments 32'"
    )
    parser.add_argument("--debug", action="store_true", help="show where an error came from")


def _loop(arguments: argparse.Namespace) -> int:
    require_mujoco()
    config = _config(arguments.task)
    _begin(arguments, config)
    from jaxlfi.envs.mujoco.r2s2r_page import write
    from jaxlfi.io import compile_cache

    compile_cache.enable()
    try:
        iterations = _round_and_round(arguments, config)
        policies = {"uniform box": _train(arguments, "uniform", arguments.out / "uniform")}
        policies |= {f"iteration {i}": path for i, path in enumerate(iterations, 1)}
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
    """Check everything at once, and make the folder or recognise it."""
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
    train.check_seeds(arguments.seed, 1, "seed")
    HEURISTICS.load(arguments.heuristic)
    if arguments.total_steps is not None:
        PRESETS[arguments.preset].replace(total_steps=arguments.total_steps)
    command_line.parse(_infer_words(arguments, [Path("recording.csv")], arguments.out))
    train.main.parser().parse_args(_train_words(arguments, "uniform", arguments.out))
    if arguments.address is None:
        Machine.of(config)
    else:
        token = None if arguments.token is None else wire.token_of(arguments.token)
        host, _ = wire.address(arguments.address, arguments.remote)
        if token is None and not wire.is_local(host):
            raise ValueError(f"token: expected the one that the robot at {host}, another host, shares; got none")
    loops.begin(arguments.out, loops.asked_of(arguments))


def _round_and_round(arguments: argparse.Namespace, config: Path) -> list[Path]:
    """The policies of the iterations; the loop ends once the posterior has stopped moving."""
    from jaxlfi.runs.load import load

    out, policies, posteriors = arguments.out, [], []
    recordings = [_excite(arguments, config, out / "excitation.csv")]
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
            recordings.append(_rollout(arguments, config, policies[-1], folder / "rollout.csv", iteration))
    return policies


def _excite(arguments: argparse.Namespace, config: Path, path: Path) -> Path:
    """What the machine measures under sines of its actuators."""
    from jaxlfi.envs.mujoco import excitation

    if not path.with_suffix(".json").exists():
        loops.say("the machine under sines of its actuators")
        with _machine(arguments, config, arguments.seed) as driver:
            excitation.record(driver(), config, path, arguments.excitation, arguments.seed)
    return path


def _rollout(arguments: argparse.Namespace, config: Path, policy: Path, path: Path, iteration: int) -> Path:
    """What a policy does on the machine; a recording that a limit ended is one, too."""
    if not path.with_suffix(".json").exists():
        loops.say(f"{policy} on the machine")
        with _machine(arguments, config, arguments.seed + iteration) as driver:
            _controlled(driver(), policy, config, path)
    return path


def _controlled(driver: Any, policy: Path, config: Path, path: Path) -> None:
    from jaxlfi.envs.mujoco import excitation
    from jaxlfi.rl import policy as policies
    from jaxlfi.robots import driving, sessions
    from jaxlfi.robots.robot import RobotError

    trained = policies.load(policy)
    settings = excitation.measuring(driving.settings_of(trained), config)
    for left in (path, path.with_suffix(".loop.npz")):
        left.unlink(missing_ok=True)  # of a rollout that was not written to its end
    try:
        sessions.of(trained, settings).run(driver, path, {"policy": str(policy)}, say=print)
    except RobotError as error:
        if not path.exists():
            raise
        print(f"{error}; the recording ends there")


def _train(arguments: argparse.Namespace, domain: str, out: Path) -> Path:
    if not (out / "curves.png").exists():  # the last of its files
        words = _train_words(arguments, domain, out)
        _begin_or_resume(train.main, words, out, f"a policy on {domain}")
    return next(out.glob("*/seed_*/policy.npz"))


def _train_words(arguments: argparse.Namespace, domain: str, out: Path) -> list[str]:
    words = [arguments.task, "--domain", domain, "--out", str(out), "--preset", arguments.preset]
    words += ["--first-seed", str(arguments.seed), *arguments.train.split()]
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
    return [*words, "--first-seed", str(arguments.seed), *arguments.infer.split(), "--out", str(out)]


def _begin_or_resume(run: Callable[[list[str]], int], words: list[str], out: Path, what: str) -> None:
    prefix = lambda run: ["train"] if run is train.main else []
    do = lambda run, words: loops.done(run, prefix(run), words, what)
    loops.begin_or_resume(run, command_line.main, words, out, do)


def _deploy(arguments: argparse.Namespace, config: Path, policies: dict[str, Path]) -> None:
    """How policies fare on the machine: the same starts and noise for all of them, where it is simulated."""
    from jaxlfi.envs.mujoco import excitation
    from jaxlfi.io import files

    out = arguments.out / "deployed"
    out.mkdir(exist_ok=True)
    if (out / "table.csv").exists():
        return
    rows = []
    for name, policy in policies.items():
        loops.say(f"the policy of {name} on the machine, {arguments.episodes} times")
        with _machine(arguments, config, arguments.seed, scattered=True) as driver:
            for episode in range(arguments.episodes):
                path = out / f"{name.replace(' ', '_')}_{episode}.csv"
                if not path.with_suffix(".json").exists():
                    _controlled(driver(), policy, config, path)
                rows.append({"policy": name, "episode": episode, **excitation.achieved(config, path)})
    lines = [",".join(map(str, rows[0])), *(",".join(map(str, row.values())) for row in rows)]
    files.write_bytes(out / "table.csv", ("\n".join(lines) + "\n").encode())


@contextlib.contextmanager
def _machine(
    arguments: argparse.Namespace, config: Path, seed: int, scattered: bool = False
) -> Iterator[Callable[[], Any]]:
    """Makes drivers of the machine; a simulated one in a process that ends with the context."""
    from jaxlfi.robots import wire
    from jaxlfi.robots.client import SocketDriver

    if arguments.address is not None:
        token = None if arguments.token is None else wire.token_of(arguments.token)
        yield lambda: SocketDriver(arguments.address, arguments.remote, token)
        return
    words = [sys.executable, "-m", "jaxlfi.envs.mujoco.cli", "serve", str(config), "--seed", str(seed)]
    words += ["--scattered"] if scattered else []
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        line = process.stdout.readline() if process.stdout else ""
        if not line:
            raise ValueError(
                f"robot: expected a simulated machine that listens, got one that ended: jaxlfi mujoco serve {config} "
                "says why"
            )
        yield lambda: SocketDriver(line.split()[-1])
    finally:
        process.terminate()
        process.wait()
        if process.stdout:
            process.stdout.close()


main = Command(
    "r2s2r",
    "run the full Real2Sim2Real loop on a machine",
    _arguments,
    _loop,
    description="From a machine to a policy for it: excite it, infer its parameters, train a policy on the posterior, "
    "record it on the machine, and infer again, until the posterior stops moving. Repeating the command continues an "
    "interrupted run.",
    epilog=EXAMPLES,
    begun=lambda arguments: "; the same command goes on from here" if (arguments.out / CONFIG).exists() else "",
)
parser = main.parser


if __name__ == "__main__":
    sys.exit(main())
