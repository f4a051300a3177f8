"""Bad input by the thousand: every command ends with status 2 and one line, or works.

    python -m experiments.fuzzing --cases 10000 --seed 0 --out runs/fuzzing

Each case is one command with something wrong in it (or, by chance, nothing): its words, a configuration, an array file
or an observation. A case must end within a minute with status 0, or with status 2 and one line on stderr; it must not
let the process grow beyond 4 GB, nor change a byte outside of its own output. What does not is a finding, written with
the words and the file that made it. A case follows from the seed and its number alone: `--first 123 --cases 1` makes
number 123 again, and `--keep` leaves its files.

Cases run in one process, since most bad input is refused before anything is compiled. One that is accepted stops where
the work would begin (training, calibration), as that would take half a minute and asks no more of the input; but
pictures are drawn, and a run is resumed whenever its checkpoint was damaged, as only the work reads that.
"""

import argparse
import collections
import contextlib
import dataclasses
import hashlib
import io
import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table

from jaxlfi.cli import commands
from jaxlfi.cli import parser as cli
from jaxlfi.envs import gaussian_linear
from jaxlfi.io import files as atomic
from jaxlfi.runs import execute as executing
from jaxlfi.studies import calibration

SECONDS, MEMORY = 60, 4 * 2**30
"""What a case may take: time, and bytes of the process's memory."""
TASK = "gaussian_linear"
SMALL = (
    "--estimator mdn --hidden 16 --ensemble-size 1 --components 2 --rounds 2 --min-rounds 0 "
    "--simulations-per-round 20 --steps 20 --no-cache --no-figures"
).split()
"""Settings whose training takes a second to compile."""
ERROR = re.compile(r"jaxlfi[\w ]*: error: .+\n")
"""All that a refused command leaves on stderr."""
SILENT = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)
"""Warnings that Python does not show."""

