"""The command `jaxlfi train`: training of policies on domains by PPO.

This module imports neither jax nor numpy before it has to, so that `--help` answers at once.
"""

import argparse
import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxlfi import flags
from jaxlfi.cli import multi_process
from jaxlfi.cli.command import Command
from jaxlfi.cli.domains import DOMAINS, domains_of
from jaxlfi.cli.exit_status import removed_if, resuming
from jaxlfi.cli.own_fields import FIELDS, POLICIES
from jaxlfi.io.formats import TRAINING, recorded
from jaxlfi.io.shell import quoted
from jaxlfi.registry import ENVIRONMENTS

if TYPE_CHECKING:
    from rich.console import Console

    from jaxlfi.cli.tables import Output
    from jaxlfi.io.processes import Processes
    from jaxlfi.rl.environment import Environment

PRESETS = ("quick", "paper")
MAX_SEEDS = 1000
"""Largest number of parallel trainings on a domain."""
SETTINGS = "jaxlfi.rl.settings:PPO"
"""The class whose fields are the settings of a training."""

EXAMPLES = f"""\
{DOMAINS}
Each environment draws a point from its domain and keeps it, as in the paper; with --redrawn it draws a new one for
every episode. All domains and seeds are trained in parallel, and evaluated without exploration noise on 128 held-out
points of their domain.

examples:
  jaxlfi train whip --domain uniform --seeds 4 --out runs/uniform
  jaxlfi train whip --domain runs/dlo-0 uniform median --seeds 4 --out runs/policies
  jaxlfi train whip,detector=clean --domain point:200,1e5 --total-steps 30000 --out runs/point
  jaxlfi train whip --domain runs/dlo-0 --start runs/uniform/uniform/seed_000/policy.npz \\
    --initial-deviation 0.2 --out runs/tuned     fine-tune an earlier policy
  jaxlfi train whip --domain uniform --critic theta --out runs/privileged    the value function sees theta
  jaxlfi train whip --domain uniform --reward settled --out runs/settled      rewarded once the scene has settled
  jaxlfi train whip --domain uniform --seeds 2 --tensorboard --out runs/watched
  jaxlfi train whip --domain uniform --seeds 16 --out runs/many --coordinator 10.0.0.5:1234 --processes 2 \\
    --process-id 0                               on 10.0.0.5; use --process-id 1 on the other host
  jaxlfi resume runs/policies                    continue after a crash; the policies are bit-for-bit the same

"""


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "environment",
        metavar="ENVIRONMENT",
        help="an environment's name, such as whip, or module:factory; NAME,key=value sets options",
    )
    parser.add_argument(
        "--domain",
        nargs="+",
        required=True,
        metavar="DOMAIN",
        help="training domains; separate policies are trained on each",
    )
    parser.add_argument(
        "--out", type=flags.output, required=True, metavar="DIR", help="a new or empty folder for the results"
    )
    parser.add_argument(
        "--preset", choices=PRESETS, default="quick", help="the settings to start from (default: quick)"
    )
    parser.add_argument(
        "--seeds", type=int, default=1, metavar="N", help="number of trainings on each domain (default: 1)"
    )
    parser.add_argument(
        "--first-seed", type=int, default=0, metavar="N", help="seed of the first training (default: 0)"
    )
    parser.add_argument(
        "--start",
        type=Path,
        metavar="POLICY",
        help="a policy.npz with the same signals and actions, from which all trainings start",
    )
    parser.add_argument(
        "--reward",
        metavar="NAME",
        help="reward, if the environment has several; for whip: paper (default), ordered or settled",
    )
    parser.add_argument(
        "--tensorboard", action="store_true", help="write learning curves while training: tensorboard --logdir DIR"
    )
    parser.add_argument("--no-figures", action="store_true", help="do not draw figures")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    multi_process.add_flags(parser)
    group = parser.add_argument_group("PPO (default: the preset's)")
    flags.add(group, {"PPO": FIELDS[SETTINGS]}, into="settings", presets=POLICIES)
    parser.set_defaults(settings={})


def _train(arguments: argparse.Namespace) -> None:
    from jaxlfi.cli import tables
    from jaxlfi.io import compile_cache
    from jaxlfi.io.locks import locked

    compile_cache.enable()
    if arguments.reward is not None:
        arguments.environment += f",reward={arguments.reward}"
    processes = multi_process.join(arguments)
    from jaxlfi.rl import training

    if not processes.writes:
        training.resumed(
            arguments.out, ENVIRONMENTS.load(arguments.environment), lambda updates, curves: None, processes
        )
        processes.leave()
        return
    plan = _plan(arguments)
    training.begin(plan, arguments.out, processes)
    empty = lambda: not (training.updates_done(arguments.out) or training.finished(arguments.out))
    with removed_if(arguments.out, empty):
        with locked(arguments.out):
            run(arguments.out, plan.environment, tables.Output.of(), not arguments.no_figures, processes)
        processes.leave()


