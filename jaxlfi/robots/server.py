"""The other end of the socket: a robot served to a control loop in another process (`jaxlfi.robots.wire`)."""

import json
import socket
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.rl.deployment import Limits
from jaxlfi.robots import wire
from jaxlfi.robots.clock import Simulated
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
    make: Callable[[Simulated], Robot],
    observations: Sequence[str],
    actions: Sequence[str],
    limits: Limits,
    watchdog: float = WATCHDOG,
    journal: Journal = lambda event: None,
) -> None:
    """Serve one loop after another, until the process is ended.

    A robot is stopped exactly once: when it is asked to, when the connection ends or no request comes for a while, when
    a request is damaged or a command beyond the limits, after any exception of its own, and before SIGINT or SIGTERM
    ends the process.

    Args:
        listener: that connections come to (`listen`).
        make: makes a robot for a connection; a simulated one may live in the loop's time, which the clock shows.
        observations: names of the numbers that the robot gives.
        actions: names of the displacements that it takes.
        limits: of the set-points.
        watchdog: seconds that may pass without a request.
        journal: takes note of connections ("begun"), commands ("act") and stops ("stopped").

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
                clock = Simulated()
                _Session(make(clock), clock, names, limits, journal, interrupts).run(wire.Lines(connection))


def listen(port: int, host: str = "127.0.0.1") -> socket.socket:
    """A socket that connections can come to; by default from this very host only. Port 0 is any that is free."""
    return socket.create_server((host, port))


def write_to(path: Path) -> Journal:
    """A journal in a file, a line of JSON an event."""

    def journal(event: Mapping[str, Any]) -> None:
        with path.open("a") as file:
            file.write(json.dumps(event) + "\n")

    return journal


class _Session:
    """A robot while a loop is connected to it."""

    def __init__(self, robot: Robot, clock: Simulated, names, limits: Limits, journal: Journal, interrupts: Interrupts):
        self.robot, self.clock, self.names, self.limits = robot, clock, names, limits
        self.journal, self.interrupts = journal, interrupts
        self.target: np.ndarray | None = None
        self.sent: float | None = None

    def run(self, lines: wire.Lines) -> None:
        """From hello to the stop."""
        self.journal({"event": "begun"})
        why = "the server was ended"
        try:
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
            self.robot.stop()
            self.journal({"event": "stopped", "why": why})
        self._part(lines, why)

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
        now = wire.number(message, "now")
        self.clock.sleep_until(now)
        if message["type"] == "observe":
            seen = self.robot.observe()
            if seen is None:
                return "nothing", {}
            if self.sent is None and seen.target is not None:
                self.target = np.asarray(seen.target, float)  # from which the first command has to begin
            return "observation", vars(seen)
        slot, displacement, target = (
            int(wire.number(message, "slot")),
            wire.numbers(message, "displacement"),
            wire.numbers(message, "target"),
        )
        self._check(now, displacement, target)
        self.journal({"event": "act", "now": now, "displacement": displacement.tolist(), "target": target.tolist()})
        self.robot.act(Command(slot, displacement, target))
        self.target, self.sent = target, now
        return "done", {}

    def _check(self, now: float, displacement: np.ndarray, target: np.ndarray) -> None:
        """Refuse commands that a loop should not have sent."""
        limits, size = self.limits, len(self.limits.step)
        if displacement.shape != (size,) or target.shape != (size,):
            raise RobotError(f"expected {size} set-points, got {target.tolist()} after {displacement.tolist()}")
        expected = target if self.target is None else self.target + displacement
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