WORDS = (
    "", " ", "-1", "0", "1", "2", "0.5", "1e-3", "nan", "inf", "-inf", "1e400", "-0", "0x10", "1_0", "٣", "1,2", "true",
    "None", "null", "[]", "{}", "9" * 30, "9" * 5000, "2147483648", "9223372036854775808", "-9223372036854775809",
    "[/x]", "[bold]", "[red]x[/red]", "é", "名前", "🦾", "\udcff", "a\nb", "a\tb", "a\0b", "\x1b[31m", "%s", "{0}", "$HOME",
    "..", "../..", "../../etc/passwd", "/", "/etc/passwd", "~", "a/b", "a\\b", "-", "--", "-x", "--rounds", "x" * 300,
    "x" * 5000, "ok", "edge", "ok+edge", "ok+", "+", "ok+edge+mode", "none", "mdn", "maf", "nsf", "ok+../..", "..+edge",
    ":", "a:b", "os:system", "builtins:dict", "json:loads", "os.path:join", "=", "a=b", "expansion=", "expansion=nan,1",
    "expansion=0.1,0.2", "tail=a", "=1", "tail=1,1", "posterior", "posterior,posterior", ",", ",,",
)  # fmt: skip
"""Values for any flag; by chance some are right."""
TASKS = (
    TASK, "", ",", "gaussian_linear,", "gaussian_linear,trials=0", "gaussian_linear,trials=x", "gaussian_linear,trials",
    "gaussian_linear,trials=1001", "gaussian_linear,pooling=x,trials=2", "gaussian_linear,a=b", "gaussian", "[/x]", "..",
    "gaussian_linear,=", "gaussian_linear,trials=2,trials=3", ":", "a:", ":b", "a:b:c", "os:getcwd", "os:path", "json:x",
    "builtins:exit", "builtins:open", "jaxlfi.envs.gaussian_linear:task", "jaxlfi.envs.gaussian_linear:nothing", "..:x",
    "lynx_hare", "mg1", "x" * 5000, "\0", "\udcff", "gaussian_linear+x", "gaussian_linear;x", "/etc/passwd",
)  # fmt: skip
"""Names of tasks, right and wrong."""
VALUES = (
    None, True, False, 0, 1, -1, 2, 0.5, 1e308, -0.0, 10**30, float("nan"), float("inf"), "", "x", "..", "../../x", "[/x]",
    "/etc/passwd", "os:system", "名前", [], {}, [[]], [None], [1], [1, 2, 3], ["a"], [float("nan")] * 2, {"a": 1},
    {"float": "x"}, {"float": 1}, {"array": [1], "dtype": "object"}, {"array": [1], "dtype": 7}, {"mapping": 1},
    {"mapping": [[[1], {}]]}, {"name": "edge", "hyperparameters": {}}, {"name": [], "hyperparameters": None},
    {"name": "os:system", "hyperparameters": {}}, {"array": [1.0, 2.0], "dtype": "float32"},
)  # fmt: skip
"""Values for any place of a configuration."""


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
        own: folders and files that it may write, relative to the working folder.
        work: whether the work is done, too, where the case is accepted.
    """

    kind: str
    words: tuple[str, ...]
    what: str
    own: tuple[str, ...]
    work: bool = False


@dataclasses.dataclass(frozen=True)
class Result:
    """How a case ended: "works", "accepted", "refused", or a finding.

    Attributes:
        outcome: one of these, or "traceback", "hang", "memory", "output", "changed".
        text: the line on stderr, or what went wrong.
    """

    outcome: str
    text: str = ""


PASSED = ("works", "accepted", "refused")

# ------------------------------------------------------------------------------------------------------- good input


def prepare(root: Path) -> None:
    """Make what is damaged later: a finished run, a stopped one, an observation and simulations made before."""
    with contextlib.ExitStack() as closing:
        arguments = cli.parse(["infer", TASK, *SMALL, "--out", str(root / "good" / "run")])
        arguments.closing = closing
        folder, (plan, observed) = commands.infer(arguments, Console(quiet=True))

    def stop(index: int, row: Any) -> None:
        raise KeyboardInterrupt

    with contextlib.suppress(KeyboardInterrupt):
        executing.execute(plan, observed, folder, stop)
    shutil.copytree(folder, root / "good" / "stopped")
    executing.finish(folder, plan, executing.execute(plan, observed, folder))
    trajectory = np.asarray(observed.trajectory[0])
    atomic.write_arrays(root / "good" / "observation.npz", {"trajectory": trajectory})
    (root / "good" / "observation.csv").write_text("\n".join(str(value) for value in trajectory.ravel()) + "\n")
    rng = np.random.default_rng(0)
    theta = rng.uniform(-3, 3, (20, 2)).astype(np.float32)
    trajectories = rng.normal(size=(20, *trajectory.shape)).astype(np.float32)
    atomic.write_arrays(root / "good" / "simulations.npz", {"theta": theta, "trajectory": trajectories})
    (root / "good" / "file").write_text("precious")
    (root / "good" / "nowhere").symlink_to("gone")


# ------------------------------------------------------------------------------------------------------- words


def picked(rng: np.random.Generator, values: Any) -> Any:
    """One of several, evenly."""
    return values[int(rng.integers(len(values)))]


def base(command: str) -> list[str]:
    """Words of a command that are right."""
    if command in ("infer", "compare", "grid"):
        small = SMALL if command != "grid" else [word for word in SMALL if word != "--cases"]
        return [command, TASK, *small, "--out", "own/out", *["--vary", "expansion=0.1,0.2"] * (command == "grid")]
    folder = {"resume": ["good/run"], "tasks": [TASK]}.get(command, ["own/run"])
    return [command, *folder, *["--no-figures"] * (command == "diagnose")]


def flags_of(command: str) -> list[argparse.Action]:
    """Flags of a command but --debug, which is meant to show tracebacks."""
    chosen = cli.parser()._subparsers._group_actions[0].choices[command]
    return [action for action in chosen._actions if action.option_strings and "--debug" not in action.option_strings]


def bad_words(rng: np.random.Generator, root: Path) -> Case:
    """A command with up to three words changed, added or left out."""
    command = picked(rng, tuple(commands.COMMANDS))
    words, what = base(command), []
    if "own/run" in words:
        shutil.copytree(root / "good" / "run", root / "own" / "run")
    for _ in range(int(rng.integers(1, 4))):
        way = picked(rng, ("flag", "flag", "flag", "flag", "value", "drop", "task", "out", "extra"))
        if way == "flag":
            action = picked(rng, flags_of(command))
            count = 0 if action.nargs == 0 else int(rng.integers(1, 4)) if action.nargs == "+" else 1
            known = tuple(map(str, action.choices)) if action.choices else ()
            values = [picked(rng, known) if known and rng.random() < 0.5 else picked(rng, WORDS) for _ in range(count)]
            if action.dest == "out" and any(".." in value or value.startswith(("/", "~")) for value in values):
                continue  # a folder elsewhere may be meant
            if action.dest in ("workers", "scheduler"):
                continue  # they start processes
            flag = picked(rng, action.option_strings)
            words += [f"{flag}={values[0]}"] if count == 1 and rng.random() < 0.5 else [flag, *values]
            what.append(flag)
        elif way == "value":
            index = int(rng.integers(1, len(words))) if len(words) > 1 else 0
            if words[index - 1] != "--out" and index:
                words[index] = picked(rng, WORDS)
                what.append(f"word {index}")
        elif way == "drop":
            del words[int(rng.integers(0, len(words)))]
            what.append("a word less")
            if not words:
                break
        elif way == "task" and len(words) > 1 and command in ("tasks", "infer", "compare", "grid"):
            words[1] = picked(rng, TASKS)
            what.append("task")
        elif way == "out" and "--out" in words[:-1]:
            names = ("good/file", "good/run", "good/nowhere", "", ".", "own/a/../out", "own/" + "x" * 300, "own/[/x]",
                     "own/é\udcff", "own/a\0b", "/dev/null/x", "/proc/x", "good/file/x", "-", "own/名前")  # fmt: skip
            words[words.index("--out") + 1] = picked(rng, names)
            what.append("out")
        elif way == "extra":
            words.insert(int(rng.integers(0, len(words) + 1)), picked(rng, WORDS))
            what.append("a word more")
    return Case("words", tuple(words), ", ".join(what) or "nothing", ("own",))


# ------------------------------------------------------------------------------------------------------- files


def places(value: Any, path: tuple = ()) -> Iterator[tuple]:
    """Where there is anything in a nested value."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, item in items:
        yield (*path, name)
        yield from places(item, (*path, name))


