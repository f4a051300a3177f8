"""The other end of the socket: a robot served to a control loop in another process (`jaxlfi.robots.wire`)."""

import abc
import contextlib
import dataclasses
import json
import secrets
import socket
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.rl.deployment import ControlLimits, Limits
from jaxlfi.robots import wire
from jaxlfi.robots.clock import Clock, Monotonic, Simulated
from jaxlfi.robots.driver import Driven, Driver
from jaxlfi.robots.interrupts import Interrupts
from jaxlfi.robots.robot import Command, Observation, Robot, RobotError

WATCHDOG = 1.0
"""Time without a request after which a robot is stopped, in s."""
MOST = 10_000
"""Largest number of signals, and of controls, that a client may request."""
LEAP = 3600.0
"""Largest advance of a loop's time between two requests, for robots that live in it, in s."""
FREE = (-np.inf, np.inf, np.inf)
"""Limits of a control without limits."""
Journal = Callable[[Mapping[str, Any]], None]
"""Function that records an event."""


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
    token: str | None = None,
) -> None:
    """Serve one loop after another, until the process is ended.

    A robot is stopped exactly once: when it is asked to, when the connection ends or no request comes for a while, when
    a request is damaged or a command exceeds the limits, when a second client connects, after any exception of its own
    or of the journal, and before SIGINT or SIGTERM ends the process. Commands are checked by the server's own clock,
    and none is accepted before the first observation.

    Args:
        listener: listening socket (`listen`).
        make: function that makes a robot for a connection, from the connection's clock.
        observations: names of the numbers that the robot gives.
        actions: names of the displacements that it takes.
        moved: indices of the set-points' measured positions in an observation, one per action.
        limits: limits on the set-points.
        watchdog: longest time without a request, in s.
        journal: records connections ("begun"), commands ("act") and stops ("stopped").
        clock: function that makes a connection's clock. A `Simulated` one follows the loop's time, for robots that live
            in it.
        token: token that clients must know; needed if the listener's address is not local to this host.

    Raises:
        ValueError: for an address that other hosts reach, without a token.
        Interrupted: after SIGINT or SIGTERM.
    """
    names = {"observations": list(observations), "actions": list(actions)}
    _serve(listener, _Displaced(make, names, list(moved), limits), watchdog, journal, clock, token)


def serve_driver(
    listener: socket.socket,
    make: Callable[[Clock], Driver],
    limits: ControlLimits | None = None,
    watchdog: float = WATCHDOG,
    journal: Journal = lambda event: None,
    clock: Callable[[], Clock] = Monotonic,
    token: str | None = None,
) -> None:
    """Serve a driver to one loop after another, as `serve` does a robot; clients state what they need by name.

    Args:
        listener: listening socket (`listen`).
        make: function that makes a driver for a connection, from the connection's clock.
        limits: limits on actuators, which every command is checked against; others have none.
        watchdog: longest time without a request, in s.
        journal: records connections ("begun"), commands ("act") and stops ("stopped").
        clock: function that makes a connection's clock.
        token: token that clients must know; needed if the listener's address is not local to this host.

    Raises:
        ValueError: for an address that other hosts reach, without a token.
        Interrupted: after SIGINT or SIGTERM.
    """
    limits = ControlLimits((), (), (), ()) if limits is None else limits
    _serve(listener, _Named(make, limits), watchdog, journal, clock, token)


def _serve(
    listener: socket.socket,
    kind: "_Kind",
    watchdog: float,
    journal: Journal,
    clock: Callable[[], Clock],
    token: str | None,
) -> None:
    require_token(listener, token)
    with Interrupts() as interrupts:
        while True:
            with interrupts.waiting():
                connection, _ = listener.accept()
            with connection:
                connection.settimeout(watchdog)
                _Session(kind, clock(), journal, interrupts, listener, token).run(wire.Lines(connection))


def listen(port: int, host: str = "127.0.0.1") -> socket.socket:
    """A listening socket; by default for connections from this host only. Port 0 is any that is free."""
    return socket.create_server((host, port))


def require_token(listener: socket.socket, token: str | None) -> None:
    """Refuse to serve other hosts without a token.

    Raises:
        ValueError: naming the address.
    """
    host = listener.getsockname()[0]
    if token is None and not wire.is_local(host):
        raise ValueError(f"token: expected one for {host}, an address that other hosts reach, got none")


def write_to(path: Path) -> Journal:
    """A journal in a file, with one line of JSON per event.

    Raises:
        OSError: for a file that cannot be written.
    """
    file = path.open("a", buffering=1)

    def write(event: Mapping[str, Any]) -> None:
        file.write(json.dumps(event) + "\n")

    return write


class _Kind(abc.ABC):
    """What clients may request of a robot."""

    @abc.abstractmethod
    def opened(self, hello: Mapping[str, Any], clock: Clock) -> tuple[Robot, "ControlLimits | Limits"]:
        """The robot that a client requests, and its limits.

        Raises:
            RobotError: for a client that requests another robot.
        """

    @abc.abstractmethod
    def begin(self, seen: Observation) -> np.ndarray | None:
        """The set-points before the first command, if they are known."""


class _Displaced(_Kind):
    """A robot whose set-points are displaced; clients request all of its numbers, in order."""

    def __init__(
        self, make: Callable[[Clock], Robot], names: Mapping[str, list[str]], moved: list[int], limits: Limits
    ):
        self.make, self.names, self.moved, self.limits = make, names, moved, limits

    def opened(self, hello: Mapping[str, Any], clock: Clock) -> tuple[Robot, Limits]:
        for what, expected in self.names.items():
            if hello.get(what) != expected:
                raise RobotError(f"expected {what} {expected}, got {wire.short(hello.get(what))}")
        return self.make(clock), self.limits

    def begin(self, seen: Observation) -> np.ndarray | None:
        return np.asarray(np.asarray(seen.values, float)[self.moved] if seen.target is None else seen.target, float)


