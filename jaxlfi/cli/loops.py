"""Common parts of loops from a real system to a policy and back: stages that are commands and can be resumed.

A loop is a folder. Each of its stages is a command with its own folder, which is complete once its last file exists.
Repeating the command of the loop continues an interrupted one. This module imports neither jax nor numpy before it has
to, so that `--help` answers at once.
"""

import argparse
import json
import shlex
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxlfi.cli import design
from jaxlfi.cli.interrupts import INTERRUPTED
from jaxlfi.io.formats import CONFIG, FORMATS, LOOP
from jaxlfi.io.shell import quoted

if TYPE_CHECKING:
    from jaxlfi.runs.run import Run

Words = list[str]
CONTROLS, PICTURE = "experiment_1.csv", "design.png"
"""Last files that `jaxlfi design` writes, without figures and with them."""


class StageError(Exception):
    """A stage ended with an exit status other than 0, and has said why."""

    def __init__(self, status: int):
        super().__init__(status)
        self.status = status


def begin(out: Path, asked: Mapping[str, str | None]) -> None:
    """Make the folder of a loop, or recognise an existing one.

    Args:
        out: folder of the loop.
        asked: the command's arguments.

    Raises:
        ValueError: for the folder of another command.
    """
    from jaxlfi.io import files, workfolder
    from jaxlfi.io.provenance import environment

    path = out / CONFIG
    if workfolder.begun(out, CONFIG, "a new folder, or one of the same command"):
        found = json.loads(path.read_text()).get("asked")
        # Options that are newer than the folder have the values of this command.
        if not isinstance(found, Mapping) or {**asked, **found} != asked:
            raise ValueError(f"out: expected a new folder, or one of the same command, got {out} of {found}")
        return
    files.write_json(path, {"format": LOOP, "version": FORMATS[LOOP].version, "asked": asked, **environment()})


def begin_or_resume(
    run: Callable[[Words], int],
    resume: Callable[[Words], int],
    words: Words,
    out: Path,
    do: Callable[[Callable[[Words], int], Words], None],
) -> None:
    """Run a stage as a command with these words, or resume what is missing of it.

    Args:
        run: the command.
        resume: the command line, which resumes its folder.
        words: words of the command.
        out: folder of the stage.
        do: function that runs one or the other with its words.
    """
    if (out / CONFIG).exists():
        run, words = resume, ["resume", str(out)]
    else:
        for left in out.parent.glob(f".{out.name}-*"):  # left by a process killed while it created its folder
            shutil.rmtree(left)
    do(run, words)


def done(run: Callable[[Words], int], prefix: Sequence[str], words: Words, what: str) -> None:
    """Run a command, and print it as a user would type it.

    Raises:
        KeyboardInterrupt: if it was interrupted.
        StageError: if it failed.
    """
    say(f"{what}: {quoted('jaxlfi', *prefix, *words)}")
    if status := run(words):
        raise KeyboardInterrupt if status == INTERRUPTED else StageError(status)


def add_explore(parser: argparse.ArgumentParser) -> None:
    """Add the options for how the next recording is made."""
    parser.add_argument(
        "--explore",
        choices=("policy", "design"),
        default="policy",
        help="what the next recording is made by: policy, the newest one; design, the experiment that tells most of "
        "the posterior so far (default: policy)",
    )
    parser.add_argument(
        "--design", default="", metavar="WORDS", help="further words of jaxlfi design, as '--rated 32 --about ridge'"
    )


def design_words(arguments: argparse.Namespace, posterior: Path, out: Path) -> Words:
    """The words of `jaxlfi design` for one experiment, with those given to the loop."""
    return [str(posterior), "--seed", str(arguments.seed), *shlex.split(arguments.design), "--out", str(out)]


def check_design(arguments: argparse.Namespace) -> None:
    """Refuse words that `jaxlfi design` does not know, and numbers out of range, before anything is done."""
    found = design.parser().parse_args(design_words(arguments, Path("run"), Path("design")))
    if arguments.explore == "design":
        from jaxlfi.design import choosing, recommendation  # which import jax

        numbers = found.rated or choosing.RATED, found.simulations or recommendation.SIMULATIONS
        recommendation.require_effort(found.experiments, *numbers, found.tolerance)


def designed(arguments: argparse.Namespace, posterior: Path, out: Path) -> Path:
    """The controls of the most informative experiment for a posterior, from a stage of its own.

    They depend only on the posterior and the seed: the remains of a killed stage are removed, and it is repeated with
    the same result.

    Args:
        arguments: arguments of the loop.
        posterior: folder of a finished run.
        out: folder of the stage.

    Raises:
        KeyboardInterrupt: if it was interrupted.
        StageError: if it failed.
    """
    words = design_words(arguments, posterior, out)
    if not (out / (CONTROLS if "--no-figures" in words else PICTURE)).exists():
        shutil.rmtree(out, ignore_errors=True)
        done(design.main, ["design"], words, "the experiment that tells most")
    return out / CONTROLS


def say(text: str) -> None:
    """Print a line between the outputs of stages."""
    print(f"\n== {text}", flush=True)


def believed(folder: Path, run: "Run") -> list[dict[str, str]]:
    """Median and 90 % credible interval of each parameter, and the run's final support, in natural units."""
    import numpy as np

    quantiles = np.quantile(np.asarray(run.draws()), (0.05, 0.5, 0.95), axis=0)
    box = run.final_support()
    return [
        {
            "run": str(folder),
            "parameter": name,
            "median": f"{middle:.4g}",
            "90 % interval": f"{low:.4g} to {high:.4g}",
            "last support": f"{float(box.low[place]):.4g} to {float(box.high[place]):.4g}",
        }
        for place, (name, low, middle, high) in enumerate(zip(run.space.names, *quantiles, strict=True))
    ]


def moved(before: "Run", after: "Run") -> float:
    """How far a posterior has moved: the largest change of a median, in half-widths of the previous 90 % interval.

    For parameters whose logarithm is inferred, it is the change of the logarithm.
    """
    import numpy as np

    quantiles = [
        np.quantile(np.asarray(one.space.to_inference(np.asarray(one.draws()))), (0.05, 0.5, 0.95), axis=0)
        for one in (before, after)
    ]
    (low, middle, high), (_, later, _) = quantiles
    return float(np.max(np.abs(later - middle) / np.maximum(0.5 * (high - low), 1e-12)))


def asked_of(arguments: Any, leaving: Sequence[str] = ("out", "debug")) -> dict[str, str | None]:
    """The arguments of a command, as text."""
    return {
        name: None if value is None else str(value) for name, value in vars(arguments).items() if name not in leaving
    }