def damage_json(rng: np.random.Generator, path: Path) -> str:
    """Change a configuration; in words, how."""
    way = picked(rng, ("value",) * 8 + ("drop", "drop", "add", "cut", "text"))
    text = path.read_text()
    if way == "cut":
        path.write_text(text[: int(rng.integers(len(text)))])
        return "cut"
    if way == "text":
        deep = "[" * 100_000
        odd = ("", "null", "[]", "{}", "1", '"x"', "NaN", deep, '{"format": ' + deep, "9" * 10_000, "\ufeff" + text, "\0")
        path.write_text(picked(rng, odd))
        return "another text"
    config = json.loads(text)
    found = [place for place in places(config) if place[0] not in ("versions", "platform", "command_line", "started")]
    *way_there, last = picked(rng, found)
    holder = config
    for name in way_there:
        holder = holder[name]
    if way == "drop":
        del holder[last]
    elif way == "add":
        (config if isinstance(holder, list) else holder)["unknown"] = picked(rng, VALUES)
    else:
        holder[last] = picked(rng, VALUES)
    path.write_text(json.dumps(config))
    return f"{way} {'.'.join(map(str, (*way_there, last)))}"


class Pickled:
    """An object that would leave a file behind, were it unpickled."""

    def __reduce__(self):
        """What unpickling does."""
        return os.mkdir, ("good/unpickled",)


def bomb(path: Path, name: str) -> None:
    """An .npz whose one array has 6 GB of zeros, in some megabytes."""
    block, repeats = 2**24, 384
    deflate = zlib.compressobj(9, zlib.DEFLATED, -15)
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "|u1", "fortran_order": False, "shape": (block * repeats,)}
    )
    start = deflate.compress(header.getvalue()) + deflate.flush(zlib.Z_FULL_FLUSH)
    again = deflate.compress(bytes(block)) + deflate.flush(zlib.Z_FULL_FLUSH)
    stream = start + again * repeats + deflate.flush()
    info = zipfile.ZipInfo(f"{name}.npy")
    with zipfile.ZipFile(path, "w") as archive:  # stored, and then said to be deflated
        archive.writestr(info, stream)
        at = info.header_offset
        info.compress_type, info.file_size = zipfile.ZIP_DEFLATED, len(header.getvalue()) + block * repeats
    content = bytearray(path.read_bytes())
    content[at + 8 : at + 10] = (8).to_bytes(2, "little")
    path.write_bytes(content)


