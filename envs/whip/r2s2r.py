"""The command `jaxlfi r2s2r`: from a real object to a policy for it, and back (Algorithm 1 with lines 3, 4 and 19-22).

policy_0/                  the first policy, on the uniform distribution over Theta_0 (jaxlfi train)
iteration_1/rollout.npz    that policy on the object, as its camera sees it: x^r
iteration_1/posterior/     the posterior of the object's parameters (jaxlfi infer)
iteration_1/policy/        a policy on that posterior (jaxlfi train)
iteration_2/ ...           likewise, with the new policy's rollout added; or, with --explore design, that of the whip
                           that is most informative about the last posterior (iteration_2/design, jaxlfi design)
deployed/                  all these policies on the object, at displaced places (jaxlfi whip deploy)
page.html film.gif sheet.png

Every stage is a command of its own in a folder of its own. Repeating the command continues an interrupted run. This
module imports jax and numpy only when it needs them, so that `--help` answers at once.
"""

import argparse
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from jaxlfi import flags
from jaxlfi.cli import loops, train
from jaxlfi.cli import parser as command_line
from jaxlfi.cli.command import Command
from jaxlfi.envs.whip import cli as whip
from jaxlfi.envs.whip import require_mujoco
from jaxlfi.envs.whip.vision import options
from jaxlfi.io.formats import CONFIG
from jaxlfi.registry import HEURISTICS

EXAMPLES = """\
examples:
  jaxlfi r2s2r --object dlo-0 --heuristic edge --out runs/r2s2r
  jaxlfi r2s2r --object dlo-3 --policy runs/uniform/uniform/seed_000/policy.npz --iterations 2 --out runs/twice
  jaxlfi r2s2r --object dlo-0 --recording my-rollout.npz --out runs/recorded
  jaxlfi r2s2r --object dlo-0 --detector learnt --out runs/seen
  jaxlfi r2s2r --object dlo-0 --iterations 2 --explore design --out runs/designed
  jaxlfi r2s2r --object dlo-0 --reward settled --out runs/settled
  jaxlfi r2s2r mujoco,config=examples/mujoco/furuta.toml --out runs/loop      any machine: jaxlfi r2s2r mujoco --help

"""


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--object", required=True, metavar="NAME", help="dlo-0, dlo-1, dlo-2 or dlo-3")
    parser.add_argument(
        "--out",
        type=flags.output,
        required=True,
        metavar="DIR",
        help="a new folder, or that of the same command to continue it",
    )
    parser.add_argument(
        "--heuristic", default="edge", metavar="NAME", help="heuristic that adapts the support (default: edge)"
    )
    parser.add_argument(
        "--preset", choices=("quick", "paper"), default="quick", help="settings of all stages (default: quick)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of all stages (default: 0)")
    parser.add_argument(
        "--iterations", type=int, default=1, metavar="N", help="number of iterations of the loop (default: 1)"
    )
    parser.add_argument(
        "--total-steps", type=int, metavar="N", help="environment steps of each training (default: the preset's)"
    )
    parser.add_argument(
        "--reward", metavar="NAME", help="what all policies are rewarded for: paper (default), ordered or settled"
    )
    parser.add_argument("--policy", type=Path, metavar="FILE", help="a policy.npz that replaces the first training")
    parser.add_argument("--recording", type=Path, metavar="FILE", help="a recorded rollout that replaces the first one")
    parser.add_argument(
        "--posterior", type=Path, metavar="RUN", help="a finished run that replaces the first inference"
    )
    options.add_detector(parser)
    loops.add_explore(parser)
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")


def _loop(arguments: argparse.Namespace) -> int:
    require_mujoco()
    _begin(arguments)
    from jaxlfi.envs.whip.r2s2r_page import write
    from jaxlfi.io.locks import locked

    with locked(arguments.out):
        try:
            policies = _round_and_round(arguments)
            _deploy(arguments, policies)
        except loops.StageError as stage:  # the stage has printed the reason
            return stage.status
        print(f"wrote {write(arguments, policies)}")
        return 0


