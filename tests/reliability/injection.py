"""What is done to a process from within: it is killed or stopped at a window of writing, or its clock goes wrong.

A window is one call that changes a file or a folder: a write to an open file, `os.replace`, `os.rename`, `os.fsync`,
`os.truncate`, `os.mkdir`, `os.rmdir`, `os.unlink`. They are numbered from 0 in the order in which a process makes them
below one folder. All of this is wrapped around Python's own functions in the process under test; the library knows none
of it.
"""

import contextlib
import dataclasses
import io
import os
import signal
import threading
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

MOMENTS = {"write": ("before", "midway", "after")}
"""At which a process is ended in a window; the other operations have no middle."""
OTHERS = ("before", "after")


@dataclasses.dataclass(frozen=True)
class Window:
    """One operation of a process on a file.

    Attributes:
        operation: its name.
        path: relative to the folder that is watched.
    """

    operation: str
    path: str

    @property
    def moments(self) -> tuple[str, ...]:
        """Moments at which a process can be killed in it."""
        return MOMENTS.get(self.operation, OTHERS)


@dataclasses.dataclass(frozen=True)
class Blow:
    """What a process does to itself.

    Attributes:
        window: number of the window.
        moment: of `Window.moments`.
        signal: that it sends to itself.
    """

    window: int
    moment: str
    signal: int = signal.SIGKILL


class Watch:
    """Records all windows below a folder in a file, and strikes at one."""

    def __init__(self, folder: Path, log: Path, blow: Blow | None = None):
        """Nothing is wrapped yet."""
        self._folder, self._blow = str(folder) + os.sep, blow
        self._log = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        self._count, self._lock = 0, threading.RLock()

    def install(self) -> None:
        """Wrap the functions of this process."""
        for name in ("replace", "rename", "truncate", "mkdir", "rmdir", "unlink"):
            setattr(os, name, self._wrapped(name, getattr(os, name)))
        os.fsync = self._wrapped("fsync", os.fsync)
        opened = io.open

        def watched(file: Any, mode: str = "r", *rest: Any, **more: Any) -> Any:
            stream = opened(file, mode, *rest, **more)
            place = self._place(file, None)
            return stream if place is None or set(mode) <= set("rbt") else Stream(stream, place, self)

        io.open = watched

    def _place(self, path: Any, within: int | None) -> str | None:
        """A path relative to the folder; None outside."""
        with contextlib.suppress(OSError, TypeError, ValueError):
            if isinstance(path, int):
                whole = os.readlink(f"/proc/self/fd/{path}")
            else:
                base = os.getcwd() if within is None else os.readlink(f"/proc/self/fd/{within}")
                whole = os.path.normpath(os.path.join(base, os.fsdecode(path)))
            if (whole + os.sep).startswith(self._folder):
                return whole[len(self._folder) :] or "."
        return None

    def _wrapped(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def around(path: Any, *rest: Any, **more: Any) -> Any:
            place = self._place(path, more.get("dir_fd"))
            if place is None:
                return function(path, *rest, **more)
            return self.around(name, place, lambda: function(path, *rest, **more), lambda: None)

        return around

    def around(self, name: str, place: str, do: Callable[[], Any], half: Callable[[], Any]) -> Any:
        """Do something in a window, and strike before, midway or after if it is this one's turn."""
        with self._lock:
            number, self._count = self._count, self._count + 1
            os.write(self._log, f"{name}\t{place}\n".encode())
            moment = self._blow.moment if self._blow is not None and self._blow.window == number else None
            if moment == "midway":
                half()
            if moment in ("before", "midway"):
                os.kill(os.getpid(), self._blow.signal)
            done = do()
            if moment == "after":
                os.kill(os.getpid(), self._blow.signal)
            return done


class Stream:
    """An open file whose writes are windows; each is with the system when it returns."""

    def __init__(self, stream: Any, place: str, watch: Watch):
        """As it was opened."""
        self._stream, self._place, self._watch = stream, place, watch

    def write(self, content: Any) -> int:
        """Write and flush."""

        def some(part: Any) -> int:
            written = self._stream.write(part)
            self._stream.flush()
            return written

        half = lambda: some(content[: len(content) // 2])
        return self._watch.around("write", self._place, lambda: some(content), half)

    def __enter__(self) -> "Stream":
        """The same."""
        return self

    def __exit__(self, *error: Any) -> None:
        """Close it."""
        self._stream.close()

    def __getattr__(self, name: str) -> Any:
        """All else is the file's."""
        return getattr(self._stream, name)


def read(log: Path) -> list[Window]:
    """The windows that a process came to."""
    return [Window(*line.split("\t")) for line in log.read_text().splitlines()]


def turn_back(seconds: float, after: int) -> None:
    """Let the clock of this process jump back once it has been asked so often; intervals are measured by another."""
    asked, true, true_ns = 0, time.time, time.time_ns

    def late() -> float:
        nonlocal asked
        asked += 1
        return seconds if asked > after else 0.0

    class Clock(datetime):
        """A wall clock."""

        @classmethod
        def now(cls, tz: Any = None) -> datetime:
            return datetime.fromtimestamp(time.time(), tz)

    from jaxlfi.io import provenance

    time.time = lambda: true() - late()
    time.time_ns = lambda: true_ns() - int(1e9 * late())
    provenance.datetime = Clock
