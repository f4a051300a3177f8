"""The other end of the socket: a robot served to a control loop in another process (`jaxlfi.robots.wire`)."""

import contextlib
import json
import socket
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.rl.deployment import Limits
from jaxlfi.robots import wire
from jaxlfi.robots.clock import Clock, Monotonic, Simulated
from jaxlfi.robots.interrupts import Interrupts
from jaxlfi.robots.robot import Command, Robot, RobotError

WATCHDOG = 1.0
"""Seconds without a request after which a robot is stopped."""
ROUNDING = 1e-6
"""By which commands may exceed limits."""
Journal = Callable[[Mapping[str, Any]], None]
"""Takes note of an event."""


def serve(
    listener: socket.socket,
    make: Callable[[Clock], Robot],
    observations: Sequence[str],
    actions: Sequence[str],
    moved: Sequence[int],
    limits: Limits,
    watchdog: float = WATCHDOG,
    journal: Journal = lambda event: None,
    clock: Callable[[], Clock] = Monotonic,
) -> None:
    """Serve one loop after another, until the process is ended.

    A robot is stopped exactly once: when it is asked to, when the connection ends or no request comes for a while, when
    a request is damaged or a command beyond the limits, after any exception of its own or of the journal, and before
    SIGINT or SIGTERM ends the process. Commands are checked by the server's own clock, and none is let before there was
    an observation.

    Args:
        listener: that connections come to (`listen`).
        make: makes a robot for a connection, by the connection's clock.
        observations: names of the numbers that the robot gives.
        actions: names of the displacements that it takes.
        moved: places of the measured positions of the set-points in an observation, one an action.
        limits: of the set-points.
        watchdog: seconds that may pass without a request.
        journal: takes note of connections ("begun"), commands ("act") and stops ("stopped").
        clock: makes a connection's clock. `Simulated` ones follow the loop's time: for robots that live in it.

    Raises:
        Interrupted: after SIGINT or SIGTERM.
    """
    names = {"observations": list(observations), "actions": list(actions)}
    with Interrupts() as interrupts:
        while True:
            with interrupts.waiting():
                connection, _ = listener.accept()
            with connection:
                connection.settimeout(watchdog)
                _Session(make, clock(), names, list(moved), limits, journal, interrupts).run(wire.Lines(connection))


def listen(port: int, host: str = "127.0.0.1") -> socket.socket:
    """A socket that connections can come to; by default from this very host only. Port 0 is any that is free."""
    return socket.create_server((host, port))


def write_to(path: Path) -> Journal:
    """A journal in a file, a line of JSON an event.

    Raises:
        OSError: for a file that cannot be written.
    """
    file = path.open("a", buffering=1)
    return lambda event: file.write(json.dumps(event) + "\n")


class _Session:
    """A robot while a loop is connected to it."""

    def __init__(self, make, clock: Clock, names, moved, limits: Limits, journal: Journal, interrupts: Interrupts):
        self.make, self.clock, self.names, self.moved, self.limits = make, clock, names, moved, limits
        self.journal, self.interrupts = journal, interrupts
        self.robot: Robot | None = None
        self.target: np.ndarray | None = None  # where the set-points are, once it is known
        self.sent: float | None = None

    def run(self, lines: wire.Lines) -> None:
        """From hello to the stop."""
        why = "the server was ended"
        try:
            self.journal({"event": "begun"})
            self.robot = self.make(self.clock)
            self._greet(lines)
            while (message := self._next(lines))["type"] != "stop":
                kind, contents = self._answer(message)
                lines.send(kind, **contents)
            why = "asked to"
        except TimeoutError:
            why = "no request came in time"
        except ConnectionError:
            why = "the connection ended"
        except Exception as error:  # a driver may raise anything; the next connection has a new one
            why = str(error) or type(error).__name__
        finally:
            why = self._stop(why)
        self._part(lines, why)

    def _stop(self, why: str) -> str:
        """Stop the robot if there is one, and say why it was stopped."""
        try:
            if self.robot is not None:
                self.robot.stop()
        except Exception as error:
            why = f"{why}; and stopping the robot failed: {error}"
        with contextlib.suppress(Exception):  # a journal that fails does not end the server
            self.journal({"event": "stopped", "why": why})
        return why

    def _part(self, lines: wire.Lines, why: str) -> None:
        """The last words, for whoever still listens."""
        try:
            if why == "asked to":
                lines.send("stopped")
                return
            lines.send("error", message=why)
            while self._next(lines)["type"] != "stop":
                pass
            lines.send("stopped")
        except OSError:
            return

    def _next(self, lines: wire.Lines) -> dict[str, Any]:
        with self.interrupts.waiting():
            return lines.receive()

    def _greet(self, lines: wire.Lines) -> None:
        message = self._next(lines)
        wire.check_hello(message)
        for what, expected in self.names.items():
            if message.get(what) != expected:
                raise RobotError(f"expected {what} {expected}, got {message.get(what)}")
        about = getattr(self.robot, "about", {})
        lines.send("hello", protocol=wire.PROTOCOL, version=wire.VERSION, about=about)

    def _answer(self, message: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
        if message["type"] not in ("observe", "act"):
            raise RobotError(f"expected observe, act or stop, got {message['type']!r}")
        now = self._now(wire.number(message, "now"))
        if message["type"] == "observe":
            seen = self.robot.observe()
            if seen is None:
                return "nothing", {}
            if self.sent is None:  # from where the first command has to begin
                values = np.asarray(seen.values, float)
                self.target = values[self.moved] if seen.target is None else np.asarray(seen.target, float)
            return "observation", vars(seen)
        slot, displacement, target = (
            int(wire.number(message, "slot")),
            wire.numbers(message, "displacement"),
            wire.numbers(message, "target"),
        )
        if self.target is None:
            raise RobotError("expected an observation before the first command, got none")
        self._check(now, displacement, target)
        self.journal({"event": "act", "now": now, "displacement": displacement.tolist(), "target": target.tolist()})
        self.robot.act(Command(slot, displacement, target))
        self.target, self.sent = target, now
        return "done", {}

    def _now(self, of_loop: float) -> float:
        """The time, which for a simulated robot is that of the loop."""
        if isinstance(self.clock, Simulated):
            self.clock.sleep_until(of_loop)
        return self.clock.now()

    def _check(self, now: float, displacement: np.ndarray, target: np.ndarray) -> None:
        """Refuse commands that a loop should not have sent."""
        limits, size = self.limits, len(self.limits.step)
        if displacement.shape != (size,) or target.shape != (size,):
            raise RobotError(f"expected {size} set-points, got {target.tolist()} after {displacement.tolist()}")
        expected = self.target + displacement
        elapsed = np.inf if self.sent is None else now - self.sent
        safe = (
            (np.abs(displacement) <= np.add(limits.step, ROUNDING)).all()  # also refuses NaN
            and (target >= np.subtract(limits.low, ROUNDING)).all()
            and (target <= np.add(limits.high, ROUNDING)).all()
            and (np.abs(target - expected) <= ROUNDING).all()
            and np.linalg.norm(displacement) <= limits.speed * elapsed + ROUNDING
        )
        if not safe:
            raise RobotError(f"expected a command within {limits}, got {displacement.tolist()} to {target.tolist()}")
