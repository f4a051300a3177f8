"""Progress of the rounds: a bar on a terminal, plain lines elsewhere."""

import time
from types import TracebackType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)


class RoundProgress:
    """Shows how many rounds are done; a context manager.

    Example:
        >>> with RoundProgress(Console(quiet=True), rounds=3, done=0, label="2 runs") as progress:
        ...     progress.advance()
    """

    def __init__(self, console: Console, rounds: int, done: int, label: str):
        """Nothing is shown before the context is entered.

        Args:
            console: where to.
            rounds: how many there are.
            done: how many were done before, by a run that is resumed.
            label: what is going on.
        """
        self._console, self._rounds, self._first, self._done = console, rounds, done, done
        self._label = label
        self._began = time.monotonic()
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("rounds,"),
            TimeElapsedColumn(),
            TextColumn("elapsed,"),
            TimeRemainingColumn(),
            TextColumn("left"),
        )
        self._bar = Progress(*columns, console=console) if console.is_terminal else None
        self._task = self._bar.add_task(label, total=rounds, completed=done) if self._bar else None

    def __enter__(self) -> "RoundProgress":
        """Show the bar, or say what begins."""
        if self._bar:
            self._bar.start()
        else:
            self._console.print(
                f"{self._label}: {self._rounds - self._done} of {self._rounds} rounds to do", markup=False
            )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the bar as it is."""
        if self._bar:
            self._bar.stop()

    def compiled(self, seconds: float) -> None:
        """Say how long compiling took; the estimate of the time left starts now."""
        self._console.print(f"compiled in {seconds:.1f} s")
        self._began = time.monotonic()

    def advance(self) -> None:
        """One more round is done."""
        self._done += 1
        if self._bar:
            self._bar.advance(self._task)
            return
        elapsed = time.monotonic() - self._began
        left = elapsed / (self._done - self._first) * (self._rounds - self._done)
        self._console.print(f"round {self._done} of {self._rounds}, {elapsed:.0f} s elapsed, about {left:.0f} s left")
