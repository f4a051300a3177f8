"""Small tables as aligned text, as HTML and as CSV, for printing, notebooks and files."""

import csv
import html
import io
from collections.abc import Iterable, Sequence
from typing import Any


def as_text(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as lines with aligned columns.

    Example:
        >>> print(as_text(["name", "value"], [["a", "1"], ["longer", "2"]]))
        name    value
        a       1
        longer  2
    """
    widths = [max(map(len, column)) for column in zip(headings, *rows, strict=True)]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in (headings, *rows))


def as_html(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in HTML.

    Example:
        >>> as_html(["a"], [["<1"]])
        '<table><thead><tr><th>a</th></tr></thead><tbody><tr><td>&lt;1</td></tr></tbody></table>'
    """
    cells = lambda row, tag: "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in row)
    body = "".join(f"<tr>{cells(row, 'td')}</tr>" for row in rows)
    return f"<table><thead><tr>{cells(headings, 'th')}</tr></thead><tbody>{body}</tbody></table>"


def as_csv(headings: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table as CSV.

    Example:
        >>> as_csv(["a", "b"], [[1, "x, y"]]).splitlines()
        ['a,b', '1,"x, y"']
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(headings)
    writer.writerows(rows)
    return text.getvalue()
