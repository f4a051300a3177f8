"""One simulation, in whatever process it is made: its generator, its call, and how it failed.

It needs NumPy and no JAX, so that a process for simulations starts at once. `main` is such a process:
`jaxlfi.tasks.supervisor` starts it, sends it the simulator and then one request per line, and reads one record
(`jaxlfi.io.records`) for each.
"""

import contextlib
import dataclasses
import json
import os
import queue
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any, BinaryIO, NamedTuple

import cloudpickle
import numpy as np

from jaxlfi.io import records
from jaxlfi.tasks import own_arrays

REASONS = ("error", "wrong_shape", "timeout", "crash")
"""Reasons why a single simulation can fail, besides the task's own."""
NOTHING = np.zeros(0)
LONGEST_MESSAGE = 300
"""Largest number of characters kept of an error's text."""


class Answer(NamedTuple):
    """The result of one simulation.

    Attributes:
        outcome: 0 for success, i for the task's i-th reason, -i for the i-th of `REASONS`.
        trajectory: empty if the outcome is negative.
        message: what is known of a failure.
    """

    outcome: int
    trajectory: np.ndarray = NOTHING
    message: str = ""

    @property
    def succeeded(self) -> bool:
        """Whether there is a trajectory, of finite numbers."""
        return self.outcome == 0 and bool(np.isfinite(self.trajectory).all())


class Request(NamedTuple):
    """One simulation to be made.

    Attributes:
        words: of the key of the simulations that it belongs to.
        index: its index among them.
        theta: in natural units, D numbers.
        shape: of its trajectory, or None if it is not known yet.
    """

    words: Sequence[int]
    index: int  # type: ignore[assignment]  # nobody asks this tuple for an element's index
    theta: Sequence[float]
    shape: Sequence[int] | None


class CrashError(RuntimeError):
    """A simulation whose own process was ended by a signal."""


def failed(reason: str, message: str = "") -> Answer:
    """A failure for one of `REASONS`."""
    words = " ".join(message.split())[:LONGEST_MESSAGE]
    printable = "".join(letter if letter.isprintable() else "?" for letter in words)  # strips terminal colours
    return Answer(-1 - REASONS.index(reason), message=printable)


def generator(words: Sequence[int], index: int) -> np.random.Generator:
    """The generator of one of many simulations, which does not depend on the process that makes it, or when."""
    return np.random.default_rng(np.random.SeedSequence(list(words), spawn_key=(index,)))


def simulated(function: Callable[..., Any], request: Request) -> Answer:
    """Make one simulation by `function(rng, theta[D])`, and check the result."""
    try:
        result = function(generator(request.words, request.index), np.asarray(request.theta, np.float32))
        trajectory, outcome = with_outcome(result)
        own_arrays.require_own_rows(trajectory)
        trajectory = own_arrays.array(trajectory)
    except CrashError as error:
        return failed("crash", str(error))
    except (Exception, SystemExit) as error:
        return failed("error", f"{type(error).__name__}: {error}")
    return checked(trajectory, outcome, request.shape)


def checked(trajectory: np.ndarray, outcome: Any, shape: Sequence[int] | None) -> Answer:
    """The answer of a simulator, or the failure "wrong_shape". Axes of length one are added or dropped."""
    wanted = "[T] or [T, C]" if shape is None else list(shape)
    long = lambda lengths: [length for length in lengths if length != 1]
    fits = trajectory.ndim >= 1 and (shape is None or long(trajectory.shape) == long(shape))
    if not fits or trajectory.dtype.kind not in records.KINDS:
        got = f"{trajectory.dtype} of shape {list(trajectory.shape)}"
        return failed("wrong_shape", f"expected numbers of shape {wanted}, got {got}{as_observed(shape)}")
    try:
        code = code_of(outcome)
    except ValueError as error:
        return failed("wrong_shape", str(error))
    return Answer(code, trajectory if shape is None else trajectory.reshape(shape))


def as_observed(shape: Sequence[int] | None) -> str:
    """Where the expected shape of a simulation comes from, for the end of an error message."""
    return "" if shape is None else f" (the observation has shape {list(shape)})"


def with_outcome(result: Any) -> tuple[Any, Any]:
    """A simulator's result with its outcome; success if it returns none."""
    return result if isinstance(result, tuple) and len(result) == 2 else (result, 0)


def code_of(outcome: Any) -> int:
    """An outcome as 0 or the number of the task's reason; negative ones count as the first.

    Raises:
        ValueError: for anything but one boolean or whole number.
    """
    if np.ndim(outcome) > 0:
        raise ValueError(f"expected a scalar outcome, got {own_arrays.described(outcome)}")
    outcome = own_arrays.outcomes(outcome)
    code = int(not outcome) if outcome.dtype == bool else int(outcome)
    return max(code, 0) or int(code < 0)


@dataclasses.dataclass(frozen=True)
class OneOfBatch:
    """A simulator of one parameter vector, made from a simulator of batches, `function(rng, theta[N, D])`."""

    function: Callable[..., Any]

    def __call__(self, rng: np.random.Generator, theta: np.ndarray) -> Any:
        """One simulation."""
        result = self.function(rng, theta[None])
        if isinstance(result, tuple) and len(result) == 2:
            (trajectory,), outcome = result
            with contextlib.suppress(TypeError):  # it is not a list, and is refused for what it is
                (outcome,) = outcome
            return trajectory, outcome
        (trajectory,) = result
        return trajectory


@dataclasses.dataclass(frozen=True)
class Trials:
    """A simulator of several independent trials, one after another, made from a simulator of one.

    It fails if one of them fails, for the first failure's reason.
    """

    function: Callable[..., Any]
    trials: int

    def __call__(self, rng: np.random.Generator, theta: np.ndarray) -> Any:
        """All trials of one parameter vector: their trajectories along the first axis."""
        trajectories, codes = [], []
        for _ in range(self.trials):
            trajectory, outcome = with_outcome(self.function(rng, theta.copy()))
            own_arrays.require_own_rows(trajectory)
            trajectories.append(own_arrays.array(trajectory))  # copied at once: the next trial may use the same memory
            codes.append(code_of(outcome))
        return np.concatenate(trajectories), next(filter(None, codes), 0)


def main() -> None:
    """Serve the process that started this one, until it closes the pipe or ends."""
    requests, answers = _streams()
    try:
        function = cloudpickle.loads(requests.read(int(requests.readline())))
    except Exception as error:  # whatever the simulator's module raises when it is imported
        _send(answers, {"refused": f"{type(error).__name__}: {error}"})
        return
    _send(answers, {"refused": None})
    inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(requests, inbox), daemon=True).start()
    while True:
        answer = simulated(function, Request(**json.loads(inbox.get())))
        _send(answers, {"outcome": answer.outcome, "message": answer.message}, answer.trajectory)


def _streams() -> tuple[BinaryIO, BinaryIO]:
    """The pipes from and to the other process; what a simulator prints goes to standard error instead."""
    requests, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    return requests, answers


def _receive(requests: BinaryIO, inbox: queue.SimpleQueue) -> None:
    """Pass requests on; when they end, end the process and all that it has started, as nobody waits for them."""
    for line in requests:
        inbox.put(line)
    if hasattr(os, "killpg") and os.getpgrp() == os.getpid():  # as `jaxlfi.tasks.supervisor` starts it
        os.killpg(os.getpgrp(), signal.SIGKILL)
    os._exit(0)


def _send(answers: BinaryIO, fields: dict[str, Any], trajectory: np.ndarray = NOTHING) -> None:
    answers.write(records.encoded(fields, trajectory))
    answers.flush()
