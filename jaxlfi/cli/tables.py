"""Consoles that commands print on, and tables that lose no number in a narrow window."""

import dataclasses
import math
import sys
from collections.abc import Sequence
from typing import NoReturn

from rich.console import Console, Group
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

FILE_WIDTH = 120
"""Number of characters in a line of output to a file or a pipe."""


class _Output(Console):
    def on_broken_pipe(self) -> NoReturn:
        """Raise the error on which `jaxlfi.cli.interrupts` ends the process, in place of rich's own exit."""
        raise


def console(quiet: bool = False) -> Console:
    """Standard output, as wide as its window."""
    return _Output(width=None if sys.stdout.isatty() else FILE_WIDTH, quiet=quiet)


@dataclasses.dataclass(frozen=True)
class Output:
    """The consoles that a command prints on, which are the same unless a program is to read the output."""

    results: Console  # what was found
    notes: Console  # progress, and the files that were written
    warnings: Console  # what looks wrong

    @classmethod
    def of(cls, quiet: bool = False, json: bool = False, silent: bool = False) -> "Output":
        """Everything on standard output, or results alone.

        Args:
            quiet: no notes; warnings on standard error.
            json: no tables, as JSON is printed in their place; notes and warnings on standard error.
            silent: nothing at all, for a process that does not write.
        """
        out = console(quiet=silent or json)
        if not (quiet or json):
            return cls(out, out, out)
        errors = lambda quiet: _Output(width=None if sys.stderr.isatty() else FILE_WIDTH, stderr=True, quiet=quiet)
        return cls(out, errors(silent or quiet), errors(silent))


def numbers(column: Sequence[float]) -> list[str]:
    """Numbers of one column, with two decimals, or as many as show two digits of the largest; "-" for NaN.

    Example:
        >>> numbers([-0.0237, 0.0041]), numbers([12.5, math.nan])
        (['-0.024', '0.004'], ['12.50', '-'])
    """
    largest = max((abs(one) for one in column if math.isfinite(one)), default=0.0)
    decimals = min(max(1 - math.floor(math.log10(largest)), 2), 6) if largest else 2
    return ["-" if math.isnan(one) else f"{one:.{decimals}f}" for one in column]


def show(table: Table, on: Console | None = None) -> None:
    """Print a table in whole words: if they do not fit side by side, with one cell per line."""
    on = on or console()
    wide = on.options.update(width=10_000, max_width=10_000)
    sizes = [[Measurement.get(on, wide, cell) for cell in (column.header, *column.cells)] for column in table.columns]
    least = [max(size.minimum for size in column) for column in sizes]
    widths = [max(size.maximum for size in column) for column in sizes]
    room = on.width - sum(table.padding[1::2]) * len(widths) - len(widths) - 1
    if sum(least) > room:
        on.print(_stacked(table, max(size.maximum for column in sizes for size in column[:1]), on.width))
        return
    while sum(widths) > room:
        widths[max(range(len(widths)), key=lambda place: (widths[place] > least[place], widths[place]))] -= 1
    for column, width in zip(table.columns, widths, strict=True):
        column.width, column.no_wrap = width, False
    on.print(table)


def _stacked(table: Table, heading: int, width: int) -> Group:
    """The rows of a table one below the other, with one line per cell."""
    blocks: list[Text | Table] = [Text.from_markup(str(table.title), style="italic")] if table.title else []
    cells = zip(*(column.cells for column in table.columns), strict=True)
    for row, values in zip(table.rows, cells, strict=True):
        block = Table.grid(padding=(0, 2), pad_edge=False)
        block.add_column(overflow="fold", width=min(heading, width // 2))
        block.add_column(overflow="fold")
        for column, value in zip(table.columns, values, strict=True):
            block.add_row(column.header, value, style=row.style)
        blocks += [block, Text()]
    return Group(*blocks[:-1])
