"""How a case ends: in its own folder, in time, within memory, and with one line where it is refused.

Cases run in one process, since most bad input is refused before anything is compiled. One that is accepted stops where
the work would begin, at the first round, posterior, update or episode: that would take half a minute, and asks no more
of the input. Where `Case.work` says so the work is done, too.
"""

import contextlib
import dataclasses
import functools
import gc
import hashlib
import importlib.metadata
import io
import itertools
import os
import re
import resource
import shutil
import signal
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import jax
from matplotlib.figure import Figure

from jaxlfi import registry
from jaxlfi.bayessim import programs
from jaxlfi.cli import parser as cli
from tests.fuzzing.words import OWN

SECONDS, MEMORY = 60, 4 * 2**30
"""What a case may take: time, and bytes of memory besides what the process already has."""
ERROR = re.compile(r"jaxlfi[\w -]*: error: (?P<text>.+)\n")
"""All that a refused command leaves on stderr."""
NAMED = re.compile(
    r"expected|cannot load|\(choose from |: invalid \w+ value: |unrecognized arguments: |arguments are required: "
    r"|ignored explicit argument|not allowed with argument|arguments? [-, \w]+ is required|ambiguous option"
)
"""What a line says that names what was expected: by the library, or by argparse."""
SILENT = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)
"""Warnings that Python does not show."""
WORK = (
    "jaxlfi.runs.execute.run_rounds", "jaxlfi.studies.grid.folder.run_chunk",
    "jaxlfi.studies.calibration.folder.posteriors",
    "jaxlfi.rl.ppo.init", "jaxlfi.rl.evaluation.evaluate", "jaxlfi.envs.whip.render.perform",
    "jaxlfi.envs.whip.planner.plan", "jaxlfi.envs.whip.reference_objects.repetitions.repeat",
    "jaxlfi.envs.whip.vision.commands.record", "jaxlfi.envs.whip.vision.making.make",
    "jaxlfi.envs.whip.vision.training.train_segmenter", "jaxlfi.envs.whip.vision.scenes.rollouts",
    "jaxlfi.robots.episode.Paced.run", "jaxlfi.envs.whip.r2s2r._round_and_round",
)  # fmt: skip
"""Where work begins."""
PASSED = ("works", "accepted", "refused")


class Hang(BaseException):
    """A case that did not end in time."""


class Reached(BaseException):
    """A case that was accepted: the work would begin."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One command, and what it was given.

    Attributes:
        kind: which generator made it.
        words: of the command line.
        what: what is wrong with it, in words.
        work: whether the work is done, too, where the case is accepted.
        drawn: whether pictures are drawn in full, where it draws some.
    """

    kind: str
    words: tuple[str, ...]
    what: str
    work: bool = False
    drawn: bool = False


@dataclasses.dataclass(frozen=True)
class Result:
    """How a case ended.

    Attributes:
        outcome: one of `PASSED`, or "traceback", "hang", "memory", "output", "vague", "changed".
        text: the line on stderr, or what went wrong.
    """

    outcome: str
    text: str = ""


def accepted(*_: Any, **__: Any) -> None:
    """In place of the work."""
    raise Reached


def sketched(figure: Figure, file: io.BytesIO, **_: Any) -> None:
    """In place of a picture that takes half a second to draw."""
    file.write(b"\x89PNG\r\n\x1a\n")


@contextlib.contextmanager
def alarmed(seconds: int) -> Iterator[None]:
    """Raise `Hang` in what takes longer."""

    def ring(*_: Any) -> None:
        raise Hang

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@contextlib.contextmanager
def sped_up() -> Iterator[None]:
    """Read what is installed once for all cases."""
    with mock.patch.object(registry, "entry_points", functools.cache(importlib.metadata.entry_points)):
        yield


@contextlib.contextmanager
def stubs(work: bool = False, drawn: bool = False, resumed: bool = False) -> Iterator[None]:
    """Replace what takes long; a run that is resumed starts, as its checkpoint is read after that."""
    with contextlib.ExitStack() as stack:
        if not work:
            for name in (*WORK, *["jaxlfi.bayessim.batch.BatchEngine.start"] * (not resumed)):
                stack.enter_context(mock.patch(name, accepted))
        stack.enter_context(mock.patch("jaxlfi.studies.grid.chunks.program_bytes", lambda engine: 0))
        stack.enter_context(mock.patch("jaxlfi.cli.multi_process.work", lambda command, *_: command()))
        stack.enter_context(mock.patch("jaxlfi.io.processes.join", accepted))  # there are no others
        if not drawn:
            stack.enter_context(mock.patch.object(Figure, "savefig", sketched))
        yield