def damage_arrays(rng: np.random.Generator, path: Path) -> str:
    """Change an .npz; in words, how."""
    way = picked(rng, ("cut", "flip", "flip", "shape", "dtype", "values", "drop", "add", "pickle", "bomb", "text", "names",
                       "link", "folder", "huge"))  # fmt: skip
    content = path.read_bytes()
    if way == "bomb" and rng.random() < 0.7:
        way = "values"
    if way == "cut":
        path.write_bytes(content[: int(rng.integers(len(content)))])
    elif way == "flip":
        flipped = bytearray(content)
        for _ in range(int(rng.integers(1, 9))):
            flipped[int(rng.integers(len(flipped)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
    elif way == "text":
        path.write_bytes(picked(rng, (b"", b"\0", b"PK\x03\x04", b"PK\x05\x06" + bytes(18), b"\x93NUMPY", b"1,2\n3", b"\x80\x04N.")))
    elif way in ("link", "folder"):
        path.unlink()
        path.symlink_to(picked(rng, ("gone", path.name, "/etc/passwd", "."))) if way == "link" else path.mkdir()
    else:
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        name = picked(rng, tuple(arrays))
        array = arrays[name]
        if way == "bomb":
            bomb(path, name)
            return f"bomb {name}"
        if way == "huge":
            header = io.BytesIO()
            np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (10**12,)})
            with zipfile.ZipFile(path, "w") as archive:
                archive.writestr(f"{name}.npy", header.getvalue())
            return f"huge {name}"
        if way == "shape":
            shapes = (array[None], array.ravel(), array[..., None], array[:0] if array.ndim else array[None],
                      array.ravel()[:1], np.zeros(()), np.zeros((3, 0)), np.repeat(array[None], 3, 0))  # fmt: skip
            arrays[name] = picked(rng, shapes)
        elif way == "dtype":
            kinds = ("S3", "U5", "c8", "?", "i1", "f8", "f2", "u8", "M8[s]", "i4,f4")
            arrays[name] = np.zeros(array.shape, picked(rng, kinds))
        elif way == "values" and array.dtype.kind in "fiu":
            odd = (np.nan, np.inf, -np.inf, 1e38, -1e38, -1.0, 0.0)
            changed = np.array(array, np.float32 if array.dtype.kind == "f" else array.dtype)
            value = picked(rng, odd if array.dtype.kind == "f" else (0, 1, 100, 2**31 - 1))
            mask = rng.random(array.shape) < picked(rng, (0.1, 1.0))
            changed[mask] = value if array.dtype.kind != "u" else abs(value)
            arrays[name] = changed
        elif way == "drop":
            del arrays[name]
        elif way == "add":
            arrays["../../unknown"] = np.zeros(3)
        elif way == "names":
            arrays = {picked(rng, ("../x", "/etc/x", "x" * 300, "", "名", "a/b")) if n == name else n: a for n, a in arrays.items()}
        elif way == "pickle":
            arrays[name] = np.array([Pickled()], object)
        np.savez(path, **{key: value for key, value in arrays.items() if key != "file"})
        return f"{way} {name}"
    return way


def damage_table(rng: np.random.Generator, path: Path) -> str:
    """Change an observation's .csv; in words, how."""
    text = path.read_text()
    odd = (
        "", "\n", "#\n", "x\n", "x,y\n1\n", "1,2\n3\n", "nan\n", "inf\ninf\n", "1\n" * 5, "1,2\n" * 2, "a,1\n", '"1\n', "1;2\n",
        "\ufeff" + text, text * 100, "time,x\n0,1\n1,2\n", "9" * 400 + "\n", "1\0\n2\n", "x" * 200_000, "٣\n٤\n", "1e400\n" * 2,
    )  # fmt: skip
    if rng.random() < 0.2:
        path.write_bytes(rng.integers(0, 256, int(rng.integers(1, 200)), np.uint8).tobytes())
        return "noise"
    index = int(rng.integers(len(odd)))
    path.write_text(odd[index])
    return f"table {index}"


RUN_ARRAYS = ("posterior.npz", "dataset.npz", "history.npz", "observation.npz", "network.npz")


def bad_configuration(rng: np.random.Generator, root: Path) -> Case:
    """A run's folder whose config.json (or ledger) was changed."""
    command = picked(rng, ("sample", "sample", "diagnose", "resume", "resume", "report"))
    source = "stopped" if command == "resume" else "run"
    shutil.copytree(root / "good" / source, root / "own" / "run")
    what = damage_json(rng, root / "own" / "run" / "config.json")
    words = [command, "own/run", *["-n", "3"] * (command == "sample"), *["--no-figures"] * (command == "diagnose")]
    return Case("configuration", tuple(words), what, ("own",))


def bad_arrays(rng: np.random.Generator, root: Path) -> Case:
    """A run's folder of which one array file was changed."""
    command = picked(rng, ("sample", "sample", "sample", "diagnose", "diagnose", "resume", "report"))
    source = "stopped" if command == "resume" else "run"
    shutil.copytree(root / "good" / source, root / "own" / "run")
    names = ("checkpoint/start.npz", "checkpoint/state.npz", "checkpoint/round_000.npz")
    found = [name for name in (names if command == "resume" else RUN_ARRAYS) if (root / "own" / "run" / name).exists()]
    name = picked(rng, found)
    what = f"{name}: {damage_arrays(rng, root / 'own' / 'run' / name)}"
    words = [command, "own/run", *["-n", "3"] * (command == "sample")]
    words += ["--no-figures"] * (command in ("diagnose", "resume"))
    return Case("arrays", tuple(words), what, ("own",), work=command == "resume")


def bad_observation(rng: np.random.Generator, root: Path) -> Case:
    """Files for `--observation` and `--simulations`, and samples to compare with."""
    way = picked(rng, ("observation.npz", "observation.npz", "observation.csv", "observation.csv", "simulations.npz",
                       "simulations.npz", "against"))  # fmt: skip
    if way == "against":
        shutil.copytree(root / "good" / "run", root / "own" / "run")
        name = picked(rng, ("observation.csv", "simulations.npz"))
        words = ["diagnose", "own/run", "--no-figures", "--against", f"own/{name}"]
    else:
        name, words = way, [*base("infer"), f"--{way.partition('.')[0].rstrip('s') + 's' * way.startswith('sim')}", f"own/{way}"]
    shutil.copy(root / "good" / name, root / "own" / name)
    what = f"{way}: {(damage_table if name.endswith('csv') else damage_arrays)(rng, root / 'own' / name)}"
    if rng.random() < 0.1:
        odd = (".txt", ".NPZ", "", ".npz.csv", ".csv")
        moved = root / "own" / f"..[x]{picked(rng, odd)}"
        (root / "own" / name).rename(moved)
        words[-1] = f"own/{moved.name}"
    return Case("observations", tuple(words), what, ("own",))


KINDS: tuple[Callable[[np.random.Generator, Path], Case], ...] = (
    bad_words, bad_words, bad_configuration, bad_arrays, bad_observation,
)  # fmt: skip
"""Generators, in turn."""

# ------------------------------------------------------------------------------------------------------- judging


def contents(root: Path, but: tuple[str, ...]) -> dict[str, str]:
    """What every file below a folder holds, but for those that may be written."""
    found = {}
    for folder, names, files in os.walk(root):
        here = Path(folder)
        names[:] = [name for name in names if str((here / name).relative_to(root)) not in but]
        for name in (*files, *names):
            path = here / name
            link = path.is_symlink()
            text = os.readlink(path).encode() if link else path.read_bytes() if path.is_file() else b"folder"
            found[str(path.relative_to(root))] = hashlib.sha256(text).hexdigest()
    return found


def accepted(*_: Any, **__: Any) -> None:
    """In place of the work."""
    raise Reached


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


def ended(case: Case) -> Result:
    """Run a case in the current folder, and say how it ended."""
    out, errors = io.StringIO(), io.StringIO()
    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch.dict(os.environ))
        stack.enter_context(mock.patch.object(calibration, "diagnose", accepted))
        if not case.work:
            stack.enter_context(mock.patch.object(commands, "run", accepted))
        shown = stack.enter_context(warnings.catch_warnings(record=True))
        warnings.simplefilter("always")
        stack.enter_context(contextlib.redirect_stdout(out))
        stack.enter_context(contextlib.redirect_stderr(errors))
        try:
            with alarmed(SECONDS):
                status = cli.main(list(case.words))
        except SystemExit as stop:
            status = stop.code
        except Reached:
            return Result("accepted")
        except Hang:
            return Result("hang", f"over {SECONDS} s")
        except BaseException as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            own = [frame for frame in traceback.extract_tb(error.__traceback__) if "/jaxlfi/" in frame.filename]
            place = (own or [where])[-1]
            text = f"{type(error).__name__}: {str(error)[:200]} ({Path(place.filename).name}:{place.lineno})"
            return Result("traceback", text)
    text = errors.getvalue()
    text += "".join(f"{one.category.__name__}: {one.message}\n" for one in shown if not issubclass(one.category, SILENT))
    if status == 0:
        return Result("works", text)
    if status == 2 and ERROR.fullmatch(text):
        return Result("refused", text)
    return Result("output", f"status {status}: {text[:500]!r}")


