"""Tables keep every number, however narrow the window is."""

import re

import numpy as np
import pytest
from rich.console import Console
from rich.table import Table

from jaxlfi.cli import tables

WORDS = re.compile(r"\S+")


def wide_table() -> Table:
    table = Table("configuration", "seeds", "theta error [95 %]", "trajectory error", "final support", title="errors")
    rng = np.random.default_rng(0)
    for name in ("ok", "misspecified+centre", r"\[odd] name"):
        numbers = [
            f"[{low:.4g}, {high:.4g}]" for low, high in rng.normal(size=(4, 2)) * 10.0 ** rng.integers(-6, 6, (4, 1))
        ]
        table.add_row(name, "20", "0.52 [0.45, 0.61]", f"{rng.normal() * 1e5:.6f}", " ".join(numbers), style="red")
    return table


def shown(table: Table, width: int) -> str:
    console = Console(width=width, force_terminal=False)
    with console.capture() as captured:
        tables.show(table, console)
    return captured.get()


@pytest.mark.parametrize("width", [200, 120, 100, 80, 60, 40])
def test_no_word_is_cut_and_no_line_is_too_long(width):
    said = shown(wide_table(), width)
    assert max(map(len, said.splitlines())) <= width and "…" not in said
    words = set(WORDS.findall(said))
    for word in WORDS.findall(shown(wide_table(), 500)):
        assert word in words or not any(character.isalnum() for character in word), word


def test_rows_are_side_by_side_where_they_fit():
    assert "┃ configuration" in shown(wide_table(), 120) and "┃" not in shown(wide_table(), 40)


def test_a_table_without_rows_or_title_is_shown():
    for width in (80, 5):
        assert "head" in shown(Table("heading"), width) or width == 5
