"""A robot in another process, behind a socket (`jaxlfi.robots.wire`)."""

import dataclasses
import socket
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxlfi.robots import wire
from jaxlfi.robots.clock import Clock, Monotonic, Simulated
from jaxlfi.robots.robot import Command, Observation, RobotError

TIMEOUT = 0.5
"""Time limit of a reply, in s."""
PATIENCE = 20.0
"""Time limit of the first reply, while a robot gets ready, and of robots that live in the loop's time, in s."""
SIMULATED = "simulated"
"""Key by which a driver states that its robot lives in the loop's time."""


class SocketRobot:
    """A robot whose driver listens at an address.

    Attributes:
        about: the driver's information about the robot, to be recorded.
    """

    def __init__(
        self,
        address: str,
        observations: Sequence[str],
        actions: Sequence[str],
        remote: bool = False,
        timeout: float = TIMEOUT,
        clock: Clock | None = None,
        token: str | None = None,
        units: Mapping[str, Sequence[str]] | None = None,
    ):
        """Connect.

        Args:
            address: socket://HOST:PORT.
            observations: names of the expected numbers; the driver refuses others than its own.
            actions: names of the set-points' displacements, likewise.
            remote: allow a driver on another host.
            timeout: time limit of each reply but the first, in s.
            clock: clock of the loop, for simulated robots that live in its time.
            token: token that the driver asks for; needed if it is on another host.
            units: units of the observations and of the actions, which drivers need (`jaxlfi.robots.driver`).

        Raises:
            ValueError: for an invalid address, and for another host without permission or a token.
            RobotError: if no driver answers, or one with another protocol.
        """
        host, port = wire.address(address, remote)
        if token is None and not wire.is_local(host):
            raise ValueError(f"token: expected the one that the robot at {host}, another host, shares; got none")
        self._name, self._clock = f"robot {host}:{port}", Monotonic() if clock is None else clock
        try:
            self._lines = wire.Lines(socket.create_connection((host, port), timeout))
        except OSError as error:
            raise RobotError(f"{self._name}: expected a driver that listens, got: {error}") from error
        hello = {"protocol": wire.PROTOCOL, "version": wire.VERSION}
        hello |= {"observations": list(observations), "actions": list(actions)}
        self._lines.wait_for(max(timeout, PATIENCE))
        hello |= {} if units is None else {"units": {what: list(each) for what, each in units.items()}}
        try:
            reply = self._asked("hello", ("hello", "challenge"), **hello)
            if reply["type"] == "challenge":
                reply = self._asked("hello", ("hello",), **hello, proof=self._checked(lambda: _proof(token, reply)))
            self._checked(lambda: wire.check_hello(reply))
            self.about: dict[str, Any] = self._checked(lambda: wire.mapping(reply, "about"))
            self._lines.wait_for(timeout)
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
        """Ask the robot to stop, and close the connection, which stops it in any case."""
        try:
            self._lines.send("stop")  # it need not wait for other calls
            while self._lines.receive()["type"] not in ("stopped", "error"):
                pass  # the reply of an earlier call
        except OSError as error:
            raise RobotError(f"{self._name}: no answer to stop: {error}") from error
        finally:
            self._lines.close()

    def live_in(self, clock: Clock) -> None:
        """Let the robot live in the time of a loop from now on, which waits longer for each reply."""
        self._clock = clock
        self._lines.wait_for(PATIENCE)

    def _asked(self, kind: str, replies: Sequence[str], **contents: Any) -> dict[str, Any]:
        def ask() -> dict[str, Any]:
            self._lines.send(kind, **contents)
            reply = self._lines.receive()
            if reply["type"] == "error":
                raise RobotError(f"its driver refused {kind}: {wire.short(reply.get('message'), 200)}")
            if reply["type"] not in replies:
                raise RobotError(
                    f"expected {' or '.join(replies)} as the reply to {kind}, got {wire.short(reply['type'])!r}"
                )
            return reply

        return self._checked(ask)

    def _checked(self, work):
        """The result of the work; errors name the robot."""
        try:
            return work()
        except (OSError, OverflowError, ValueError) as error:
            raise RobotError(f"{self._name}: {error}") from error


class SocketDriver:
    """A driver in another process (`jaxlfi.robots.driver`), which `jaxlfi.robots.server.serve_driver` serves.

    A driver that states that it is `simulated` lives in the loop's time: it has a `simulated_clock`.
    """

    def __init__(self, address: str, remote: bool = False, token: str | None = None, timeout: float = TIMEOUT):
        """It is not connected yet.

        Args:
            address: socket://HOST:PORT.
            remote: allow a driver on another host.
            token: token that the driver asks for; needed if it is on another host.
            timeout: time limit of each reply, in s.
        """
        self._address, self._remote, self._token, self._timeout = address, remote, token, timeout
        self._robot: SocketRobot | None = None
        self._names: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
        self._given: np.ndarray | None = None
        self._slot = 0

    def connect(self, signals: Mapping[str, str], controls: Mapping[str, str]) -> Mapping[str, Any]:
        """Connect to the driver, which may refuse; returns its information about itself.

        Raises:
            ValueError: for an invalid address, and for another host without permission or a token.
            RobotError: if no driver answers, or it refuses.
        """
        self._names = tuple(signals), tuple(controls)
        units = {"observations": list(signals.values()), "actions": list(controls.values())}
        robot = SocketRobot(self._address, *self._names, self._remote, self._timeout, token=self._token, units=units)
        if robot.about.get(SIMULATED) is True:
            self.simulated_clock = Simulated()
            robot.live_in(self.simulated_clock)
        self._robot = robot
        return robot.about

    def observe(self) -> Observation | None:
        """The latest observation, by name."""
        found = self._connected.observe()
        if found is None:
            return None
        signals, controls = self._names
        if len(found.values) != len(signals):
            raise RobotError(f"robot: expected {len(signals)} numbers, got {len(found.values)}")
        values = dict(zip(signals, found.values.tolist(), strict=True))
        target = None if found.target is None else dict(zip(controls, found.target.tolist(), strict=False))
        return dataclasses.replace(found, values=values, target=target)

    def act(self, controls: Mapping[str, float]) -> None:
        """Send the controls."""
        given = np.array([controls[name] for name in self._names[1]], float)
        change = np.zeros(len(given)) if self._given is None else given - self._given
        self._connected.act(Command(self._slot, change, given))
        self._given, self._slot = given, self._slot + 1

    def stop(self) -> None:
        """Stop the robot, if it is connected."""
        if self._robot is not None:
            self._robot.stop()

    @property
    def _connected(self) -> SocketRobot:
        if self._robot is None:
            raise RobotError("robot: expected connect before anything else, got none")
        return self._robot


def _proof(token: str | None, challenge: Mapping[str, Any]) -> str:
    if token is None:
        raise RobotError("it requires a shared token, got none")
    return wire.proof(token, wire.texts({"nonce": [challenge.get("nonce")]}, "nonce")[0])