def judged(case: Case, root: Path) -> Result:
    """Run a case in a folder, and compare what it left there with what was there."""
    before = contents(root, case.own)
    with contextlib.chdir(root):
        result = ended(case)
    if result.outcome in PASSED and contents(root, case.own) != before:
        return Result("changed", str(sorted(set(contents(root, case.own).items()) ^ set(before.items()))[:3]))
    if result.outcome in PASSED and resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 2**10 > MEMORY:
        return Result("memory", f"over {MEMORY / 2**30:.0f} GB")
    return result


def made(seed: int, number: int, root: Path) -> Case:
    """A case's files below the folder `own`, and its words."""
    shutil.rmtree(root / "own", ignore_errors=True)
    (root / "own").mkdir()
    return KINDS[number % len(KINDS)](np.random.default_rng([seed, number]), root)


@dataclasses.dataclass(frozen=True)
class Finding:
    """A case that did not end as it should."""

    number: int
    case: Case
    result: Result


def fuzz(
    root: Path, seed: int, numbers: range, tell: Callable[[int, Case, Result], None] = lambda number, case, result: None
) -> tuple[collections.Counter, list[Finding]]:
    """Run cases in a folder that `prepare` filled: how many of each kind ended how, and the findings."""
    counts: collections.Counter = collections.Counter()
    findings = []
    for number in numbers:
        case = made(seed, number, root)
        result = judged(case, root)
        counts[case.kind, result.outcome] += 1
        if result.outcome not in PASSED:
            findings.append(Finding(number, case, result))
        tell(number, case, result)
    return counts, findings


