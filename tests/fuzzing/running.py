"""Cases one after another, in a temporary folder with all that they need."""

import contextlib
import dataclasses
import shutil
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from tests.fuzzing.cases import made, prepare
from tests.fuzzing.judging import PASSED, Case, Result, forget, judged, peak, sped_up
from tests.fuzzing.words import RIGHT

HERE = Path("a", "here")
"""Where commands run, below the folder that is watched: deep enough for names that lead up."""

KEPT = 2**30
"""Bytes of compiled programs beyond which they are forgotten between two cases."""


@dataclasses.dataclass(frozen=True)
class Ended:
    """A case that has ended.

    Attributes:
        number: it was made from this and the seed.
        case: what was done.
        result: how it ended.
        seconds: that it took.
        memory: the most that the case took, in bytes.
    """

    number: int
    case: Case
    result: Result
    seconds: float
    memory: int

    @property
    def finding(self) -> bool:
        """Whether it ended as it should not."""
        return self.result.outcome not in PASSED

    @property
    def command(self) -> str:
        """The command, where the words begin with one."""
        return next((name for name in RIGHT if list(self.case.words[: len(name.split())]) == name.split()), "none")


@contextlib.contextmanager
def prepared_folder(keep: Path | None = None) -> Iterator[Path]:
    """A temporary folder with good files; at the end it goes to `keep`, or away."""
    root = Path(tempfile.mkdtemp(prefix="jaxlfi-fuzzing-")).resolve()
    try:
        prepare(root / HERE)
        yield root
        if keep is not None:
            shutil.copytree(root, keep, symlinks=True)
    finally:
        shutil.rmtree(root, ignore_errors=True)


def fuzz(root: Path, seed: int, numbers: Iterable[int]) -> Iterator[Ended]:
    """Run cases in a prepared folder, and say of each how it ended."""
    with sped_up():
        peak()
        least = peak()  # with the programs of the good files: of observations, they serve the first cases
        for number in numbers:
            if peak() > least + KEPT:
                least = forget()
            case = made(seed, number, root / HERE)
            began = time.monotonic()
            result, memory = judged(case, root, root / HERE)
            yield Ended(number, case, result, time.monotonic() - began, memory)
