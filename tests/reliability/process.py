"""Processes under test: forked from one that has imported the library, so that each begins within a second."""

import contextlib
import dataclasses
import importlib
import os
import signal
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path

from tests.reliability import injection
from tests.reliability.injection import Blow, Window

ENDED = 120.0
"""Seconds after which a process is taken to hang."""


@dataclasses.dataclass(frozen=True)
class Ended:
    """What became of a process.

    Attributes:
        status: its exit status; that of the signal, negative, where one ended it.
        seconds: that it ran.
        windows: of writing that it came to.
        errors: what it said on standard error.
        said: what it said on standard output.
    """

    status: int
    seconds: float
    windows: tuple[Window, ...]
    errors: str
    said: str

    @property
    def killed(self) -> bool:
        """Whether SIGKILL ended it."""
        return self.status == -signal.SIGKILL


class Running:
    """A process that runs one command of the command line in a folder."""

    def __init__(
        self, folder: Path, words: Sequence[str], blow: Blow | None = None, clock: bool = False, program: str = "jaxlfi"
    ):
        """Start it.

        Args:
            folder: that it works in.
            words: after `jaxlfi`.
            blow: what it does to itself.
            clock: whether its clock jumps back by a day as it runs.
            program: the module of the command; its words follow.
        """
        self._notes = folder.parent / f"{folder.name}.notes"
        self._notes.mkdir(exist_ok=True)
        for name in ("windows", "err", "out"):
            (self._notes / name).write_text("")
        self._began = time.monotonic()
        self.pid = os.fork()
        if self.pid == 0:
            self._become(folder, words, blow, clock, program)

    def _become(self, folder: Path, words: Sequence[str], blow: Blow | None, clock: bool, program: str) -> None:
        status = 1
        try:
            for number, name in ((1, "out"), (2, "err")):
                os.dup2(os.open(self._notes / name, os.O_WRONLY), number)
            sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
            os.chdir(folder)
            sys.argv = ["__main__.py" if program == "jaxlfi" else f"{program.split('.')[-1]}.py", *words]  # as of -m
            signal.signal(signal.SIGINT, signal.default_int_handler)
            injection.Watch(folder, self._notes / "windows", blow).install()
            if clock:
                injection.turn_back(86400.0, 1)
            main = importlib.import_module("jaxlfi.cli.parser" if program == "jaxlfi" else program).main
            status = main(list(words))
        except SystemExit as stop:
            status = stop.code
        except BaseException:
            traceback.print_exc()
        finally:
            for stream in (sys.stdout, sys.stderr):
                with contextlib.suppress(Exception):
                    stream.flush()
            os._exit(status)

    def wait(self, kill_after: float | None = None) -> Ended:
        """Wait until it has ended; kill it after so many seconds."""
        end = ENDED if kill_after is None else kill_after
        while True:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                break
            if time.monotonic() - self._began > end:
                os.kill(self.pid, signal.SIGKILL)
                _, status = os.waitpid(self.pid, 0)
                break
            time.sleep(0.005)
        return Ended(
            os.waitstatus_to_exitcode(status),
            time.monotonic() - self._began,
            tuple(injection.read(self._notes / "windows")),
            (self._notes / "err").read_text(),
            (self._notes / "out").read_text(),
        )

    def stopped(self) -> bool:
        """Wait until it has stopped itself by SIGSTOP; False where it ended."""
        _, status = os.waitpid(self.pid, os.WUNTRACED)
        return os.WIFSTOPPED(status)


def run(folder: Path, words: Sequence[str], **how) -> Ended:
    """Run a command to its end."""
    return Running(folder, words, **how).wait()
