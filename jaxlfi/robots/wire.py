"""The protocol that controls a robot in another process: lines of JSON over TCP, with a reply to each request.

| request                                              | reply                                                         |
|------------------------------------------------------|---------------------------------------------------------------|
| `hello`: `protocol`, `version`, `observations` and   | `hello`: `protocol`, `version`, `about`, what is to be        |
| `actions`, their names; `units` of both, for drivers | recorded about the robot; or `challenge`: `nonce`, if there   |
| (`jaxlfi.robots.driver`)                             | is a token, upon which `hello` is sent again with a `proof`   |
| `observe`: `now`                                     | `observation`: `number`, `age`, `values`, and, if there are   |
|                                                      | any, `target`, `extras`; or `nothing`                         |
| `act`: `now`, `slot`, `displacement`, `target`       | `done`, as soon as the motion has begun                       |
| `stop`                                               | `stopped`                                                     |

Every line is an object with a `type`, at most 1 MiB. Numbers are in the units of the policy's schema, `age` and `now`
in s, and an unknown number is null. `now` is the loop's clock, for simulated robots that live in the loop's time;
others use their own. Any request may be answered by `error` with a `message`, after which the robot has stopped. It
also stops when the connection ends, and when a second client connects, which is refused by an `error`.

A shared token shows that a client may command the robot: the proof is the HMAC-SHA256, in hexadecimal digits, of the
nonce with the token as its key. The token itself is never sent. Nothing is encrypted.
"""

import hashlib
import hmac
import ipaddress
import json
import math
import select
import socket
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.robots.robot import RobotError

PROTOCOL, VERSION = "jaxlfi-robot", 1
LONGEST = 2**20
"""Largest length of a line, in bytes."""
SHORTEST_TOKEN = 16
"""Smallest length of a token, in characters."""
LARGEST = 1e300
"""Largest magnitude of a number."""
BUSY = "busy: another client came while one had the robot"
"""Reason for refusing both clients."""


class Lines:
    """Messages through a socket."""

    def __init__(self, connection: socket.socket):
        """The socket's timeout applies to each message."""
        self._socket, self._rest = connection, b""

    def send(self, kind: str, **contents: Any) -> None:
        """Send a message; numbers that are not finite become null."""
        message = {"type": kind, **{name: _plain(value) for name, value in contents.items()}}
        self._socket.sendall(json.dumps(message, allow_nan=False).encode() + b"\n")

    def receive(self, others: socket.socket | None = None) -> dict[str, Any]:
        """The next message.

        Args:
            others: a listening socket, to which no other client may connect meanwhile.

        Raises:
            OSError: if the connection has ended, or nothing comes in time.
            RobotError: for what is not a message, and if another client connected, which is refused.
        """
        timeout = self._socket.gettimeout()
        ends = time.monotonic() + (timeout or math.inf)
        try:
            while b"\n" not in self._rest:
                if len(self._rest) > LONGEST:
                    raise RobotError(f"expected a line of at most {LONGEST} bytes, got more")
                if (left := ends - time.monotonic()) <= 0:  # a peer that trickles bytes is late all the same
                    raise TimeoutError("timed out")
                if others is not None:
                    ready, _, _ = select.select([self._socket, others], [], [], None if timeout is None else left)
                    if others in ready:
                        _refuse_next(others)
                        raise RobotError(BUSY)
                    if not ready:
                        continue
                self._socket.settimeout(None if timeout is None else left)
                if not (more := self._socket.recv(65536)):
                    raise ConnectionError("the connection was closed")
                self._rest += more
        finally:
            self._socket.settimeout(timeout)
        line, _, self._rest = self._rest.partition(b"\n")
        try:
            message = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise RobotError(f"expected a line of JSON, got {line[:40]!r}") from error
        if not isinstance(message, dict) or not isinstance(message.get("type"), str):
            raise RobotError(f"expected an object with a type, got {line[:40]!r}")
        return message

    def wait_for(self, seconds: float) -> None:
        """Set the time limit of each message from now on."""
        self._socket.settimeout(seconds)

    def close(self) -> None:
        """End the connection."""
        self._socket.close()


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(name): _plain(one) for name, one in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def numbers(message: Mapping[str, Any], name: str) -> np.ndarray:
    """A list of numbers in a message, NaN where it has null.

    Raises:
        RobotError: if it has none.
    """
    values = message.get(name)
    if not isinstance(values, list) or not all(value is None or _is_number(value) for value in values):
        raise RobotError(f"expected numbers as {name!r} of {message['type']!r}, got {short(values)}")
    return np.array([np.nan if value is None else value for value in values], float)


