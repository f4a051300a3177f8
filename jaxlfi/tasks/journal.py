"""Finished simulations of an unfinished round, kept as they arrive."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from jaxlfi.io import records
from jaxlfi.tasks.failures import KEPT, Failure, Tally
from jaxlfi.tasks.worker import REASONS, Answer, Request

OnSimulation = Callable[[int, int], object]
"""Called when a simulation arrives, with the number that have arrived and the number wanted of those made together."""


class Journal:
    """Simulations by their key, index and parameters, kept in a file or not at all.

    Attributes:
        examples: the first message of each reason of failure.
        run: index of the batch's run for which failures are counted; None counts them for none.
    """

    def __init__(self, path: Path | None = None, on_simulation: OnSimulation = lambda done, wanted: None):
        """Read an existing file.

        Args:
            path: of the file, which need not exist; None keeps nothing.
            on_simulation: called for every simulation.
        """
        self.examples: dict[str, str] = {}
        self.run: int | None = None
        self._failures: dict[int, Tally] = {}
        self._path, self._on_simulation = path, on_simulation
        self._known: dict[tuple, Answer] = {}
        self._done, self._wanted = 0, 0
        self._file: BinaryIO | None = None
        if path is None or not path.exists():
            return
        for fields, trajectory in records.whole(path):
            request = Request(fields["words"], fields["index"], fields["theta"], trajectory.shape)
            self._known[_identity(request)] = Answer(fields["outcome"], trajectory, fields["message"])

    @property
    def failure_messages(self) -> str:
        """The first message of each failure reason, as the end of an error message."""
        return "".join(f"; {reason}: {message}" for reason, message in self.examples.items())

    def expect(self, wanted: int) -> None:
        """Announce how many simulations will be made together."""
        self._done, self._wanted = 0, wanted

    def find(self, request: Request) -> Answer | None:
        """The answer of a simulation that was made before."""
        answer = self._known.get(_identity(request))
        if answer is not None and answer.outcome >= 0 and answer.trajectory.shape != tuple(request.shape or ()):
            return None
        if answer is not None:
            self._count(request, answer)
        return answer

    def add(self, request: Request, answer: Answer) -> None:
        """Keep the answer of a simulation."""
        if self._path is not None:
            fields: dict[str, Any] = {name: list(getattr(request, name)) for name in ("words", "theta")}
            fields |= {"index": request.index, "outcome": answer.outcome, "message": answer.message}
            self._file = self._file or self._path.open("ab")
            self._file.write(records.encoded(fields, answer.trajectory))
            self._file.flush()
        self._count(request, answer)

    def failures(self) -> dict[int, list[Failure]]:
        """The most common failures since the last call, by run."""
        found = {run: tally.commonest()[:KEPT] for run, tally in self._failures.items()}
        self._failures = {}
        return found

    def clear(self) -> None:
        """Forget all, once the round that they were made for is kept as a whole."""
        self.close()
        self._known.clear()
        if self._path is not None:
            self._path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _count(self, request: Request, answer: Answer) -> None:
        self._done += 1
        if answer.outcome < 0:
            reason = REASONS[-1 - answer.outcome]
            self.examples.setdefault(reason, answer.message)
            if self.run is not None:
                self._failures.setdefault(self.run, Tally()).add(reason, answer.message, request.index)
        self._on_simulation(self._done, self._wanted)


def _identity(request: Request) -> tuple:
    return (*request.words, request.index, *request.theta)
