"""A robot in another process, behind a socket (`jaxlfi.robots.wire`)."""

import socket
from collections.abc import Sequence
from typing import Any

from jaxlfi.robots import wire
from jaxlfi.robots.clock import Clock, Monotonic
from jaxlfi.robots.robot import Command, Observation, RobotError

TIMEOUT = 0.5
"""Seconds that a reply may take."""


class SocketRobot:
    """A robot whose driver listens at an address.

    Attributes:
        about: what the driver says of the robot, to be recorded.
    """

    def __init__(
        self,
        address: str,
        observations: Sequence[str],
        actions: Sequence[str],
        remote: bool = False,
        timeout: float = TIMEOUT,
        clock: Clock | None = None,
    ):
        """Connect.

        Args:
            address: socket://HOST:PORT.
            observations: names of the numbers that are expected; the driver refuses others than its own.
            actions: names of the set-points' displacements, likewise.
            remote: let the driver be on another host.
            timeout: for each reply, in s.
            clock: the loop's, for simulated robots that live in its time.

        Raises:
            ValueError: for what is no address, or one of another host.
            RobotError: where no driver answers, or one of another protocol.
        """
        host, port = wire.address(address, remote)
        self._name, self._clock = f"robot {host}:{port}", Monotonic() if clock is None else clock
        try:
            self._lines = wire.Lines(socket.create_connection((host, port), timeout))
        except OSError as error:
            raise RobotError(f"{self._name}: expected a driver that listens, got: {error}") from error
        hello = {"protocol": wire.PROTOCOL, "version": wire.VERSION}
        try:
            reply = self._asked("hello", ("hello",), **hello, observations=list(observations), actions=list(actions))
            self._checked(lambda: wire.check_hello(reply))
            self.about: dict[str, Any] = self._checked(lambda: wire.mapping(reply, "about"))
        except RobotError:
            self._lines.close()
            raise

    def observe(self) -> Observation | None:
        """The latest observation, or None."""
        reply = self._asked("observe", ("observation", "nothing"), now=self._clock.now())
        if reply["type"] == "nothing":
            return None
        return self._checked(
            lambda: Observation(
                values=wire.numbers(reply, "values"),
                number=int(wire.number(reply, "number")),
                age=wire.number(reply, "age"),
                target=None if reply.get("target") is None else wire.numbers(reply, "target"),
                extras=wire.mapping(reply, "extras"),
            )
        )

    def act(self, command: Command) -> None:
        """Send a command."""
        contents = {"slot": command.slot, "displacement": command.displacement, "target": command.target}
        self._asked("act", ("done",), now=self._clock.now(), **contents)

    def stop(self) -> None:
        """Have the robot stop, and end the connection, upon which it stops in any case."""
        try:
            self._lines.send("stop")
            while self._lines.receive()["type"] not in ("stopped", "error"):
                pass  # a reply that came too late
        except OSError as error:
            raise RobotError(f"{self._name}: no answer to stop: {error}") from error
        finally:
            self._lines.close()

    def _asked(self, kind: str, replies: Sequence[str], **contents: Any) -> dict[str, Any]:
        def ask() -> dict[str, Any]:
            self._lines.send(kind, **contents)
            reply = self._lines.receive()
            if reply["type"] == "error":
                raise RobotError(f"its driver refused {kind}: {str(reply.get('message'))[:200]}")
            if reply["type"] not in replies:
                raise RobotError(f"expected {' or '.join(replies)} as the reply to {kind}, got {reply['type']!r}")
            return reply

        return self._checked(ask)

    def _checked(self, work):
        """What it returns; errors name the robot."""
        try:
            return work()
        except (OSError, OverflowError, ValueError) as error:
            raise RobotError(f"{self._name}: {error}") from error