def ended(case: Case) -> Result:
    """Run a case in the current folder, and say how it ended."""
    out, errors = io.StringIO(), io.StringIO()
    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch.dict(os.environ))
        stack.enter_context(stubs(case.work, case.drawn, "resume" in case.words))
        shown = stack.enter_context(warnings.catch_warnings(record=True))
        warnings.simplefilter("always")
        stack.enter_context(contextlib.redirect_stdout(out))
        stack.enter_context(contextlib.redirect_stderr(errors))
        try:
            with alarmed(SECONDS):
                status = cli.main(list(case.words))
        except SystemExit as stop:
            status = stop.code or 0
        except Reached:
            return Result("accepted")
        except Hang:
            return Result("hang", f"over {SECONDS} s")
        except BaseException as error:
            frames = traceback.extract_tb(error.__traceback__)
            place = ([frame for frame in frames if f"{os.sep}jaxlfi{os.sep}" in frame.filename] or frames)[-1]
            text = f"{type(error).__name__}: {str(error)[:200]} ({Path(place.filename).name}:{place.lineno})"
            return Result("traceback", text)
    text = errors.getvalue()
    text += "".join(
        f"{one.category.__name__}: {one.message}\n" for one in shown if not issubclass(one.category, SILENT)
    )
    if status == 0:
        return Result("works", text)
    if status == 2 and (line := ERROR.fullmatch(text)):
        return Result("refused" if NAMED.search(line["text"]) else "vague", text)
    return Result("output", f"status {status}: {text[:500]!r}")


def contents(root: Path) -> dict[str, str]:
    """What every file and folder below a folder holds."""
    found = {}
    for folder, names, files in os.walk(root):
        for name in (*files, *names):
            path = Path(folder, name)
            text = (
                os.readlink(path).encode() if path.is_symlink() else b"folder" if path.is_dir() else path.read_bytes()
            )
            found[os.path.relpath(path, root)] = hashlib.sha256(text).hexdigest()
    return found


def allowed(words: tuple[str, ...], here: Path) -> list[str]:
    """Where a command may make files: what follows its last --out, and the run that it is about; from a folder on."""
    given = [after for word, after in itertools.pairwise(words) if word == "--out"]
    given += [word.removeprefix("--out=") for word in words if word.startswith("--out=")]
    if words[:2] == ("whip", "convert"):
        given += words[-1:]
    if words and words[0] in OWN:
        given.append("own/run")
    return [os.path.normpath(here / name.replace("\0", "")) for name in given]


def strayed(before: dict[str, str], after: dict[str, str], words: tuple[str, ...], root: Path, here: Path) -> list[str]:
    """What a command changed, removed, or made elsewhere than it may."""
    places = [os.path.relpath(name, root) for name in allowed(words, here)]
    run = os.path.relpath(here / "own" / "run", root)
    inside = lambda name, place: f"{name}/".startswith(f"{place}/")
    touched = [name for name in before if after.get(name) != before[name] and not inside(name, run)]
    made = [
        name
        for name in after
        if name not in before
        and not any(
            inside(name, place) or inside(place, name) or name == os.path.splitext(place)[0] + ".json"
            for place in places
        )
    ]
    return touched + made


def peak() -> int:
    """The most memory that the process had since it was asked last, in bytes."""
    status = Path("/proc/self/status")
    if not status.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 2**10
    most = next(int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith("VmHWM"))
    Path("/proc/self/clear_refs").write_text("5")
    return most * 2**10


def forget() -> int:
    """Let go of compiled programs; returns the bytes of memory that the process still has."""
    programs.forget()
    jax.clear_caches()
    gc.collect()
    peak()
    return peak()


def judged(case: Case, root: Path, here: Path) -> tuple[Result, int]:
    """Run a case in a folder, and compare what is below the root before and after; also, the memory it took."""
    before = contents(root)
    peak()
    had = peak()
    with contextlib.chdir(here):
        result = ended(case)
    memory, after = peak() - had, contents(root)
    if result.outcome in PASSED and (names := strayed(before, after, case.words, root, here)):
        result = Result("changed", ", ".join(names[:3]))
    if result.outcome in PASSED and memory > MEMORY:
        result = Result("memory", f"{memory / 2**30:.1f} GiB")
    for name in sorted(after.keys() - before.keys(), key=len):
        path = root / name
        if os.path.lexists(path):
            path.unlink() if path.is_symlink() or path.is_file() else shutil.rmtree(path)
    return result, memory
