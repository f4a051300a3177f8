"""A process for simulations that may hang or crash: killed if one takes too long, replaced if one ends it.

Every worker of an executor, whether a thread of this process or a worker of a cluster, keeps its own such process
(`simulate_supervised`). A simulation that crashes its process leaves the worker and other simulations running.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from typing import Any

from jaxlfi.io import records
from jaxlfi.tasks.worker import Answer, Request, failed

REFUSED = -100
"""The outcome of a simulation whose worker cannot load the simulator at all."""
_own = threading.local()


class Supervisor:
    """A process with one simulator, started when it is first needed."""

    def __init__(self, payload: bytes):
        """Nothing is started yet.

        Args:
            payload: the simulator, as cloudpickle writes it.
        """
        self.payload = payload
        self._process: Any = None  # a subprocess.Popen with pipes, once it is started

    def simulate(self, request: Request, timeout: float | None) -> Answer:
        """Make one simulation in the process.

        Args:
            request: the simulation.
            timeout: seconds after which the process is killed; None waits forever.
        """
        if self._process is None or self._process.poll() is not None:
            self.stop()
            if (refused := self._start()) is not None:
                return Answer(REFUSED, message=refused)
        process, late = self._process, threading.Event()

        def end() -> None:
            late.set()
            _kill(process)

        timer = threading.Timer(timeout or 0, end)
        if timeout is not None:
            timer.start()
        record = self._ask(json.dumps(request._asdict()).encode() + b"\n")
        timer.cancel()
        if timeout is not None:
            timer.join()
        if record is not None:
            if late.is_set():  # killed just after it had answered
                self.stop()
            fields, trajectory = record
            return Answer(fields["outcome"], trajectory, fields["message"])
        self.stop()
        if late.is_set():
            return failed("timeout", f"took longer than {timeout:g} s")
        return failed("crash", f"its process ended with {_status(process.returncode)}")

    def stop(self) -> None:
        """End the process, if there is one."""
        process, self._process = self._process, None
        if process is None:
            return
        _kill(process)
        process.wait()
        for pipe in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                pipe.close()

    def end(self) -> None:
        """Kill the process from another thread, whatever it is doing: its simulation has then failed."""
        if (process := self._process) is not None:
            _kill(process)

    def _start(self) -> str | None:
        """Start the process; returns the reason if it cannot load the simulator."""
        places = [place or os.getcwd() for place in sys.path]
        self._process = subprocess.Popen(
            [sys.executable, "-c", "from jaxlfi.tasks.worker import main; main()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(places)},
            start_new_session=True,  # so that everything the simulator started is killed with it
        )
        record = self._ask(b"%d\n" % len(self.payload) + self.payload)
        refused = "its process ended while it loaded the simulator" if record is None else record[0]["refused"]
        if refused is not None:
            self.stop()
        return refused

    def _ask(self, message: bytes) -> Any:
        """Send a message and wait for the record that answers it; None if the process has ended."""
        try:
            self._process.stdin.write(message)
            self._process.stdin.flush()
        except OSError:
            return None
        return records.read(self._process.stdout)

    def __del__(self):
        if sys is not None and not sys.is_finalizing():
            self.stop()


def simulate_supervised(payload: bytes, request: Request, timeout: float | None) -> Answer:
    """Make one simulation in the process that this thread keeps; executors are given this function."""
    supervisor = getattr(_own, "supervisor", None)
    if supervisor is None or supervisor.payload != payload:
        if supervisor is not None:
            supervisor.stop()
        supervisor = _own.supervisor = Supervisor(payload)
        getattr(_own, "all", []).append(supervisor)
    return supervisor.simulate(request, timeout)


def enlist(supervisors: list[Supervisor]) -> None:
    """Note all supervisors of this thread in a list, so that another thread can stop them."""
    _own.all = supervisors


def _kill(process: subprocess.Popen) -> None:
    """Kill a process and what it has started."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()


def _status(code: int) -> str:
    """An exit status in words."""
    with contextlib.suppress(ValueError):
        return f"signal {signal.Signals(-code).name}"
    return f"exit status {code}"
