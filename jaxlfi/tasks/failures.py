"""The messages of failed simulations, counted; messages that differ only in numbers are counted together."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxlfi.io import files

FILE = "failures.jsonl"
"""In a run folder, if anything is known of failures: one `Message` per line."""
KEPT = 20
"""Largest number of messages kept per round; failures with other messages are counted by their reason alone."""
MANY = 1000
"""Largest number of messages counted per round."""
_NUMBER = re.compile(r"0x[0-9a-fA-F]+|[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|\b[-+]?(?:nan|inf)\b")


class Failure(NamedTuple):
    """Simulations that failed for one reason, with one message.

    Attributes:
        reason: a name in `Task.reasons`.
        message: of the first of them, such as an exception's text or the last line that a program wrote on standard
            error; "" where nothing is known.
        count: how many.
    """

    reason: str
    message: str
    count: int  # type: ignore[assignment]  # nobody asks this tuple for an element's count


class Message(NamedTuple):
    """Failures with one message in one round."""

    round: int
    reason: str
    message: str
    count: int  # type: ignore[assignment]  # nobody asks this tuple for an element's count


class FailureLog:
    """The failure messages of a run's simulations.

    It is part of the structure of `Run`, a pytree: any two are equal, as messages do not change the structure.

    Attributes:
        reasons: names, in the order of their codes from 1.
        messages: by rounds.
    """

    def __init__(self, reasons: Sequence[str] = (), messages: Iterable[Message] = ()):
        """Keep reasons and messages."""
        self.reasons, self.messages = tuple(reasons), tuple(messages)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FailureLog)

    def __hash__(self) -> int:
        return hash(FailureLog)


class Tally:
    """Counts failures by reason and message."""

    def __init__(self):
        """Nothing has failed."""
        self._found: dict[tuple[str, str], list] = {}

    def add(self, reason: str, message: str, place: int, count: int = 1) -> None:
        """Count failures; of messages that differ only in numbers, the one of the first place is kept."""
        group = reason, _NUMBER.sub("#", message)
        if group not in self._found and len(self._found) >= MANY:
            return
        known = self._found.setdefault(group, [place, message, 0])
        known[2] += count
        if place < known[0]:
            known[:2] = place, message

    def commonest(self) -> list[Failure]:
        """All known failures, the most common first."""
        found = [(-count, place, reason, message) for (reason, _), (place, message, count) in self._found.items()]
        return [Failure(reason, message, -count) for count, _, reason, message in sorted(found)]


def together(parts: Iterable[tuple[FailureLog, np.ndarray]]) -> list[Failure]:
    """Failures of several runs, the most common first.

    Args:
        parts: of each run, its log, and its failures by round and reason, shape [rounds, R].

    Example:
        >>> messages = [Message(0, "error", "at 1.5", 2), Message(1, "error", "at 2.5", 1)]
        >>> log = FailureLog(("error", "non_finite"), messages)
        >>> together([(log, np.array([[2, 0], [2, 5]]))])
        [Failure(reason='non_finite', message='', count=5), Failure(reason='error', message='at 1.5', count=3), \
Failure(reason='error', message='', count=1)]
    """
    tally = Tally()
    for log, failed in parts:
        left = dict(zip(log.reasons, np.sum(failed, axis=0).tolist(), strict=True))
        for one in log.messages:
            tally.add(one.reason, one.message, one.round, one.count)
            left[one.reason] = left.get(one.reason, 0) - one.count
        for reason, count in left.items():
            if count > 0:
                tally.add(reason, "", 0, count)
    return tally.commonest()


def append(folder: Path, messages: Iterable[Message]) -> None:
    """Add a round's messages to a run folder."""
    for message in messages:
        files.append_line(folder / FILE, files.json_line(message._asdict()))


def read(folder: Path) -> list[Message]:
    """The messages of a run folder; none if it has no such file.

    Raises:
        ValueError: for a damaged file.
    """
    path = folder / FILE
    if not path.exists():
        return []
    try:
        return [_message(json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path}: expected messages of failures, got a damaged file") from error


def cut(folder: Path, rounds: int) -> list[Message]:
    """Remove messages of rounds that are repeated, and an incomplete line; returns those that stay."""
    path = folder / FILE
    if not path.exists():
        return []
    kept = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            message = _message(json.loads(line))
        except (ValueError, KeyError, TypeError, RecursionError):
            break
        if message.round < rounds:
            kept.append(message)
    files.write_bytes(path, "".join(files.json_line(message._asdict()) for message in kept).encode())
    return kept


def _message(line: Mapping[str, Any]) -> Message:
    return Message(int(line["round"]), str(line["reason"]), str(line["message"]), int(line["count"]))
