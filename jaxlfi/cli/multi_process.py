"""A command in several processes, on one host or several: its flags, and how each process ends.

jax ends a process abruptly, with a long log, when another one is lost. The command therefore runs in a child process,
and this process says in one line how the child ended. This module imports neither jax nor numpy.
"""

import argparse
import contextlib
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NoReturn

from jaxlfi.cli import interrupts

if TYPE_CHECKING:
    from jaxlfi.io.processes import Processes

AUTO = "auto"
KEPT = 2**16
"""Number of bytes of the child's native log that are kept."""


def add_flags(command: argparse.ArgumentParser) -> None:
    """Add the flags of a command that can run in several processes."""
    hosts = command.add_argument_group("multi-host: run the same command on every host; process 0 writes")
    hosts.add_argument(
        "--coordinator",
        metavar="HOST:PORT",
        help="address that process 0 listens on; auto: get it and the process id from Slurm, Open MPI or Kubernetes",
    )
    hosts.add_argument("--process-id", type=int, metavar="I", help="index of this process, from 0")
    hosts.add_argument("--processes", type=int, metavar="N", help="number of processes")


def asked(words: Sequence[str]) -> bool:
    """Whether the words of a command ask for several processes."""
    return any(word.partition("=")[0] == "--coordinator" for word in words)


def wanted(arguments: argparse.Namespace) -> bool:
    """Whether a command is to run in several processes.

    Raises:
        ValueError: for inconsistent flags.
    """
    address, given = (getattr(arguments, name, None) for name in ("coordinator", "processes"))
    index = getattr(arguments, "process_id", None)
    if address is None and (given, index) == (None, None):
        return False
    if address == AUTO and (given, index) == (None, None):
        return True
    if address is None or given is None or index is None or address == AUTO:
        raise ValueError(
            "coordinator: expected --coordinator auto, or --coordinator HOST:PORT, --process-id I and --processes N"
        )
    host, colon, port = address.rpartition(":")
    if not (host and colon and port.isdigit()):
        raise ValueError(f"coordinator: expected HOST:PORT, got {address!r}")
    if not 0 <= index < given:
        raise ValueError(f"process_id: expected a number from 0 to {given - 1}, got {index}")
    return True


def join(arguments: argparse.Namespace) -> "Processes":
    """The processes that a command runs in; to be called before jax sees its devices.

    Raises:
        ValueError: if they cannot be joined.
    """
    from jaxlfi.io import processes

    if not wanted(arguments):
        return processes.ALONE
    return processes.join(arguments.coordinator, arguments.process_id, arguments.processes)


def work(command: Callable[[], int], advice: Callable[[], str], program: str, debug: bool = False) -> int:
    """Do a command's work in a child process; `debug` also shows the native log.

    If a process was lost, `advice` ends the line that says so.

    Returns:
        The exit status: the child's own; 2 if a signal ended it.
    """
    if not hasattr(os, "fork"):  # Windows: jax's own message must do
        return command()
    log, child_log = os.pipe()
    life, parent_life = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(log)
        os.close(parent_life)
        _in_child(command, child_log, life)
    os.close(child_log)
    os.close(life)
    before = signal.getsignal(signal.SIGINT)
    if before is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, lambda number, frame: _pass_on(child, number))  # the child reports the outcome
    kept = b""
    while text := os.read(log, KEPT):
        kept = (kept + text)[-KEPT:]
        if debug:
            os.write(2, text)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    os.close(parent_life)
    signal.signal(signal.SIGINT, before)
    if status >= 0:
        return status
    print(f"{program}: error: {_cause(-status, kept)}{advice()}", file=sys.stderr)
    return 2


def _in_child(command: Callable[[], int], log: int, life: int) -> NoReturn:
    """Do the work as long as the parent lives, with the log of native code apart from Python's output."""
    sys.stderr = os.fdopen(os.dup(2), "w", buffering=1)
    os.dup2(log, 2)
    threading.Thread(target=lambda: os.read(life, 1) or os._exit(1), daemon=True).start()
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    status = 1
    try:
        status = interrupts.watched(command)
    except BaseException:
        traceback.print_exc()
    finally:  # without jax's shutdown, which waits for the others
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _pass_on(child: int, number: int) -> None:
    """Pass a signal on: one that a terminal sends reaches parent and child, any other the parent alone."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(child, number)


def _cause(number: int, log: bytes) -> str:
    """In words, why the child was ended by a signal."""
    if b"oordination" in log:
        return "another process of this command was lost"
    return f"the process was ended by {signal.Signals(number).name}"