# ------------------------------------------------------------------------------------------------------- by hand


def main() -> None:
    """Fuzz, and write a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=500, metavar="N", help="how many (default: 500)")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="number of the first (default: 0)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of all cases (default: 0)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder: fuzzing.json")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="a new folder for the files of the last case")
    arguments = parser.parse_args()
    for name, folder in (("out", arguments.out), ("keep", arguments.keep)):
        if folder is not None and folder.exists():
            parser.error(f"{name}: expected a new folder, got {folder}, which exists")
    if arguments.cases < 1 or arguments.first < 0 or arguments.seed < 0:
        parser.error("expected at least one case, and no negative numbers")
    console, began = Console(stderr=True), time.monotonic()
    root = Path(tempfile.mkdtemp(prefix="jaxlfi-fuzzing-")).resolve()
    slowest = [0.0, 0]
    last = [time.monotonic()]

    def tell(number: int, case: Case, result: Result) -> None:
        now = time.monotonic()
        slowest[:] = max(slowest, [now - last[0], number])
        last[0] = now
        if result.outcome not in PASSED:
            console.print(escape(f"{number} {result.outcome}: {case.what}: {' '.join(case.words)[:300]!r}: {result.text}"))

    try:
        console.print("making what will be damaged: a finished run and a stopped one")
        prepare(root)
        numbers = range(arguments.first, arguments.first + arguments.cases)
        last[0] = time.monotonic()
        counts, findings = fuzz(root, arguments.seed, track(numbers, "cases", console=console), tell)
        if arguments.keep is not None:
            shutil.copytree(root, arguments.keep, symlinks=True)
    finally:
        shutil.rmtree(root, ignore_errors=True)
    table = Table("kind", "outcome", "cases")
    for (kind, outcome), count in sorted(counts.items()):
        table.add_row(kind, outcome, str(count))
    Console().print(table)
    seconds, memory = time.monotonic() - began, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    console.print(f"{seconds:.0f} s, the slowest case {slowest[0]:.1f} s ({slowest[1]}), at most {memory:.2f} GiB")
    arguments.out.mkdir(parents=True)
    atomic.write_json(
        arguments.out / "fuzzing.json",
        {
            "seed": arguments.seed,
            "first": arguments.first,
            "cases": arguments.cases,
            "outcomes": [[kind, outcome, count] for (kind, outcome), count in sorted(counts.items())],
            "seconds": round(seconds),
            "slowest_seconds": round(slowest[0], 1),
            "memory_gib": round(memory, 2),
            "findings": [
                {
                    "number": one.number,
                    "kind": one.case.kind,
                    "words": [word[:200].encode(errors="backslashreplace").decode() for word in one.case.words],
                    "what": one.case.what,
                    "outcome": one.result.outcome,
                    "text": one.result.text.encode(errors="backslashreplace").decode(),
                }
                for one in findings
            ],
        },
    )
    sys.exit(1 if findings else 0)


if __name__ == "__main__":
    main()
