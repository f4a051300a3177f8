"""Progress of rounds, or of other steps: a bar on a terminal, plain lines elsewhere."""

import time
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Column

EVERY_BAR, EVERY_LINE = 0.5, 10.0
"""Seconds between updates of the number of simulations, in a bar and in lines."""
WIDE = 100
"""Smallest width of a window, in characters, with room for a bar beside the numbers."""


class RoundProgress:
    """Shows how many rounds are done; a context manager.

    Example:
        >>> with RoundProgress(Console(quiet=True), rounds=3, done=0, label="2 runs") as progress:
        ...     progress.advance()
    """

    def __init__(
        self, console: Console, rounds: int, done: int, label: str, unit: str = "round", first: str = "compiling"
    ):
        """Nothing is shown before the context is entered.

        Args:
            console: console to write to.
            rounds: number of rounds.
            done: number of rounds done before, by a run that is resumed.
            label: description of the work.
            unit: word for a round.
            first: what happens before the first round; "" for nothing.
        """
        self._console, self._rounds, self._done = console, rounds, done
        self._label, self._unit, self._before = label, unit, first
        self._began = self._shown = time.monotonic()
        # Since when rounds have followed one another, and how many were done then; not known during compilation.
        self._pace = None if first else (self._began, done)
        whole = Column(no_wrap=True)  # numbers are not wrapped, the label may be
        columns = (
            TextColumn("{task.description}", markup=False, table_column=Column(overflow="fold")),
            *([BarColumn()] if console.width >= WIDE else []),
            MofNCompleteColumn(table_column=whole),
            TextColumn(f"{unit}s,"),
            TimeElapsedColumn(table_column=whole),
            TextColumn("elapsed,"),
            TimeRemainingColumn(table_column=whole),
            TextColumn("left"),
        )
        self._bar = Progress(*columns, console=console) if console.is_terminal else None
        self._task: Any = self._bar.add_task(label, total=rounds, completed=done) if self._bar else None

    def __enter__(self) -> "RoundProgress":
        """Show the bar, or say what begins."""
        if self._bar:
            self._bar.update(self._task, description=f"{self._label}{f', {self._before}' if self._before else ''}")
            self._bar.start()
        else:
            after = f", after {self._before}" if self._before else ""
            text = f"{self._label}: {self._rounds - self._done} of {self._rounds} {self._unit}s to do{after}"
            self._console.print(text, markup=False)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leave the bar as it is."""
        if self._bar:
            self._bar.stop()

    def compiled(self, seconds: float) -> None:
        """Say how long compiling took; the estimate of the time left starts now."""
        if self._bar:
            self._bar.update(self._task, description=self._label)
        self._console.print(f"compiled in {seconds:.1f} s")
        self._began = self._shown = time.monotonic()
        self._pace = self._began, self._done

    def simulated(self, done: int, wanted: int) -> None:
        """Show how many simulations have arrived, failed ones included; now and then, if they are slow."""
        now = time.monotonic()
        if now - self._shown < (EVERY_BAR if self._bar else EVERY_LINE):
            return
        self._shown = now
        words = f"{done} simulation{'s' * (done != 1)} so far, {wanted} must succeed"
        if self._bar:
            self._bar.update(self._task, description=f"{self._label}, {words}")
        else:
            self._console.print(f"{self._unit} {self._done + 1}: {words}, {now - self._began:.0f} s elapsed")

    def advance(self, rounds: int = 1, more: str = "") -> None:
        """Count rounds as done; `more` is shown with them."""
        self._done += rounds
        self._shown = now = time.monotonic()
        if self._bar:
            self._bar.update(self._task, advance=rounds, description=f"{self._label}{more}")
            return
        left = ""
        if self._pace:
            since, done = self._pace
            left = f", about {(now - since) / (self._done - done) * (self._rounds - self._done):.0f} s left"
        else:
            self._pace = now, self._done
        self._console.print(
            f"{self._unit} {self._done} of {self._rounds}, {now - self._began:.0f} s elapsed{left}{more}"
        )