# ------------------------------------------------------------------------------------------------------------ stages


def _begin(arguments: argparse.Namespace) -> None:
    """Check all arguments before anything runs, and make the folder or recognise it."""
    from jaxlfi.cli.domains import domain
    from jaxlfi.envs.whip import rewards
    from jaxlfi.envs.whip.environment import ACTIONS, OBSERVATIONS, make
    from jaxlfi.envs.whip.real2sim import recorded
    from jaxlfi.envs.whip.reference_objects import objects
    from jaxlfi.envs.whip.vision.commands import perceptions
    from jaxlfi.rl import policy
    from jaxlfi.rl.settings import PRESETS

    objects.load(arguments.object)
    if arguments.iterations < 1:
        raise ValueError(f"iterations: expected at least 1, got {arguments.iterations}")
    if arguments.explore == "design" and arguments.iterations < 2:
        raise ValueError("iterations: expected at least 2 with --explore design, which needs a posterior, got 1")
    train.check_seeds(arguments.seed, 1, "seed")
    loops.check_design(arguments)
    HEURISTICS.load(arguments.heuristic)
    if arguments.reward is not None:
        rewards.check(arguments.reward)
    if arguments.total_steps is not None:
        PRESETS[arguments.preset].replace(total_steps=arguments.total_steps)
    if arguments.policy:
        policy.load(arguments.policy).require("whip", OBSERVATIONS, ACTIONS)
    if arguments.recording:
        recorded(str(arguments.recording))
    if arguments.posterior:
        domain(make(), str(arguments.posterior))
    with perceptions(arguments.detector, arguments.renderer, arguments.weights):
        pass
    loops.begin(arguments.out, loops.asked_of(arguments))


def _round_and_round(arguments: argparse.Namespace) -> list[Path]:
    """The files of all policies, in order."""
    out = arguments.out
    policies = [arguments.policy or _train(arguments, "uniform", out / "policy_0")]
    rollouts: list[Path] = []
    run: Path | None = None
    for iteration in range(1, arguments.iterations + 1):
        folder = out / f"iteration_{iteration}"
        folder.mkdir(exist_ok=True)
        given = arguments.recording if iteration == 1 else None
        rollouts.append(given or EXPLORE[arguments.explore](arguments, run, policies[-1], folder, iteration))
        run = arguments.posterior if iteration == 1 else None
        run = run or _infer(arguments, rollouts, folder / "posterior")
        policies.append(_train(arguments, str(run), folder / "policy"))
    return policies


def _by_policy(arguments, run: Path | None, policy: Path, folder: Path, iteration: int) -> Path:
    return _rollout(arguments, policy, folder / "rollout.npz", iteration)


def _by_design(arguments, run: Path | None, policy: Path, folder: Path, iteration: int) -> Path:
    """The first rollout is the policy's, as there is no posterior yet."""
    acts = policy if run is None else loops.designed(arguments, run, folder / "design")
    return _rollout(arguments, acts, folder / "rollout.npz", iteration)


EXPLORE = {"policy": _by_policy, "design": _by_design}
"""How the next rollout is made: by the newest policy, or by the whip that is most informative."""


def _train(arguments: argparse.Namespace, domain: str, out: Path) -> Path:
    if not (out / "curves.png").exists():  # the last of its files
        words = [_whip(arguments), "--domain", domain, "--out", str(out)]
        words += ["--preset", arguments.preset, "--first-seed", str(arguments.seed)]
        words += [] if arguments.total_steps is None else ["--total-steps", str(arguments.total_steps)]
        words += [] if arguments.reward is None else ["--reward", arguments.reward]
        _begin_or_resume(train.main, words, out, f"a policy on {domain}")
    return next(out.glob("*/seed_*/policy.npz"))