class _Named(_Kind):
    """A driver; clients request any of its numbers, by name."""

    def __init__(self, make: Callable[[Clock], Driver], limits: ControlLimits):
        self.make, self.limits = make, limits

    def opened(self, hello: Mapping[str, Any], clock: Clock) -> tuple[Robot, ControlLimits]:
        signals, controls = (_with_units(hello, what) for what in ("observations", "actions"))
        limits = {name: row for name, *row in zip(*dataclasses.astuple(self.limits), strict=True)}
        low, high, rate = zip(*(limits.get(name, FREE) for name in controls), strict=True) if controls else ((), (), ())
        return Driven(self.make(clock), signals, controls), ControlLimits(tuple(controls), low, high, rate)

    def begin(self, seen: Observation) -> np.ndarray | None:
        return None if seen.target is None else np.asarray(seen.target, float)


def _with_units(hello: Mapping[str, Any], what: str) -> dict[str, str]:
    """Names that a client requests, with their units."""
    names = wire.texts(hello, what)
    units = wire.texts(wire.mapping(hello, "units"), what, len(names)) if "units" in hello else [""] * len(names)
    if len(set(names)) < len(names) or len(names) > MOST:
        raise RobotError(f"expected {what} each once, {MOST} at most, got {len(names)}")
    return dict(zip(names, units, strict=True))


class _Session:
    """A robot while a loop is connected to it."""

    def __init__(
        self,
        kind: _Kind,
        clock: Clock,
        journal: Journal,
        interrupts: Interrupts,
        listener: socket.socket,
        token: str | None,
    ):
        self.kind, self.clock, self.journal, self.interrupts = kind, clock, journal, interrupts
        self.listener, self.token = listener, token
        self.robot: Robot | None = None
        self.seen = False  # whether there was an observation
        self.target: np.ndarray | None = None  # the set-points, once they are known
        self.sent: float | None = None
        self.told: float | None = None  # the loop's time

    def run(self, lines: wire.Lines) -> None:
        """From hello to the stop."""
        why = "the server was ended"
        try:
            self.journal({"event": "begun"})
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
        robot, self.robot = self.robot, None
        try:
            if robot is not None:
                robot.stop()
        except Exception as error:
            why = f"{why}; and stopping the robot failed: {error}"
        with contextlib.suppress(Exception):  # a journal that fails does not end the server
            self.journal({"event": "stopped", "why": why})
        return why

    def _part(self, lines: wire.Lines, why: str) -> None:
        """Send the last message, if the client still listens."""
        try:
            if why == "asked to":
                lines.send("stopped")
                return
            lines.send("error", message=wire.short(why, 1000))
            while self._next(lines)["type"] != "stop":
                pass
            lines.send("stopped")
        except OSError:
            return

    def _next(self, lines: wire.Lines) -> dict[str, Any]:
        """The next message; while there is a robot, no other client may connect."""
        with self.interrupts.waiting():
            return lines.receive(None if self.robot is None else self.listener)

    def _greet(self, lines: wire.Lines) -> None:
        message = self._next(lines)
        wire.check_hello(message)
        if self.token is not None:
            nonce = secrets.token_hex(16)
            lines.send("challenge", nonce=nonce)
            message = self._next(lines)
            wire.check_hello(message)
            wire.check_proof(message, self.token, nonce)
        self.robot, self.limits = self.kind.opened(message, self.clock)
        about = getattr(self.robot, "about", {})
        lines.send("hello", protocol=wire.PROTOCOL, version=wire.VERSION, about=about)

    def _answer(self, message: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
        if message["type"] not in ("observe", "act"):
            raise RobotError(f"expected observe, act or stop, got {wire.short(message['type'])!r}")
        if self.robot is None:
            raise RobotError("expected hello before anything else, got none")
        now = self._now(wire.number(message, "now"))
        if message["type"] == "observe":
            seen = self.robot.observe()
            if seen is None:
                return "nothing", {}
            if self.sent is None:  # where the first command must begin
                self.target, self.seen = self.kind.begin(seen), True
            return "observation", vars(seen)
        slot, displacement, target = (
            int(wire.number(message, "slot")),
            wire.numbers(message, "displacement"),
            wire.numbers(message, "target"),
        )
        if not self.seen:
            raise RobotError("expected an observation before the first command, got none")
        self._check(now, displacement, target)
        self.journal({"event": "act", "now": now, "displacement": displacement.tolist(), "target": target.tolist()})
        self.robot.act(Command(slot, displacement, target))
        self.target, self.sent = target, now
        return "done", {}

    def _now(self, of_loop: float) -> float:
        """The time, which for a simulated robot is that of the loop."""
        if isinstance(self.clock, Simulated):
            if self.told is not None and of_loop > self.told + LEAP:
                raise RobotError(f"expected a time within {LEAP:g} s of {self.told:g} s, got {of_loop:g} s")
            self.told = of_loop
            self.clock.sleep_until(of_loop)
        return self.clock.now()

    def _check(self, now: float, displacement: np.ndarray, target: np.ndarray) -> None:
        """Refuse commands that a loop should not have sent."""
        limits, size = self.limits, len(self.limits.low)
        if displacement.shape != (size,) or target.shape != (size,):
            raise RobotError(f"expected {size} set-points, got {target.tolist()} after {displacement.tolist()}")
        before = target - displacement if self.target is None else self.target
        elapsed = np.inf if self.sent is None else now - self.sent
        if not limits.allow(before, displacement, target, elapsed):
            raise RobotError(f"expected a command within {limits}, got {displacement.tolist()} to {target.tolist()}")
