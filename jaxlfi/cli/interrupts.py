"""How the process of a command ends early: at once on Ctrl-C, whatever it is doing, and quietly on a closed pipe.

Python raises KeyboardInterrupt in the main thread, and only when that thread executes Python again: native code that
compiles or computes delays it for as long as it takes. If native code has called Python (`__del__`, JAX's callback of
the garbage collector), the exception is printed and lost, and native modules may crash if it is raised while they are
imported. So none is raised: the process ends where the signal arrives, or in a second thread that waits for it. That is
safe at any moment, as files are written such that the process may be killed (`jaxlfi.io.files`), and workers end with
the process that started them (`jaxlfi.tasks.worker`). Only foreign code that may have something to clean up gets the
exception (`orderly`), and the process is ended if that does not end it in time.

This module imports neither jax nor numpy.
"""

import _thread
import contextlib
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

INTERRUPTED = 130
"""Exit status after SIGINT, as for any program that it ends."""
UNREAD = 141
"""Exit status if nobody reads the output any more, as for any program that SIGPIPE ends."""
PATIENCE = 0.4
"""Time from the signal within which KeyboardInterrupt must end the process, in s."""
LOOK = 0.02
"""Time between two checks whether the exception was lost, in s."""
SHOW_CURSOR = "\x1b[?25h\n"
"""Escape sequence for a terminal whose cursor a progress bar has hidden."""

_advice: list[tuple[str, Callable[[], str]]] = []
_speak_once = threading.Lock()
_orderly = False


@contextlib.contextmanager
def advising(program: str, advice: Callable[[], str]) -> Iterator[None]:
    """What to say about an interruption in this context; if contexts are nested, the outermost counts.

    Args:
        program: name of the command.
        advice: function that returns what follows "interrupted"; called only then, perhaps in another thread.
    """
    global _speak_once
    if not _advice:
        _speak_once = threading.Lock()
    _advice.append((program, advice))
    try:
        yield
    finally:
        _advice.pop()


@contextlib.contextmanager
def orderly(wanted: bool = True) -> Iterator[None]:
    """A context in which an interruption is a KeyboardInterrupt, as foreign code expects."""
    global _orderly
    before, _orderly = _orderly, wanted
    try:
        yield
    finally:
        _orderly = before


def report() -> int:
    """Say once that the command was interrupted; returns its exit status."""
    if _speak_once.acquire(blocking=False):
        print(_line(), file=sys.stderr)
    return INTERRUPTED


def is_unread(error: BaseException) -> bool:
    """Whether an error was raised because nobody reads standard output or standard error any more."""
    if not isinstance(error, BrokenPipeError) or not hasattr(select, "poll"):
        return isinstance(error, BrokenPipeError)
    poll = select.poll()
    for number in (1, 2):
        poll.register(number, 0)
    return any(events & select.POLLERR for _, events in poll.poll(0))


def watched(work: Callable[[], int]) -> int:
    """Do all the work of this process, and end the process if it is interrupted or its output is not read.

    Args:
        work: function that returns the exit status.

    Returns:
        The exit status of work that was not interrupted.
    """
    watch = _Watch()
    try:
        try:
            watch.begin()
            status = work()
        finally:
            watch.over = True
            _flush(sys.stdout)
    except BaseException as error:
        # Native code may turn a KeyboardInterrupt into any other exception.
        if not (watch.received or isinstance(error, KeyboardInterrupt) or is_unread(error)):
            raise
        status = UNREAD if is_unread(error) else report()
    if watch.received and status != INTERRUPTED:  # the caller that returned it has reported it
        status = report()
    if status in (INTERRUPTED, UNREAD):
        _end(status)
    return status


class _Watch:
    """The handler of SIGINT, and the thread that ensures that the signal ends the process.

    Attributes:
        received: whether there was a signal.
        over: whether the work is done: a signal then ends the process even during Python's own shutdown.
    """

    def __init__(self):
        self.received = self.over = False
        self._raises = True  # whether the next signal raises KeyboardInterrupt: one is enough, unless it is lost
        self._unraisable = sys.unraisablehook

    def begin(self) -> None:
        """Handle SIGINT if Python does so by default: it may be ignored, as in a shell's background."""
        default = signal.getsignal(signal.SIGINT) is signal.default_int_handler
        if not default or threading.current_thread() is not threading.main_thread():
            return
        signal.signal(signal.SIGINT, self._handle)
        sys.unraisablehook = self._lost
        if os.name == "posix":  # elsewhere a signal can write to sockets only
            heard, wake = os.pipe()
            os.set_blocking(wake, False)
            signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
            threading.Thread(target=self._wait, args=(heard,), name="interrupts", daemon=True).start()

    def _handle(self, number: int, frame: Any) -> None:
        self.received = True
        if self.over or not _orderly:
            self._end_now(flush=True)
        if self._raises:
            self._raises = False
            raise KeyboardInterrupt

    def _lost(self, unraisable: Any) -> None:
        if self.received and issubclass(unraisable.exc_type, KeyboardInterrupt):
            self._raises = True
        else:
            self._unraisable(unraisable)

    def _wait(self, heard: int) -> None:
        """Ensure that each signal ends the process, while no other code handles it (`jaxlfi.robots.interrupts`)."""
        ours = lambda: signal.getsignal(signal.SIGINT) == self._handle
        while True:
            if signal.SIGINT not in os.read(heard, 64) or not ours():
                continue
            until = time.monotonic() + (PATIENCE if _orderly else LOOK)
            while (left := until - time.monotonic()) > 0:
                time.sleep(min(LOOK, left))
                if self.received and self._raises:
                    _thread.interrupt_main()
            if ours():
                self._end_now()
            _thread.interrupt_main()  # tell its current handlers

    def _end_now(self, flush: bool = False) -> NoReturn:
        """End the process whatever its threads hold or wait for; `flush` may wait for the reader of its output."""
        with contextlib.suppress(Exception):
            if flush:
                sys.stdout.flush()
        with contextlib.suppress(Exception):
            if sys.stdout.isatty():
                os.write(1, SHOW_CURSOR.encode())
            if _speak_once.acquire(blocking=False):
                os.write(sys.stderr.fileno(), f"{_line()}\n".encode())
        os._exit(INTERRUPTED)


def _line() -> str:
    program, advice = _advice[0] if _advice else ("jaxlfi", str)
    return f"{program}: interrupted{advice()}"


def _end(status: int) -> NoReturn:
    """End the process without Python's own shutdown, which waits for native code and threads."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(BrokenPipeError, RuntimeError):  # a signal may interrupt this flush
            _flush(stream)
    os._exit(status)


def _flush(stream: Any) -> None:
    """Flush a stream; failures other than a pipe that nobody reads are left to Python's own shutdown."""
    try:
        if stream is not None:
            stream.flush()
    except BrokenPipeError:
        raise
    except (OSError, ValueError):
        return