def _begin_or_resume(run: Callable[[list[str]], int], words: list[str], out: Path, what: str) -> None:
    """Run a stage as a command of these words, or what is left of it."""
    loops.begin_or_resume(run, command_line.main, words, out, lambda run, words: _command(run, words, what))


def _whip(arguments: argparse.Namespace) -> str:
    """The simulator, whose keypoints have the errors of the detector that sees the object."""
    return "whip" if arguments.detector == "centreline" else f"whip,detector={arguments.detector}"


def _rollout(arguments: argparse.Namespace, acts: Path, path: Path, iteration: int) -> Path:
    """Record a policy, or planned actions, on the object at the nominal place, as the camera sees it."""
    if path.with_suffix(".json").exists():
        return path
    import jax

    from jaxlfi.envs.whip import recording
    from jaxlfi.envs.whip.reference_objects.deployment import deploy
    from jaxlfi.envs.whip.reference_objects.objects import load
    from jaxlfi.envs.whip.reference_objects.repetitions import acting
    from jaxlfi.envs.whip.vision.commands import perceptions

    loops.say(f"a rollout of {acts} on {arguments.object}")
    key = jax.random.fold_in(jax.random.key(arguments.seed), iteration)
    with perceptions(arguments.detector, arguments.renderer, arguments.weights) as perception_of:
        act, dlo = acting(str(acts))(), load(arguments.object)
        deployed = deploy(key, dlo, act, whole=True, perception=perception_of(jax.random.fold_in(key, 2**31 - 1)))
    if deployed.recording is None:
        raise ValueError(f"{acts}: expected a rollout that can be recorded, got an unstable simulation")
    path.unlink(missing_ok=True)  # left by a rollout that was not completely written
    recording.write(path, deployed.recording)
    return path


def _infer(arguments: argparse.Namespace, rollouts: Sequence[Path], out: Path) -> Path:
    if not (out / "report.html").exists():  # the last of its files
        words = ["infer", _whip(arguments), "--object", *map(str, rollouts), "--heuristic", arguments.heuristic]
        words += ["--preset", arguments.preset, "--first-seed", str(arguments.seed), "--out", str(out)]
        _begin_or_resume(command_line.main, words, out, f"what {arguments.object} may be")
        if not (out / "report.html").exists():  # it was stopped while it drew its pictures
            _command(command_line.main, ["report", str(out)], "its pictures")
    return out


def _deploy(arguments: argparse.Namespace, policies: Sequence[Path]) -> None:
    from jaxlfi.envs.whip.r2s2r_page import REPETITIONS

    out = arguments.out / "deployed"
    if not (out / "table.csv").exists():
        shutil.rmtree(out, ignore_errors=True)
        words = ["deploy", *map(str, policies), "--object", arguments.object, "--repetitions", str(REPETITIONS)]
        words += ["--seed", str(arguments.seed), "--out", str(out)]
        words += ["--detector", arguments.detector, "--renderer", arguments.renderer]
        words += ["--weights", str(arguments.weights)] if arguments.weights else []
        _command(whip.main, words, f"all policies on {arguments.object}")


def _command(run: Callable[[list[str]], int], words: list[str], what: str) -> None:
    loops.done(run, {train.main: ["train"], whip.main: ["whip"]}.get(run, []), words, what)


main = Command(
    "r2s2r",
    "run the full Real2Sim2Real loop on a reference object",
    _arguments,
    _loop,
    description="Train a first policy on the uniform distribution, record it on a reference object, infer the "
    "object's parameters, train a policy on the posterior, and deploy both policies on the object. Repeating the "
    "command continues an interrupted run.",
    epilog=EXAMPLES,
    begun=lambda arguments: "; the same command goes on from here" if (arguments.out / CONFIG).exists() else "",
)
parser = main.parser


if __name__ == "__main__":
    sys.exit(main())