def run(
    out: Path, environment: "Environment", output: "Output", figures: bool, processes: "Processes | None" = None
) -> None:
    """Run the trainings of a folder, print how the policies perform, and draw the learning curves.

    The trainings are shared among `processes`, by default this one alone.
    """
    import numpy as np
    from rich.markup import escape
    from rich.table import Table

    from jaxlfi.cli import tables
    from jaxlfi.io.processes import ALONE
    from jaxlfi.io.progress import RoundProgress
    from jaxlfi.rl import tensorboard, training

    config = training.read_config(out)
    settings = training.settings_of(config)
    names = [(one["domain"], one["seed"]) for one in config["trainings"]]
    count = len(names)
    label = f"{environment.name}: {count} {'policy' if count == 1 else 'policies in parallel'}"
    with contextlib.ExitStack() as stack:
        progress = RoundProgress(output.notes, settings.updates, training.updates_done(out), label, unit="update")
        stack.enter_context(progress)
        scalars = None
        if config.get("tensorboard"):
            scalars = stack.enter_context(tensorboard.Scalars(out, names, settings.steps_per_update))

        def on_chunk(updates: int, curves: Mapping[str, Any]) -> None:
            values = curves["value"][-updates:]
            known = values[np.isfinite(values)]  # updates in which an episode ended
            progress.advance(updates, f", return {tables.numbers([known.mean()])[0]}" if known.size else "")
            if scalars:
                scalars.write(curves)

        result = training.resumed(out, environment, on_chunk, processes or ALONE)
        if scalars:
            scalars.write(result.curves)  # not called if nothing was left to train
    rows = [result.fared(place) for place in range(len(result.names))]
    table = Table("domain", "seed", *rows[0], title=f"on {training.HELD_OUT} other points of each domain")
    columns = [tables.numbers([row[name] for row in rows]) for name in rows[0]]
    for (trained_on, seed), *cells in zip(result.names, *columns, strict=True):
        table.add_row(escape(trained_on), str(seed), *cells)
    tables.show(table, output.results)
    say = lambda line: output.notes.print(line, markup=False, soft_wrap=True, highlight=False)
    say(
        "return: sum of an episode's rewards, mean over the points; worst tenth: mean over the tenth of the points "
        "with the lowest returns; at first: at the start of training, with exploration noise"
    )
    say(f"policies: {out}/DOMAIN/seed_NNN/policy.npz")
    evaluate = f"jaxlfi evaluate {quoted(config['environment'])} {out}/*/*/policy.npz --domain DOMAIN ..."
    if config["environment"] is not None:
        say(f"on other domains, all on the same episodes: {evaluate}")
    if figures:
        draw(out, output.notes)


def draw(out: Path, console: "Console") -> None:
    """Draw the learning curves of a finished training."""
    from jaxlfi.figures import learning
    from jaxlfi.io import files
    from jaxlfi.rl import training

    config = training.read_config(out)
    names = tuple((one["domain"], one["seed"]) for one in config["trainings"])
    values = files.read_arrays(out / "curves.npz")["value"]
    learning.save_curves(out / "curves.png", names, values, training.settings_of(config).steps_per_update)
    console.print(f"learning curves: {out / 'curves.png'}", markup=False, soft_wrap=True)


def resume(out: Path, output: "Output", figures: bool, processes: "Processes") -> None:
    """Continue an interrupted training; see `run`. Every process reads the folder."""
    from jaxlfi.rl import training
    from jaxlfi.runs.execute import changed_machine

    config = training.read_config(out)
    if training.finished(out):
        if processes.writes:
            training.clean(out)
            if figures and not (out / "curves.png").exists():  # it was stopped while drawing them
                draw(out, output.notes)
        output.notes.print(f"{out} is complete: nothing to resume", markup=False, soft_wrap=True)
        return
    if config["environment"] is None:
        raise ValueError(f"{out}: expected an environment that can be found by name; resume it in Python")
    if changed := changed_machine(config, processes):
        warning = f"begun with {', '.join(changed)}: the policies may be other than without an interruption"
        output.warnings.print(f"warning: {warning}", style="yellow", markup=False, soft_wrap=True, highlight=False)
    environment = ENVIRONMENTS.load(config["environment"])
    if processes.writes:
        run(out, environment, output, figures, processes)
    else:
        training.resumed(out, environment, lambda updates, curves: None, processes)


def check_seeds(first: int, count: int, name: str) -> None:
    """Refuse `count` seeds from `first` on that are out of range; `name` is the first one's argument.

    Raises:
        ValueError: for seeds below 0 or of more than 32 bits.
    """
    if not 0 <= first <= 2**32 - count:
        raise ValueError(f"{name}: expected seeds from 0 to {2**32 - 1}, got {first}")


def _plan(arguments: argparse.Namespace) -> Any:
    if arguments.seeds < 1:
        raise ValueError(f"seeds: expected at least 1, got {arguments.seeds}")
    if arguments.seeds > MAX_SEEDS:
        raise ValueError(f"seeds: expected at most {MAX_SEEDS}, got {arguments.seeds}")
    check_seeds(arguments.first_seed, arguments.seeds, "first_seed")
    from jaxlfi.rl.policy import load
    from jaxlfi.rl.settings import PRESETS as SETTINGS_OF
    from jaxlfi.rl.training import Plan

    environment = ENVIRONMENTS.load(arguments.environment)
    own = getattr(environment, "training", {}).get(arguments.preset, {})
    return Plan(
        reference=arguments.environment,
        environment=environment,
        settings=SETTINGS_OF[arguments.preset].replace(**{**own, **arguments.settings}),
        preset=arguments.preset,
        domains=domains_of(environment, arguments.domain),
        seeds=tuple(range(arguments.first_seed, arguments.first_seed + arguments.seeds)),
        tensorboard=arguments.tensorboard,
        start=None if arguments.start is None else load(arguments.start),
    )


main = Command(
    "train",
    "train policies by PPO on domains, such as a posterior",
    _arguments,
    _train,
    description="Train policies by PPO on environments whose parameters are drawn from a domain.",
    epilog=EXAMPLES,
    begun=lambda arguments: resuming(arguments.out) if recorded(arguments.out).get("format") == TRAINING else "",
)
parser = main.parser
