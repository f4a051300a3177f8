"""A simulator that is a program, in any language: parameters on its command line, a trajectory on standard output."""

import dataclasses
import io
import json
import re
import shlex
import shutil
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.tasks.record_times import is_number, is_time
from jaxlfi.tasks.worker import CrashError

THETA, SEED = "theta", "seed"
SEEDS = 2**31
"""Seeds are whole numbers below this, so that they fit into a C int."""
_FIELD = re.compile(r"\{([^{}]*)\}")
_NPY = b"\x93NUMPY"


@dataclasses.dataclass(frozen=True)
class Command:
    """One simulation by a program, as the function of a `jaxlfi.HostSimulator` with `each`.

    No shell reads the command: it is split into words once, and a value can only be part of a word.

    Attributes:
        template: a line such as "./sim --theta {theta} --seed {seed}". "{theta}" as a word of its own becomes one word
            for each parameter, within a word they are joined by commas; "{NAME}" is the parameter of that name, and
            "{seed}" a whole number from 0 to 2^31 - 1, which differs between simulations.
        names: of the parameters.

    The program writes a trajectory to its standard output and ends with exit status 0: a table; an array as .npy; or
    JSON, a list of numbers (of lists of numbers) or {"trajectory": [...], "outcome": 0}, with an outcome as in
    `jaxlfi.Task`. A table is read as an observation's file is: a record on each line, with spaces or commas between its
    numbers; a row of headings and lines that begin with # are skipped, as is a first column whose heading says that it
    holds times.

    Raises:
        ValueError: for a program that is not found, an unknown field, or a parameter that is not passed on.

    Example:
        >>> command = Command("echo [{theta}, {seed}]", names=("stiffness",))
        >>> command(np.random.default_rng(0), np.array([2.5], np.float32)).shape
        (2,)
    """

    template: str
    names: Sequence[str]
    _words: tuple[str, ...] = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self):
        object.__setattr__(self, "names", tuple(self.names))
        if not isinstance(self.template, str) or "\0" in self.template:
            raise ValueError(f"command: expected a text, got {self.template!r}")
        try:
            words = shlex.split(self.template)
        except ValueError as error:
            raise ValueError(f"command: expected words as in a shell, got {self.template!r}: {error}") from error
        if not words or shutil.which(words[0]) is None:
            raise ValueError(f"command: expected an executable program as its first word, got {self.template!r}")
        if Path(words[0]).parent != Path():  # a path, not a name on PATH: it must be valid from other folders
            words[0] = str(Path(words[0]).absolute())
        used = {field for word in words for field in _FIELD.findall(word)}
        known = {THETA, SEED, *self.names}
        missing = () if THETA in used else [name for name in self.names if name not in used]
        if missing or used - known:
            raise ValueError(
                f"command: expected {{theta}} or each of {list(self.names)} in braces, and {{seed}} where it is "
                f"random, got {self.template!r}"
            )
        object.__setattr__(self, "_words", tuple(words))

    def words(self, theta: np.ndarray, seed: int) -> list[str]:
        """The words of one simulation's command."""
        numbers = [f"{value:.9g}" for value in np.asarray(theta).tolist()]  # enough digits for single precision
        values = {THETA: ",".join(numbers), SEED: str(seed)} | dict(zip(self.names, numbers, strict=True))
        filled = []
        for word in self._words:
            filled += numbers if word == f"{{{THETA}}}" else [_FIELD.sub(lambda field: values[field[1]], word)]
        return filled

    def __call__(self, rng: np.random.Generator, theta: np.ndarray) -> Any:
        """Run the program, and read its output.

        Raises:
            CrashError: if a signal ends it.
            RuntimeError: if its exit status is not 0.
            ValueError: for an output that cannot be read.
        """
        words = self.words(theta, int(rng.integers(SEEDS)))
        done = subprocess.run(words, stdin=subprocess.DEVNULL, capture_output=True, check=False)
        said = (done.stderr.decode(errors="replace").strip().splitlines() or ["nothing on standard error"])[-1]
        if done.returncode < 0:
            raise CrashError(f"{Path(words[0]).name}: ended by {_signal(-done.returncode)}: {said}")
        if done.returncode > 0:
            raise RuntimeError(f"{Path(words[0]).name}: exit status {done.returncode}: {said}")
        return read(done.stdout)


def read(output: bytes) -> Any:
    r"""A trajectory, or a trajectory and its outcome, from what a program wrote.

    Raises:
        ValueError: for anything but .npy, JSON and lines with the same number of numbers.

    Example:
        >>> read(b"[[0.5, 1.0], [0.6, 1.1]]").shape, read(b"0.5\n0.6\n0.8\n").shape
        ((2, 2), (3,))
    """
    if output.startswith(_NPY):
        return np.load(io.BytesIO(output), allow_pickle=False)
    try:
        value = json.loads(output)
        if isinstance(value, dict):
            return np.asarray(value["trajectory"]), value.get("outcome", 0)
        return np.asarray(value)
    except (ValueError, KeyError) as error:
        if (table := _table(output)) is not None:
            return table
        start = output[:60].decode(errors="replace")
        raise ValueError(
            "standard output: expected lines of as many numbers each, .npy, or JSON: a list of numbers, or "
            f'{{"trajectory": [...], "outcome": 0}}, got {start!r}'
        ) from error


def _table(output: bytes) -> np.ndarray | None:
    """Lines of numbers, [T, C], or [T] for a single line or column; None for anything else."""
    try:
        lines = [line for line in output.decode().splitlines() if line.strip() and not line.startswith("#")]
    except ValueError:  # not text
        return None
    headings = lines[0] if lines and not any(is_number(word) for word in _words(lines[0])) else None
    try:
        rows = np.array([[float(word) for word in _words(line)] for line in lines[headings is not None :]])
    except ValueError:  # words, or rows of different lengths
        return None
    if rows.ndim != 2:
        return None
    first = "" if headings is None else headings.split(",")[0] if "," in headings else headings.split()[0]
    if first and is_time(first) and rows.shape[1] > 1 and np.all(np.diff(rows[:, 0]) > 0):
        rows = rows[:, 1:]
    return rows.reshape(-1) if 1 in rows.shape else rows


def _words(line: str) -> list[str]:
    return line.replace(",", " ").split()


def _signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