def number(message: Mapping[str, Any], name: str) -> float:
    """A number in a message.

    Raises:
        RobotError: if it has none.
    """
    if not _is_number(message.get(name)):
        raise RobotError(f"expected a number as {name!r} of {message['type']!r}, got {short(message.get(name))}")
    return message[name]


def texts(message: Mapping[str, Any], name: str, size: int | None = None) -> list[str]:
    """A list of texts in a message.

    Raises:
        RobotError: if it has none, or another number of them than expected.
    """
    found = message.get(name)
    if not isinstance(found, list) or not all(isinstance(one, str) for one in found) or size not in (None, len(found)):
        several = "texts" if size is None else f"{size} texts"
        raise RobotError(f"expected {several} as {name!r}, got {short(found)}")
    return found


def mapping(message: Mapping[str, Any], name: str) -> dict[str, Any]:
    """An object in a message; empty if there is none.

    Raises:
        RobotError: if there is something else.
    """
    found = message.get(name, {})
    if not isinstance(found, dict):
        raise RobotError(f"expected an object as {name!r} of {message['type']!r}, got {short(found)}")
    return found


def _is_number(value: Any) -> bool:
    """Whether it is a number that a float can hold."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def check_hello(message: Mapping[str, Any]) -> None:
    """Refuse another protocol or version.

    Raises:
        RobotError: saying what was expected.
    """
    got = tuple(message.get(name) for name in ("type", "protocol", "version"))
    if got != ("hello", PROTOCOL, VERSION):
        raise RobotError(f"expected hello of {PROTOCOL} of version {VERSION}, got {' '.join(map(short, got))}")


def proof(token: str, nonce: str) -> str:
    """The proof that a client knows the token."""
    return hmac.new(token.encode(), nonce.encode(), hashlib.sha256).hexdigest()


def check_proof(message: Mapping[str, Any], token: str, nonce: str) -> None:
    """Refuse a client that does not know the token.

    Raises:
        RobotError: not saying what was expected.
    """
    found = message.get("proof")
    if not isinstance(found, str) or not hmac.compare_digest(found.encode(), proof(token, nonce).encode()):
        raise RobotError(f"expected proof of the shared token, got {'another' if found else 'none'}")


def token_of(path: str | Path) -> str:
    """The token in a file, without surrounding white space.

    Raises:
        ValueError: for a file that is missing, or a token that is easily guessed.
    """
    try:
        text = Path(path).read_text().strip()
    except (OSError, ValueError) as error:
        raise ValueError(f"token: expected a file with a token, got {path}, which cannot be read") from error
    if len(text) < SHORTEST_TOKEN or "\n" in text:
        raise ValueError(f"token: expected one line of at least {SHORTEST_TOKEN} characters in {path}, got {len(text)}")
    return text


def is_local(host: str) -> bool:
    """Whether an address is a loopback address."""
    return ipaddress.ip_address(host).is_loopback


def _refuse_next(listener: socket.socket) -> None:
    """Tell the next client that the robot is busy."""
    connection, _ = listener.accept()
    with connection:
        try:
            connection.settimeout(0.1)
            Lines(connection).send("error", message=BUSY)
        except OSError:
            return  # it is already gone


def short(value: Any, length: int = 40) -> str:
    """The beginning of a value in one line; integers of more digits than Python prints are described by their size."""
    try:
        return " ".join(str(value)[:length].split())
    except ValueError:
        return "an integer of thousands of digits"


def address(text: str, remote: bool = False) -> tuple[str, int]:
    """Host and port of "socket://HOST:PORT".

    Args:
        text: the address.
        remote: whether hosts other than this one are allowed. Nothing is encrypted.

    Raises:
        ValueError: for other texts, and for other hosts if they are not allowed.
    """
    host, colon, port = text.removeprefix("socket://").rpartition(":")
    if not (host and colon and port.isdigit() and 0 <= int(port) < 65536):
        raise ValueError(f"robot: expected socket://HOST:PORT, got {text!r}")
    try:
        found = socket.gethostbyname(host)
    except OSError as error:
        raise ValueError(f"robot: expected a host, got {host!r}: {error}") from error
    if not (remote or is_local(found)):
        raise ValueError(f"robot: expected this host, such as 127.0.0.1, got {host!r}; --remote allows others")
    return found, int(port)
